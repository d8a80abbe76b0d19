"""Whether the gate is enforced is judged from packets, not from what the API answered."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from tests.support.clock import Clock, set_clock
from tests.unit.monitor.cluster_objects import ClusterObjects
from understudy.failover.interfaces import GateState, Instance
from understudy.monitor.judge import gate_enforcement
from understudy.monitor.judge.gate_enforcement import LEAK_LASTS, SETTLE, SILENT, GateEnforcement, judge

NOW = 1000.0
SINCE = NOW - 60


@dataclass
class Readers:
    """The robot's readers: a sentence about those that the gate does not reach."""

    ungated: str = ""


@dataclass
class Interfaces:
    """A sentence about the further interfaces of instances."""

    sentence: str = ""

    def further(self) -> str:
        return self.sentence


def instance(name: str, **values: object) -> Instance:
    return Instance(name=name, uid=f"uid-{name}", running=True, **values)  # type: ignore[arg-type]


ACTIVE, STANDBY = instance("w-1"), instance("w-2", pool="hot")


def test_the_gate_is_enforced_if_only_packets_of_the_active_pod_arrive() -> None:
    assert judge([ACTIVE, STANDBY], "uid-w-1", {"uid-w-1": NOW - 0.5}, now=NOW, since=SINCE)[:2] == (
        "True",
        "SeenFromPackets",
    )


def test_a_packet_of_a_standby_shows_that_the_network_does_not_enforce() -> None:
    status, reason, message = judge(
        [ACTIVE, STANDBY], "uid-w-1", {"uid-w-1": NOW, "uid-w-2": NOW - 1}, now=NOW, since=SINCE
    )
    assert (status, reason) == ("False", "NotEnforced")
    assert "w-2" in message


def test_a_packet_of_a_standby_counts_for_a_minute() -> None:
    since = NOW - 600
    for age, expected in ((LEAK_LASTS - 1, "False"), (LEAK_LASTS + 1, "True")):
        last = {"uid-w-1": NOW, "uid-w-2": NOW - age}
        assert judge([ACTIVE, STANDBY], "uid-w-1", last, now=NOW, since=since)[0] == expected


@pytest.mark.parametrize("evicted", [False, True])
def test_a_packet_of_a_pod_that_is_being_deleted_shows_that_the_network_does_not_enforce(evicted: bool) -> None:
    ending = instance("w-0", terminating=True, evicted=evicted)
    last = {"uid-w-1": NOW, "uid-w-0": NOW - 1}
    status, reason, message = judge([ending, ACTIVE, STANDBY], "uid-w-1", last, now=NOW, since=SINCE)
    assert (status, reason) == ("False", "NotEnforced")
    assert "w-0" in message
    silent = {"uid-w-1": NOW, "uid-w-0": SINCE - 1}
    assert judge([ending, ACTIVE, STANDBY], "uid-w-1", silent, now=NOW, since=SINCE)[0] == "True"


def test_a_pod_that_is_being_deleted_and_sends_no_packet_is_no_standby_to_test_the_gate_with() -> None:
    ending = instance("w-0", terminating=True)
    judged = judge([ending, ACTIVE], "uid-w-1", {"uid-w-1": NOW}, now=NOW, since=SINCE)
    assert judged[:2] == ("Unknown", "NoStandby")


def test_packets_from_before_the_switch_do_not_count() -> None:
    last = {"uid-w-1": NOW, "uid-w-2": SINCE + SETTLE - 1}
    assert judge([ACTIVE, STANDBY], "uid-w-1", last, now=NOW, since=SINCE)[0] == "True"


def test_an_active_pod_whose_packets_do_not_arrive_is_blocked() -> None:
    last = {"uid-w-1": NOW - SILENT - 1}
    assert judge([ACTIVE, STANDBY], "uid-w-1", last, now=NOW, since=SINCE)[:2] == ("False", "Blocked")


def test_just_after_a_commit_the_gate_is_not_judged() -> None:
    assert judge([ACTIVE, STANDBY], "uid-w-1", {"uid-w-2": NOW}, now=NOW, since=NOW - 1)[0] == "Unknown"


def test_packets_that_pass_for_longer_than_the_network_needs_show_at_once_that_it_does_not_enforce() -> None:
    judged = judge([ACTIVE, STANDBY], "uid-w-1", {}, now=NOW, since=NOW - 1, passing=["w-2"])
    assert judged[:2] == ("False", "NotEnforced")
    assert "w-2" in judged[2]


def test_a_gate_that_admits_nobody_is_not_judged_unless_packets_pass_it() -> None:
    assert judge([ACTIVE, STANDBY], "", {}, now=NOW, since=SINCE)[:2] == ("Unknown", "Closed")
    assert judge([ACTIVE, STANDBY], "", {}, now=NOW, since=SINCE, passing=["w-1"])[:2] == ("False", "NotEnforced")


def test_a_pod_without_an_agent_is_not_judged() -> None:
    foreign = instance("d-1", has_agent=False)
    assert judge([foreign, STANDBY], "uid-d-1", {}, now=NOW, since=SINCE)[:2] == ("Unknown", "NoProbe")


def test_without_a_standby_enforcement_is_unknown() -> None:
    assert judge([ACTIVE], "uid-w-1", {"uid-w-1": NOW}, now=NOW, since=SINCE)[:2] == ("Unknown", "NoStandby")


def test_an_admitted_standby_is_not_a_leak() -> None:
    last = {"uid-w-1": NOW, "uid-w-2": NOW}
    judged = judge([ACTIVE, STANDBY], "uid-w-1", last, now=NOW, since=SINCE, admitted_uid="uid-w-2")
    assert judged[:2] == ("Unknown", "Admitted"), "and nobody is left to be held back"
    third = instance("w-3", pool="hot")
    judged = judge([ACTIVE, STANDBY, third], "uid-w-1", last, now=NOW, since=SINCE, admitted_uid="uid-w-2")
    assert judged[:2] == ("True", "SeenFromPackets")
    judged = judge(
        [ACTIVE, STANDBY, third], "uid-w-1", last | {"uid-w-3": NOW}, now=NOW, since=SINCE, admitted_uid="uid-w-2"
    )
    assert judged[:2] == ("False", "NotEnforced")
    assert "w-3" in judged[2]
    assert "w-2" not in judged[2]


def test_enforcement_is_judged_again_after_the_gate_admits_another_pod(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    objects, clock = ClusterObjects(), Clock(NOW)
    objects.put_gate(GateState(epoch=3, active="w-1", active_uid="uid-w-1"))
    last, notices = objects.packets, objects.notices
    last.update({"uid-w-1": NOW, "uid-w-2": NOW})
    monkeypatch.setattr(gate_enforcement, "time", clock)
    enforced = GateEnforcement(objects.gate, objects.proof, notices, Readers(), Interfaces())
    enforced.update(NOW)
    enforced.report(found := enforced.judge([ACTIVE, STANDBY]))
    assert (found[1], notices.conditions) == ("Settling", {})
    clock.now = last["uid-w-1"] = last["uid-w-2"] = NOW + SETTLE + 1
    enforced.update(clock.now)
    enforced.report(enforced.judge([ACTIVE, STANDBY]))
    assert notices.conditions["GateEnforced"][:2] == ("False", "NotEnforced")
    assert [reason for _, reason, _ in notices.events] == ["GateNotEnforced"]
    objects.put_gate(GateState(epoch=4, active="w-2", active_uid="uid-w-2"))
    enforced.update(clock.now)
    enforced.report(found := enforced.judge([ACTIVE, STANDBY]))
    assert found[1] == "Settling"
    assert notices.conditions["GateEnforced"][1] == "NotEnforced", "what was seen before stands"
    monkeypatch.setattr(gate_enforcement, "KEPT", 0.0)
    enforced.report(found)
    assert notices.conditions["GateEnforced"][:2] == ("Unknown", "Settling"), "but not for long"


def just_opened(
    monkeypatch: pytest.MonkeyPatch, readers: Readers, interfaces: Interfaces
) -> tuple[GateEnforcement, ClusterObjects, Clock]:
    """A gate that was opened for the active instance at NOW, whose packets pass it."""
    objects, clock = ClusterObjects(), Clock(NOW)
    objects.put_gate(GateState(epoch=3, active="w-1", active_uid="uid-w-1"))
    objects.packets["uid-w-1"] = NOW + SETTLE
    monkeypatch.setattr(gate_enforcement, "time", clock)
    enforced = GateEnforcement(objects.gate, objects.proof, objects.notices, readers, interfaces)
    enforced.update(NOW)
    return enforced, objects, clock


def test_a_reader_that_the_gate_does_not_reach_means_that_it_is_not_enforced(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    readers = Readers()
    enforced, objects, clock = just_opened(monkeypatch, readers, Interfaces())
    last, notices = objects.packets, objects.notices
    clock.now = NOW + SETTLE + 1
    assert enforced.judge([ACTIVE, STANDBY])[:2] == ("True", "SeenFromPackets")
    readers.ungated = "The gate does not reach who reads /cmd_vel."
    assert enforced.judge([ACTIVE, STANDBY]) == ("False", "ReaderWithoutProfile", readers.ungated)
    assert enforced.judge([ACTIVE])[:2] == ("False", "ReaderWithoutProfile"), "where there is no standby too"
    enforced.report(enforced.judge([ACTIVE, STANDBY]))
    assert [reason for _, reason, _ in notices.events] == ["GateReaderWithoutProfile"]
    last["uid-w-2"] = clock.now
    assert enforced.judge([ACTIVE, STANDBY])[1] == "NotEnforced", "a network that enforces nothing comes first"


def test_a_further_interface_of_an_instance_means_that_the_gate_is_not_enforced(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    interfaces = Interfaces("w-2 has net1 (192.168.7.2).")
    enforced, objects, clock = just_opened(monkeypatch, Readers(), interfaces)
    last, notices = objects.packets, objects.notices
    assert enforced.judge([ACTIVE, STANDBY])[1] == "Settling"
    clock.now = NOW + SETTLE + 1
    assert enforced.judge([ACTIVE, STANDBY]) == ("False", "FurtherInterfaces", interfaces.sentence)
    assert enforced.judge([ACTIVE])[:2] == ("False", "FurtherInterfaces"), "although no standby could be seen held back"
    enforced.report(enforced.judge([ACTIVE, STANDBY]))
    assert [reason for _, reason, _ in notices.events] == ["GateFurtherInterfaces"]
    last["uid-w-2"] = clock.now
    assert enforced.judge([ACTIVE, STANDBY])[1] == "NotEnforced", "a network that enforces nothing comes first"
    del last["uid-w-2"]
    interfaces.sentence = ""
    assert enforced.judge([ACTIVE, STANDBY])[:2] == ("True", "SeenFromPackets")


@pytest.mark.parametrize("step", [3600.0, -3600.0])
def test_a_clock_that_is_set_does_not_change_the_judgement(monkeypatch: pytest.MonkeyPatch, step: float) -> None:
    objects, clock = ClusterObjects(), Clock(NOW)
    objects.put_gate(GateState(epoch=1, active="w-1", active_uid="uid-w-1"))
    monkeypatch.setattr(gate_enforcement, "time", clock)
    enforced = GateEnforcement(objects.gate, objects.proof, objects.notices, Readers(), Interfaces())
    enforced.update(NOW)
    set_clock(monkeypatch, step)
    # The times of packets follow the clock (kube/gates/probes.py). The standby's is of when the gate was not enforced yet.
    objects.packets.update({"uid-w-1": NOW + step, "uid-w-2": NOW + 1 + step})
    enforced.update(NOW + 2 + step)
    clock.now = objects.packets["uid-w-1"] = NOW + SETTLE + 1 + step
    assert enforced.judge([ACTIVE, STANDBY])[:2] == ("True", "SeenFromPackets")

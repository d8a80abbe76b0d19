"""Former drivers of which only discovery shows anything: they may still call the robot's services and actions."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.support.clock import set_clock
from tests.unit.monitor.cluster_objects import ClusterObjects
from tests.unit.monitor.gates import PacketsOfReached
from tests.unit.monitor.senses import GivenObserver
from understudy.failover.interfaces import GateState, Instance
from understudy.monitor.judge import sole_driver
from understudy.monitor.judge.possible_senders import FORGOTTEN, LASTS, PERIOD
from understudy.monitor.judge.sole_driver import SoleDriver
from understudy.monitor.observe.robot.known_senders import Caller, KnownSender, OutputSender

NOW = 1_000_000.0
FORMER = Instance("w-1", "uid-w-1", ip="10.0.0.1", running=True, has_agent=False)
ACTIVE = Instance("w-2", "uid-w-2", ip="10.0.0.2", running=True)
SNAP = Caller("/snap", ("uid-w-1",))
GOTO = Caller("/goto", ("uid-w-1",))


class Watched:
    """A workload that w-2 drives after w-1. This monitor has reached the agent of w-2 only."""

    def __init__(self) -> None:
        self.objects, self.observer, self.proof = ClusterObjects(), GivenObserver(), PacketsOfReached("uid-w-2")
        self.notices = self.objects.notices
        self.judged = SoleDriver(self.objects.gate, self.proof, self.observer, self.notices)
        self.now = NOW
        self.instances = [FORMER, ACTIVE]
        self.observer.senders = [_sender(FORMER, pinned=True), _sender(ACTIVE, pinned=True)]
        self.objects.put_gate(GateState(epoch=4, active="w-2", active_uid="uid-w-2"))

    def update(self, seconds: float = PERIOD) -> None:
        self.now += seconds
        self.judged.update(self.instances, self.now)
        self.judged.report(self.now)

    def wait(self, seconds: float) -> None:
        for _ in range(int(seconds / PERIOD) + 1):
            self.update()

    def lose(self) -> None:
        """The object of w-1 is gone."""
        self.instances = [ACTIVE]
        self.observer.senders = [replace(_sender(FORMER, pinned=True), listed=False), _sender(ACTIVE, pinned=True)]

    @property
    def condition(self) -> tuple[str, str, str]:
        return self.notices.conditions["SoleDriver"]


def _sender(instance: Instance, *, pinned: bool = False) -> KnownSender:
    return KnownSender(instance.name, instance.uid, instance.ip, NOW, listed=True, pinned=pinned)


def test_a_former_driver_without_an_agent_that_can_still_call_makes_the_condition_unknown() -> None:
    watched = Watched()
    watched.observer.clients = [SNAP, GOTO]
    watched.update()
    assert watched.condition[:2] == ("True", "NoOtherSender"), "it may be about to end"
    watched.wait(LASTS)
    status, reason, message = watched.condition
    assert (status, reason) == ("Unknown", "PossibleSender")
    assert "/goto, /snap by w-1" in message
    assert watched.notices.reasons == ["PossibleSender"]
    assert not watched.judged.leaks, "nothing shows that it sends"
    watched.observer.clients = []
    watched.update()
    assert watched.condition[:2] == ("True", "NoOtherSender")


def test_a_vanished_pod_whose_agent_was_never_reached_may_call() -> None:
    watched = Watched()
    watched.lose()
    watched.observer.clients = [SNAP]
    watched.wait(LASTS)
    assert watched.condition[:2] == ("Unknown", "PossibleSender")


def test_the_absence_of_test_packets_shows_that_a_reached_agent_is_held_back() -> None:
    watched = Watched()
    watched.proof.reached.add("uid-w-1")
    watched.observer.clients = [SNAP]
    watched.wait(LASTS)
    assert watched.condition[:2] == ("True", "NoOtherSender")


@pytest.mark.parametrize("terminating", [False, True])
@pytest.mark.parametrize("may_be", [("uid-w-2",), ("uid-w-1", "uid-w-2"), ("uid-w-3",)])
def test_who_is_let_through_and_who_never_drove_is_none(may_be: tuple[str, ...], terminating: bool) -> None:
    watched = Watched()
    standby = Instance("w-3", "uid-w-3", ip="10.0.0.3", terminating=terminating)
    watched.instances.append(standby)
    watched.observer.senders.append(_sender(standby))
    watched.observer.clients = [Caller("/snap", may_be)]
    watched.wait(LASTS)
    assert watched.condition[:2] == ("True", "NoOtherSender")


def test_an_instance_that_is_let_through_again_is_none_at_once() -> None:
    watched = Watched()
    watched.observer.clients = [SNAP]
    watched.wait(LASTS)
    watched.objects.put_gate(GateState(epoch=5, active="w-1", active_uid="uid-w-1"))
    watched.update(0.1)
    assert watched.condition[:2] == ("True", "NoOtherSender")


def test_discovery_is_asked_once_a_second_and_only_for_who_may_call() -> None:
    watched, asked = Watched(), 0

    def callers() -> list[Caller]:
        nonlocal asked
        asked += 1
        return []

    watched.observer.callers = callers  # type: ignore[method-assign]
    for _ in range(50):
        watched.update(0.2)
    assert 9 <= asked <= 11
    watched.proof.reached.add("uid-w-1")
    watched.update(PERIOD)
    before = asked
    watched.wait(5)
    assert asked == before


def test_what_is_heard_counts_more_than_what_may_be() -> None:
    watched = Watched()
    watched.observer.clients = [SNAP]
    watched.wait(LASTS)
    for _ in range(10):
        watched.observer.heard = [OutputSender("/cmd_vel", "/teleop", "", (), watched.now + 0.2)]
        watched.update(0.2)
    status, reason, message = watched.condition
    assert (status, reason) == ("Unknown", "UnknownSender")
    assert "/cmd_vel by /teleop" in message
    assert "/snap by w-1" in message
    for _ in range(10):
        watched.observer.heard = [OutputSender("/cmd_vel", "w-1", "uid-w-1", ("uid-w-1",), watched.now + 0.2)]
        watched.update(0.2)
    assert watched.condition[:2] == ("False", "SeveralDrivers")


@pytest.fixture
def closed(monkeypatch: pytest.MonkeyPatch) -> Watched:
    """The gate is closed, and the monitor has listened for long enough."""
    monkeypatch.setattr(sole_driver, "LISTEN", 0.0)
    watched = Watched()
    watched.objects.put_gate(GateState(epoch=5))
    watched.observer.clients = [SNAP]
    return watched


def test_a_closed_gate_opens_for_another_one_once_discovery_would_have_forgotten_a_process_that_is_gone(
    closed: Watched,
) -> None:
    closed.lose()
    closed.update()
    assert closed.judged.may_be_driven(closed.now)
    closed.wait(FORGOTTEN - 2 * PERIOD)
    assert closed.judged.may_be_driven(closed.now)
    closed.wait(2 * PERIOD)
    assert not closed.judged.may_be_driven(closed.now), "it lives, and nothing else will be known"
    assert closed.condition[:2] == ("Unknown", "PossibleSender")


def test_a_closed_gate_opens_as_soon_as_discovery_has_forgotten_the_process(closed: Watched) -> None:
    closed.lose()
    closed.update()
    closed.observer.clients = []
    closed.update()
    assert not closed.judged.may_be_driven(closed.now)


def test_a_closed_gate_does_not_wait_for_an_instance_that_a_policy_selects(closed: Watched) -> None:
    closed.update()
    assert not closed.judged.may_be_driven(closed.now)


def test_a_closed_gate_does_not_wait_for_the_instance_for_which_it_was_closed(closed: Watched) -> None:
    closed.lose()
    closed.judged.close_for("uid-w-1")
    closed.update()
    assert not closed.judged.may_be_driven(closed.now)


@pytest.mark.parametrize("step", [60.0, -60.0])
def test_a_clock_that_is_set_neither_ends_the_wait_nor_prolongs_it(
    closed: Watched, monkeypatch: pytest.MonkeyPatch, step: float
) -> None:
    closed.lose()
    closed.update()
    set_clock(monkeypatch, step)
    closed.now += step
    closed.wait(FORGOTTEN - 2 * PERIOD)
    assert closed.judged.may_be_driven(closed.now)
    closed.wait(2 * PERIOD)
    assert not closed.judged.may_be_driven(closed.now)

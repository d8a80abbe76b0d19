"""Whether somebody besides the instance that the gate lets through reaches the robot, for as long as the workload lives."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from tests.support.clock import set_clock
from tests.unit.monitor.cluster_objects import ClusterObjects
from tests.unit.monitor.senses import GivenObserver
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.pinned import PinnedPod
from understudy.monitor.judge.sole_driver import (
    LASTS,
    MEMORY,
    PERIOD,
    PROBES,
    QUIET,
    SoleDriver,
    Tracks,
    leaks,
    tracked,
)
from understudy.monitor.judge.sole_driver import Sign as _Sign
from understudy.monitor.notices import LeaksCounted
from understudy.monitor.observe.robot.known_senders import KnownSender, OutputSender

NOW = 1_000_000.0
FORMER = Instance("w-1", "uid-w-1", ip="10.0.0.1", running=True)
ACTIVE = Instance("w-2", "uid-w-2", ip="10.0.0.2", running=True)


def signs(name: str, *times: float, uid: str | None = None, fenced: float = 0.0) -> Tracks:
    """Return the tracks of a sender after signs at these times, while w-2 is let through."""
    found: Tracks = {}
    uid = f"uid-{name}" if uid is None else uid
    for at in times:
        sign = _Sign(name, uid, "/cmd_vel", at)
        found = tracked(found, [sign], {uid: fenced}, let_through={"uid-w-2"}, now=at)
    return found


def test_signs_of_who_is_let_through_are_none_of_another() -> None:
    assert not signs("w-2", NOW, NOW + 1, NOW + 2)


def test_a_sender_counts_only_if_it_is_heard_for_longer_than_the_network_may_need() -> None:
    assert not leaks(signs("w-1", NOW, NOW + LASTS / 2), NOW + LASTS / 2)
    assert [leak.uid for leak in leaks(signs("w-1", NOW, NOW + LASTS), NOW + LASTS)] == ["uid-w-1"]


def test_signs_from_before_the_fence_do_not_count() -> None:
    assert not signs("w-1", NOW, NOW + LASTS, fenced=NOW + LASTS)


def test_a_slow_sender_counts_from_its_second_sign_and_stays_for_two_of_its_periods() -> None:
    found = signs("w-1", NOW, NOW + 20)
    assert leaks(found, NOW + 20 + 39)
    assert not leaks(found, NOW + 20 + 41)
    assert not tracked(found, [], {}, let_through=(), now=NOW + 20 + MEMORY)


def test_two_short_leaks_are_not_one_that_lasts() -> None:
    # Somebody edits a label, and seconds later the gate: each is undone within a moment.
    first = [NOW + 0.2 * number for number in range(4)]
    second = [NOW + 8 + 0.2 * number for number in range(3)]
    found = signs("w-1", *first, *second)
    assert not leaks(found, NOW + 8.5)
    lasting = [NOW + 8 + 0.2 * number for number in range(7)]
    assert leaks(signs("w-1", *first, *lasting), NOW + 9.3)


def test_two_short_leaks_are_not_one_that_lasts_although_each_was_seen_once() -> None:
    brief = [_Sign("w-1", "uid-w-1", "/cmd_vel", NOW + moment, interval=0.05) for moment in (0.0, 40.0)]
    found: Tracks = {}
    for sign in brief:
        found = tracked(found, [sign], {}, let_through=(), now=sign.last)
    assert not leaks(found, NOW + 40.1)
    (track,) = found.values()
    assert not track.is_heard(NOW + 40 + QUIET), "it sends more often than that"


class Watched:
    """A workload that w-2 drives after w-1."""

    def __init__(self) -> None:
        self.objects = ClusterObjects()
        self.observer, self.notices = GivenObserver(), self.objects.notices
        self.judged = SoleDriver(self.objects.gate, self.objects.proof, self.observer, self.notices)
        self.now = NOW
        self.instances: Sequence[Instance] = (FORMER, ACTIVE)
        self.objects.put_gate(GateState(epoch=3, active="w-1", active_uid="uid-w-1"))
        self.update()
        self.objects.put_gate(GateState(epoch=4, active="w-2", active_uid="uid-w-2"))
        self.update()

    def update(self, seconds: float = PERIOD) -> None:
        self.now += seconds
        self.judged.update(self.instances, self.now)
        self.judged.report(self.now)

    def listen(self, *, topic: str = "", name: str = "w-1", uid: str = "uid-w-1", probes: bool = False) -> None:
        """A sender is heard ten times in two seconds."""
        for _ in range(10):
            if topic:
                self.observer.heard = [OutputSender(topic, name, uid, (uid,) if uid else (), self.now + PERIOD)]
            if probes:
                self.objects.packets[uid] = self.now + PERIOD
            self.update()

    @property
    def condition(self) -> tuple[str, str, str]:
        return self.notices.conditions["SoleDriver"]


def test_a_fenced_instance_that_goes_on_sending_makes_the_condition_false_until_it_is_silent() -> None:
    watched = Watched()
    assert watched.condition[:2] == ("True", "NoOtherSender")
    watched.listen(topic="/arm")  # an output that no health tree has to watch
    status, reason, message = watched.condition
    assert (status, reason) == ("False", "SeveralDrivers")
    assert "w-1 by /arm" in message
    assert watched.notices.reasons == ["SeveralDrivers"]
    assert [one.count for one in watched.notices.log if isinstance(one, LeaksCounted)] == [1]
    watched.update(QUIET)
    assert watched.condition[:2] == ("True", "NoOtherSender")


@pytest.mark.parametrize("step", [10.0, -10.0])
def test_a_clock_that_is_set_makes_no_leak_of_a_sample_that_was_in_flight(
    monkeypatch: pytest.MonkeyPatch, step: float
) -> None:
    watched = Watched()
    in_flight = watched.now + 0.05
    for moved in (0.0, step):
        if moved:
            set_clock(monkeypatch, moved)
        # What is received follows the clock (ros/observe/topic_watch.py).
        watched.observer.heard = [OutputSender("/arm", "w-1", "uid-w-1", ("uid-w-1",), in_flight + moved)]
        watched.update(2 * PERIOD + moved)
    assert watched.condition[:2] == ("True", "NoOtherSender")
    assert not watched.judged.leaks


@pytest.mark.parametrize("step", [10.0, -10.0])
def test_a_leak_lasts_also_if_the_clock_is_set(monkeypatch: pytest.MonkeyPatch, step: float) -> None:
    watched = Watched()
    watched.listen(topic="/arm")
    set_clock(monkeypatch, step)
    watched.now += step
    watched.observer.heard = [OutputSender("/arm", "w-1", "uid-w-1", ("uid-w-1",), watched.now)]
    watched.update()
    assert watched.condition[:2] == ("False", "SeveralDrivers")


def test_a_leak_during_a_recovery_is_known_as_soon_as_the_recovery_is_over() -> None:
    watched = Watched()
    for _ in range(10):
        watched.now += PERIOD
        watched.observer.heard = [OutputSender("/arm", "w-1", "uid-w-1", ("uid-w-1",), watched.now)]
        watched.judged.track(watched.instances, watched.now)
    assert not watched.judged.leaks
    watched.update()
    assert [leak.uid for leak in watched.judged.leaks] == ["uid-w-1"]
    assert watched.condition[:2] == ("False", "SeveralDrivers")


def test_a_workload_is_not_healthy_during_a_switchover_in_which_somebody_else_drives_it() -> None:
    watched = Watched()
    watched.notices.set(health="Healthy")
    watched.update()
    assert watched.notices.status.health == "Healthy"
    watched.listen(topic="/arm")
    assert watched.notices.status.health == "Degraded"


def test_probes_that_pass_the_gate_are_signs_whatever_kind_of_output_the_workload_has() -> None:
    watched = Watched()
    watched.listen(probes=True)
    assert f"w-1 by {PROBES}" in watched.condition[2]
    (leak,) = watched.judged.leaks
    assert (leak.uid, leak.is_former) == ("uid-w-1", True)
    assert watched.judged.passing(watched.now) == ["w-1"]
    watched.update(2 * LASTS + PERIOD)
    assert not watched.judged.passing(watched.now), "it has ended"


def test_an_instance_whose_pod_is_gone_counts() -> None:
    watched = Watched()
    watched.instances = (ACTIVE,)
    watched.observer.senders = [KnownSender("w-1", "uid-w-1", "10.0.0.1", NOW, listed=False, pinned=True)]
    watched.listen(topic="/cmd_vel")
    assert watched.condition[:2] == ("False", "SeveralDrivers")
    assert watched.judged.may_be_driven(watched.now)


def test_a_sender_that_cannot_be_attributed_is_a_possible_second_driver() -> None:
    watched = Watched()
    watched.listen(topic="/cmd_vel", name="/teleop", uid="")
    status, reason, message = watched.condition
    assert (status, reason) == ("Unknown", "UnknownSender")
    assert "/cmd_vel by /teleop" in message
    assert not watched.judged.leaks


def test_a_workload_is_not_healthy_while_a_sender_that_cannot_be_attributed_drives_it_too() -> None:
    watched = Watched()
    watched.notices.set(health="Healthy")
    watched.listen(topic="/cmd_vel", name="/teleop", uid="")
    assert watched.notices.status.health == "Degraded"
    assert watched.judged.strangers == ("/cmd_vel by /teleop",)


def test_a_sender_that_cannot_be_attributed_is_reported_during_and_after_a_switch_too() -> None:
    watched = Watched()
    watched.listen(topic="/cmd_vel", name="/teleop", uid="")
    watched.objects.put_gate(GateState(epoch=5, active="w-1", active_uid="uid-w-1"))
    watched.observer.heard = [OutputSender("/cmd_vel", "/teleop", "", (), watched.now + PERIOD)]
    watched.update()
    assert watched.condition[:2] == ("Unknown", "UnknownSender")
    watched.judged.verified(watched.now)
    watched.judged.report(watched.now)
    assert watched.condition[:2] == ("Unknown", "UnknownSender")
    watched.observer.heard = []
    watched.update(QUIET)
    assert watched.condition[0] == "True"


def test_probes_of_a_pod_that_is_no_known_instance_are_a_possible_second_driver() -> None:
    watched = Watched()
    watched.listen(probes=True, uid="uid-stray")
    assert watched.condition[:2] == ("Unknown", "UnknownSender")
    assert "uid-stray" in watched.condition[2]


def test_an_instance_for_which_another_monitor_opened_the_gate_meanwhile_was_no_leak() -> None:
    watched = Watched()
    watched.instances = (*watched.instances, Instance(name="w-3", uid="uid-w-3"))
    watched.listen(topic="/cmd_vel", name="w-3", uid="uid-w-3")
    assert watched.condition[0] == "False", "as this monitor knows the gate"
    pinned = (PinnedPod(name="w-4", uid="uid-w-4", ip=""), PinnedPod(name="w-3", uid="uid-w-3", ip=""))
    watched.objects.put_gate(GateState(epoch=6, active="w-4", active_uid="uid-w-4", pinned=pinned))
    watched.update()
    assert (watched.condition[0], watched.judged.leaks) == ("True", ())
    watched.listen(topic="/cmd_vel", name="w-3", uid="uid-w-3")
    assert watched.condition[0] == "False", "it goes on"


def test_a_leak_counts_from_when_its_pod_was_unknown() -> None:
    watched = Watched()
    watched.listen(probes=True, uid="uid-w-3")
    watched.instances = (*watched.instances, Instance(name="w-3", uid="uid-w-3"))  # the watch shows it
    watched.objects.packets["uid-w-3"] = watched.now + PERIOD
    watched.update(2 * PERIOD)
    assert watched.condition[:2] == ("False", "SeveralDrivers")


def test_a_pod_that_this_monitor_learns_of_late_was_no_leak_before_the_gate_was_switched() -> None:
    # Such as the next pod of a StatefulSet, which the gate let through by its name.
    watched = Watched()
    watched.listen(probes=True, uid="uid-next")
    watched.objects.put_gate(GateState(epoch=5, active="w-3", active_uid="uid-w-3"))
    watched.instances = (*watched.instances, Instance(name="w-2", uid="uid-next"))
    watched.update(2 * PERIOD)
    watched.update(2 * PERIOD)
    assert watched.judged.leaks == ()


def test_a_sender_that_may_be_the_active_instance_does_not_count() -> None:
    watched = Watched()
    for _ in range(10):
        sender = OutputSender("/cmd_vel", "w-1", "uid-w-1", ("uid-w-1", "uid-w-2"), watched.now + PERIOD)
        watched.observer.heard = [sender]
        watched.update()
    assert watched.condition[0] == "True"


def test_a_successor_of_the_same_name_is_no_leak_after_the_gate_was_opened_for_another_instance() -> None:
    # The gate lets instances through by name, and in a StatefulSet the next pod has the name of the one that is gone.
    watched, successor = Watched(), Instance("w-2", "uid-next", ip="10.0.0.3", running=True)
    watched.instances = (FORMER, successor)
    watched.listen(topic="/cmd_vel", name="w-2", uid="uid-next", probes=True)
    assert watched.condition[:2] == ("False", "SeveralDrivers"), "both drive until then"
    watched.observer.heard = []
    watched.objects.put_gate(GateState(epoch=5, active="w-1", active_uid="uid-w-1"))
    watched.update()
    assert not watched.judged.leaks
    watched.listen(topic="/cmd_vel", name="w-2", uid="uid-next")
    assert [(leak.uid, leak.is_former) for leak in watched.judged.leaks] == [("uid-next", True)]


def test_an_admitted_standby_does_not_count() -> None:
    watched = Watched()
    state = GateState(epoch=4, active="w-2", active_uid="uid-w-2", admitted="w-1", admitted_uid="uid-w-1")
    watched.objects.put_gate(state)
    watched.listen(topic="/cmd_vel", probes=True)
    assert watched.condition[0] == "True"


def test_while_the_gate_is_closed_the_former_driver_counts() -> None:
    watched = Watched()
    watched.objects.put_gate(GateState(epoch=5))
    watched.listen(topic="/cmd_vel", name="w-2", uid="uid-w-2")
    assert watched.condition[:2] == ("False", "FormerDriver")


def test_without_a_gate_nobody_says_who_may_drive() -> None:
    watched = Watched()
    gates = watched.objects.view.gates
    gates.apply_event("DELETED", gates.items[watched.objects.gate_name])
    watched.listen(topic="/cmd_vel", name="w-1")
    assert watched.condition[:2] == ("Unknown", "NoGate")

"""A pause: its owner, reason and end are reported once, and its end once, whatever ends it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from tests.support.golden import assert_golden
from tests.support.notices import RecordedNotices
from tests.unit.monitor.cluster_objects import NAMESPACE, ClusterObjects
from understudy.api import names
from understudy.api.kinds.pause_spec import Pause
from understudy.failover.interfaces import GateState
from understudy.kube.client import NETWORK_POLICIES
from understudy.monitor.decide.pause_state import PauseState
from understudy.monitor.notices import PublishedStatus

UNTIL = "1970-01-01T00:20:00Z"
END = 1200.0
GIVEN = Pause(reason="a new gripper", owner="ann", until=UNTIL)


class World:
    """A monitor's notices and view, and the workload that a user pauses."""

    def __init__(self, pause: Pause | None = None, status: dict[str, Any] | None = None) -> None:
        self.notices = RecordedNotices(PublishedStatus.adopt({"status": status or {}}))
        self._objects = ClusterObjects(notices=self.notices)
        self.pause(pause)
        self.pauses = PauseState(self._objects.view, self.notices)

    def pause(self, pause: Pause | None, annotations: Mapping[str, str] | None = None) -> None:
        """Pause the workload, or end its pause."""
        spec = pause.to_wire() if pause is not None else None
        self._objects.put_workload(annotations=annotations, pause=spec)

    def fence(self, generation: int) -> None:
        """Close the gate by a pause of this generation."""
        self._objects.put_gate(GateState(epoch=4))
        gate = dict(self._objects.view.gates.items[names.gate("w")])
        gate["metadata"] = gate["metadata"] | {"annotations": {names.FENCED: str(generation)}}
        self._objects.view.gates.put(self._objects.client.store(NETWORK_POLICIES, NAMESPACE, gate))

    @property
    def events(self) -> list[tuple[str, str]]:
        return [(reason, message) for kind, reason, message in self.notices.events]

    @property
    def paused_condition(self) -> tuple[str, str, str] | None:
        found = self.notices.status.find("Paused")
        return (found.status, found.reason, found.message) if found is not None else None


def test_a_pause_is_reported_with_owner_reason_and_end() -> None:
    world = World(GIVEN)
    world.pauses.update(1000.0)
    assert world.pauses.on == GIVEN
    assert world.paused_condition is not None
    status, reason, message = world.paused_condition
    assert (status, reason) == ("True", "Maintenance")
    assert_golden("monitor", message, "ann: a new gripper", "1970-01-01 00:20:00")
    assert "understudy resume -n fleet w" in message
    world.pauses.update(1001.0)
    assert [reason for reason, _ in world.events] == ["Paused"]


def test_a_pause_ends_at_its_time() -> None:
    world = World(GIVEN)
    world.pauses.update(END - 0.1)
    world.pauses.update(END)
    assert world.pauses.on is None
    assert world.pauses.ended == END - 0.1
    assert world.paused_condition is not None
    assert world.paused_condition[:2] == ("False", "Over")
    reason, message = world.events[-1]
    assert reason == "PauseEnded"
    assert_golden("monitor", message, "ann: a new gripper", "1970-01-01 00:20:00 UTC")


def test_a_pause_ends_when_it_is_removed() -> None:
    world = World(Pause(reason="a new gripper", owner="ann"))
    world.pauses.update(1000.0)
    world.pause(None)
    world.pauses.update(5000.0)
    assert world.pauses.on is None
    assert world.paused_condition is None
    reason, message = world.events[-1]
    assert reason == "PauseEnded"
    assert_golden("monitor", message, "ann: a new gripper", "removed")


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ({}, {names.RESUMED: "2", names.RESUMED_FOR: "bob: it grips"}, "spec.pause was removed by bob: it grips"),
        ({names.RESUMED: "1"}, {names.RESUMED: "2", names.RESUMED_FOR: "bob: it grips"}, "removed by bob: it grips"),
        ({}, {names.RESUMED: "2"}, "spec.pause was removed"),
    ],
)
def test_the_end_of_a_pause_is_reported_with_owner_and_reason_of_the_resume(
    before: dict[str, str], after: dict[str, str], words: str
) -> None:
    world = World()
    world.pause(GIVEN, before)
    world.pauses.update(1000.0)
    world.pause(None, after)
    world.pauses.update(1001.0)
    assert world.events[-1][1].endswith(words)


def test_an_earlier_resume_does_not_explain_the_end_of_a_pause() -> None:
    world, annotations = World(), {names.RESUMED: "1", names.RESUMED_FOR: "bob: it grips"}
    world.pause(GIVEN, annotations)
    world.pauses.update(1000.0)
    world.pause(None, annotations)
    world.pauses.update(1001.0)
    assert world.events[-1][1].endswith("spec.pause was removed")


def test_a_changed_pause_is_reported_too() -> None:
    world = World(GIVEN)
    world.pauses.update(1000.0)
    world.pause(Pause(reason="and a new arm", owner="bob"))
    world.pauses.update(1001.0)
    assert [reason for reason, _ in world.events] == ["Paused", "Paused"]
    assert world.paused_condition is not None
    assert world.paused_condition[2].startswith("Paused by bob: and a new arm. ")


@pytest.mark.parametrize(("pause", "reasons"), [(GIVEN, []), (None, [])])
def test_a_new_monitor_raises_no_second_event_for_a_pause(pause: Pause | None, reasons: list[str]) -> None:
    world = World(GIVEN)
    world.pauses.update(1000.0)
    later = World(pause, world.notices.status.to_wire())
    later.pauses.update(1001.0)
    assert later.paused_condition == (world.paused_condition if pause is not None else None)
    assert [reason for reason, _ in later.events] == reasons


def test_an_invalid_date_does_not_end_a_pause() -> None:
    pause = Pause(reason="a new gripper", owner="ann", until="2026-02-30T00:00:00Z")
    assert pause.in_force(1e10)
    assert pause.words == "paused by ann: a new gripper"


def test_a_workload_without_a_pause_has_no_condition_about_it() -> None:
    world = World()
    world.pauses.update(1000.0)
    assert world.paused_condition is None
    assert world.notices.changes == 0


def test_a_fence_is_a_pause_before_the_monitor_has_received_the_pause() -> None:
    world = World()
    world.pauses.update(1000.0)
    assert world.pauses.on is None
    world.fence(generation=2)
    world.pauses.update(1001.0)
    assert world.pauses.on is not None
    assert world.pauses.on.is_fence
    assert world.pauses.ended == 1001.0, "silence until now is no failure"
    assert world.events == [], "the pause itself is reported"

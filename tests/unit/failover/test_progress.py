"""The first sample that passes the gate gives the time of enforcement; a gate reports a recovery earlier than the status."""

from __future__ import annotations

from typing import Any, Literal

import pytest

from understudy.api.kinds.robot_workload import DependencyRecovery
from understudy.failover.progress import LASTS, Committed, PodIdentity, Progress, rfc3339, under_way


def switched(*, routed: float, fenced: float | None = None) -> Progress:
    """A recovery in which the understudy's first probe was waited for."""
    progress = Progress.begin("silent", last_healthy=99.5, detected=100.0)
    progress.moments |= {"decided": 100.0, "committing": 100.01, "fenced": fenced or routed, "routed": routed}
    progress.charge("cluster", routed)
    return progress


def test_a_command_before_the_first_probe_shows_that_the_gate_was_open() -> None:
    progress = switched(routed=100.09)
    progress.note_first_output(100.05)
    moments = progress.moments
    assert (moments["routed"], moments["fenced"], moments["first_output"]) == (100.05, 100.05, 100.05)
    assert progress.parts["cluster"] == pytest.approx(0.05)
    assert progress.cursor == pytest.approx(100.05)
    assert progress.to_recovery(1).parts.cluster == pytest.approx(0.05)


def test_a_command_after_the_first_probe_changes_nothing() -> None:
    progress = switched(routed=100.02)
    progress.note_first_output(100.05)
    assert (progress.moments["routed"], progress.moments["first_output"]) == (100.02, 100.05)
    assert progress.parts["cluster"] == pytest.approx(0.02)


def test_a_failed_pod_whose_last_command_came_later_was_fenced_later() -> None:
    progress = switched(routed=100.09, fenced=100.12)
    progress.note_first_output(100.05)
    assert (progress.moments["routed"], progress.moments["fenced"]) == (100.05, 100.12)


def test_with_the_reflex_the_first_command_precedes_the_commit() -> None:
    progress = switched(routed=100.09)
    progress.taken_over = PodIdentity(name="p", uid="u")
    progress.moments["first_output"] = 99.9
    progress.note_first_output(100.0)
    assert (progress.moments["first_output"], progress.moments["routed"]) == (99.9, 100.09)


def test_without_a_probe_no_routing_time_is_recorded() -> None:
    progress = Progress.begin("silent", last_healthy=99.5, detected=100.0)
    progress.note_first_output(100.05)
    assert "routed" not in progress.moments
    assert "cluster" not in progress.parts


def test_a_planned_recovery_stays_planned_after_a_restart_and_in_the_record() -> None:
    progress = Progress.begin("degraded: slow", last_healthy=99.9, detected=100.0, planned=True)
    taken_up = Progress.model_validate_json(progress.model_dump_json())
    assert taken_up.to_recovery(1).planned
    assert not Progress.begin("silent", last_healthy=99.9, detected=100.0).to_recovery(2).planned


NOW = 1_700_000_000.0


def beside(**moments: float) -> Progress:
    """A recovery that has just committed to the gate, half a second after its failure was detected."""
    progress = Progress.begin("silent", last_healthy=NOW - 1, detected=NOW - 0.5)
    progress.id = "r2"
    progress.moments |= moments
    return progress


class TestRecoveryInProgress:
    """A status contains the recovery of its gate once the recovery is over, or takes long."""

    def test_a_recovery_that_is_only_at_the_gate_is_under_way(self) -> None:
        committed = Committed.of(beside())
        assert under_way(committed, [])
        assert under_way(committed, [("r1", rfc3339(NOW - 60))], NOW)

    def test_a_recovery_in_the_status_is_not_under_way(self) -> None:
        committed = Committed.of(beside())
        assert not under_way(committed, [("r2", rfc3339(NOW - 0.5))])
        assert not under_way(committed, [("r1", None), ("r2", None)]), "and however many others there are"

    def test_no_recovery_is_under_way_without_one_at_the_gate(self) -> None:
        assert not under_way(None, [], NOW)

    @pytest.mark.parametrize("result", ["Recovered", "Failed"])
    def test_a_recovery_with_a_result_at_the_gate_is_not_under_way(
        self, result: Literal["Recovered", "Failed"]
    ) -> None:
        progress = beside()
        progress.result = result
        assert not under_way(Committed.of(progress), [], NOW)

    @pytest.mark.parametrize(("later", "expected"), [(0.0, False), (10.0, False), (-10.0, True)])
    def test_a_recovery_that_began_no_later_than_one_in_the_status_is_not_under_way(
        self, later: float, expected: bool
    ) -> None:
        """Of several that failed like each other only the last is kept, and the status keeps ten."""
        assert under_way(Committed.of(beside()), [("r3", rfc3339(NOW - 0.5 + later)), ("r1", None)]) is expected

    def test_the_order_in_the_status_does_not_matter(self) -> None:
        recoveries = [("r1", rfc3339(NOW - 60)), ("r3", rfc3339(NOW))]
        assert not under_way(Committed.of(beside()), recoveries)
        assert not under_way(Committed.of(beside()), reversed(recoveries))

    def test_a_recovery_is_under_way_for_a_bounded_time(self) -> None:
        committed = Committed.of(beside())
        assert under_way(committed, [], NOW - 0.5 + LASTS - 0.001)
        assert not under_way(committed, [], NOW - 0.5 + LASTS)
        assert under_way(committed, []), "who has a bound of their own asks for none"
        assert under_way(committed, [], NOW - 60), "by a clock that is behind it has only just begun"

    def test_a_held_recovery_begins_at_its_release(self) -> None:
        committed = Committed.of(beside(held=NOW, released=NOW + 300))
        assert under_way(committed, [], NOW + 305)
        assert not under_way(committed, [("r1", rfc3339(NOW + 1))], NOW + 305), (
            "it is as old as its failure all the same"
        )

    def test_a_recovery_without_a_time_is_known_only_by_its_id(self) -> None:
        progress = beside()
        progress.moments, progress.cursor = {}, 0.0
        committed = Committed.of(progress)
        assert under_way(committed, [("r1", None)])
        assert not under_way(committed, [("r1", None)], NOW)

    def test_a_switchover_is_planned_and_a_failure_is_not(self) -> None:
        assert not Committed.of(beside()).planned
        switchover = beside()
        switchover.switchover = "Drain"
        assert Committed.of(switchover).planned


@pytest.mark.parametrize(
    ("changes", "occasion"),
    [
        ({}, "FailureDetected"),
        ({"planned": True}, "Rescheduling"),
        ({"follows": [DependencyRecovery(name="maps", recovery="r9")]}, "FollowsDependency"),
    ],
)
def test_the_cause_of_a_recovery_is_recorded(changes: dict[str, Any], occasion: str) -> None:
    assert beside().model_copy(update=changes).occasion == occasion


def test_a_held_recovery_is_held_until_its_release() -> None:
    assert not beside().held
    assert beside(held=NOW).held
    assert not beside(held=NOW, released=NOW + 1).held


def test_the_next_monitor_knows_that_the_gate_was_open_when_the_recovery_began() -> None:
    begun = Progress.begin("it ended", last_healthy=1.0, detected=2.0)
    begun.open_at = 3
    assert Progress.of_record(begun.record()).open_at == 3

"""When the gate was enforced is told by what came through it first."""

from __future__ import annotations

import pytest

from understudy.mitigation.progress import PodIdentity, Progress


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


def test_one_after_the_first_probe_says_nothing_new() -> None:
    progress = switched(routed=100.02)
    progress.note_first_output(100.05)
    assert (progress.moments["routed"], progress.moments["first_output"]) == (100.02, 100.05)
    assert progress.parts["cluster"] == pytest.approx(0.02)


def test_a_failed_pod_that_was_heard_later_was_fenced_later() -> None:
    progress = switched(routed=100.09, fenced=100.12)
    progress.note_first_output(100.05)
    assert (progress.moments["routed"], progress.moments["fenced"]) == (100.05, 100.12)


def test_by_the_reflex_the_first_command_came_before_the_commit() -> None:
    progress = switched(routed=100.09)
    progress.taken_over = PodIdentity(name="p", uid="u")
    progress.moments["first_output"] = 99.9
    progress.note_first_output(100.0)
    assert (progress.moments["first_output"], progress.moments["routed"]) == (99.9, 100.09)


def test_without_a_probe_nothing_is_made_up() -> None:
    progress = Progress.begin("silent", last_healthy=99.5, detected=100.0)
    progress.note_first_output(100.05)
    assert "routed" not in progress.moments
    assert "cluster" not in progress.parts


def test_that_it_is_planned_outlives_a_monitor_and_is_recorded() -> None:
    begun = Progress.begin("degraded: slow", last_healthy=99.9, detected=100.0, planned=True)
    taken_up = Progress.model_validate_json(begun.model_dump_json())
    assert taken_up.to_recovery(1).planned
    assert not Progress.begin("silent", last_healthy=99.9, detected=100.0).to_recovery(2).planned

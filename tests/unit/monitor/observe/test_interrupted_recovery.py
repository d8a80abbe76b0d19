"""What a new monitor takes over of its predecessor's recoveries."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import pytest

from tests.unit.monitor.cluster_objects import ClusterObjects
from tests.unit.monitor.takeovers import took_over
from understudy.api.kinds.robot_workload import Moments, Recovery
from understudy.failover.interfaces import GateState
from understudy.failover.journal import Journal
from understudy.failover.progress import Progress, rfc3339
from understudy.monitor.notices import PublishedStatus
from understudy.monitor.observe.objects.interrupted_recovery import concluded, interrupted


def started_recovery(at: float) -> Progress:
    return Progress.begin("it ended", last_healthy=at - 1, detected=at)


class EarlierMonitor:
    """What an earlier monitor has left in the journal, at the gate and in the status."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def found(
        self,
        journal: Progress | None,
        gate: Progress | None,
        recorded: Sequence[Progress] = (),
        given_up: Sequence[Progress] = (),
    ) -> Progress | None:
        """The recovery that a new monitor continues."""
        kept, objects = Journal(self._folder / "recovery.json"), ClusterObjects(self._folder)
        if journal is not None:
            kept.save(journal)
        else:
            kept.clear()
        objects.put_gate(GateState(epoch=4, recovery=gate))
        for progress in recorded:
            objects.notices.record(progress)
        return interrupted(kept, objects.gate, objects.notices.status, {progress.id for progress in given_up})


@pytest.fixture
def left(tmp_path: Path) -> EarlierMonitor:
    return EarlierMonitor(tmp_path)


def test_an_unrecorded_recovery_continues_from_the_journal(left: EarlierMonitor) -> None:
    committed = started_recovery(100.0)
    saved = committed.model_copy(update={"index": 1})
    for journal, index in ((saved, 1), (None, 0)):
        progress = left.found(journal, committed)
        assert progress is not None
        assert (progress.id, progress.index, progress.resumed) == (committed.id, index, True)
        assert not committed.resumed, "it is a copy"


def test_the_newer_recovery_of_journal_and_gate_continues(left: EarlierMonitor) -> None:
    older, newer = started_recovery(100.0), started_recovery(200.0)
    progress = left.found(older, newer)
    assert progress is not None
    assert progress.id == newer.id
    progress = left.found(newer, older, recorded=[older])
    assert progress is not None
    assert progress.id == newer.id, "it hadn't come to the gate yet"


def test_an_abandoned_recovery_does_not_continue_after_a_later_one_ended(left: EarlierMonitor) -> None:
    given_up, done = started_recovery(100.0), started_recovery(200.0)
    assert left.found(given_up, done, recorded=[done]) is None
    ended = given_up.model_copy(update={"result": "Failed"})
    assert left.found(given_up, ended) is None, "somebody was put in control since"


def test_an_abandoned_recovery_at_the_gate_does_not_continue_and_a_later_one_does(
    left: EarlierMonitor,
) -> None:
    stopped, later = started_recovery(100.0), started_recovery(200.0)
    assert left.found(None, stopped, given_up=[stopped]) is None
    assert left.found(stopped, stopped, given_up=[stopped]) is None
    progress = left.found(later, stopped, given_up=[stopped])
    assert progress is not None
    assert progress.id == later.id, "it hadn't come to the gate yet"


def test_a_recovery_that_was_recorded_or_failed_does_not_continue(left: EarlierMonitor) -> None:
    done, failed = started_recovery(100.0), started_recovery(200.0).model_copy(update={"result": "Failed"})
    assert left.found(done, failed, recorded=[done]) is None
    assert left.found(None, None) is None


@pytest.mark.parametrize(
    ("id_", "result", "known"), [("", "Recovered", True), ("", "Failed", False), ("x", "Recovered", False)]
)
def test_a_new_monitor_knows_which_instance_took_over_last(
    id_: str, result: Literal["Recovered", "Failed"], known: bool
) -> None:
    left = took_over(1, 100.0).model_copy(update={"result": "Running"})
    left.moments.pop("verified")
    objects = ClusterObjects()
    objects.put_gate(GateState(epoch=4, active="w-1", active_uid="uid-1", recovery=left))
    moments = Moments(verified=rfc3339(123.0))
    last = Recovery(id=id_ or left.id, reason="it ended", result=result, moments=moments)
    done = concluded(objects.gate, PublishedStatus(recoveries=(last,)))
    assert (done is not None) == known
    if done is not None:
        assert (done.result, done.index, done.moments["verified"]) == ("Recovered", 1, 123.0)

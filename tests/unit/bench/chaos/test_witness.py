"""What the witness of a campaign concludes from a gate object about when a commit was made."""

from __future__ import annotations

import math
from datetime import UTC, datetime

import pytest

from bench.chaos.judge import LAG
from bench.chaos.witness import commit_of, restarts, unled
from understudy.api import names
from understudy.failover.progress import PodIdentity, Progress
from understudy.kube.client import Object

SECOND = 1_795_784_129.0
"""The second of the write, as the API server notes it."""


def gate(target: str, requested: float) -> Object:
    """A gate that a recovery opened for an instance, with the record of the commit."""
    progress = Progress.begin("no output", last_healthy=SECOND - 5, detected=SECOND - 4)
    progress.target = PodIdentity(name=target, uid=f"uid-{target}")
    progress.moments["committing"] = requested
    record = {names.EPOCH: "23", names.ACTIVE: "b", names.RECOVERY: progress.record()}
    written = datetime.fromtimestamp(SECOND, UTC).isoformat()
    return {"metadata": {"annotations": record, "managedFields": [{"time": written}]}}


@pytest.mark.parametrize("late", [0.6, 1.18, 1.4])
def test_a_commit_that_was_seen_late_was_made_after_the_monitor_requested_it(late: float) -> None:
    requested = SECOND + 0.19
    found = commit_of(gate("b", requested), requested + late, 0.0)
    assert found.let_through == ("b",)
    assert found.earliest == pytest.approx(min(requested, requested + late - LAG))


def test_a_request_for_an_earlier_commit_dates_no_later_one() -> None:
    seen = SECOND + 0.3
    assert commit_of(gate("b", SECOND - 40), seen, 0.0).earliest == pytest.approx(seen - LAG)
    assert math.isnan(commit_of(gate("another", SECOND - 40), seen, 0.0).since)


@pytest.mark.parametrize("text", ["", "{", '{"reason": 1}'])
def test_a_record_that_cannot_be_read_dates_nothing(text: str) -> None:
    item = gate("b", SECOND)
    item["metadata"]["annotations"][names.RECOVERY] = text
    assert math.isnan(commit_of(item, SECOND + 1.3, 0.0).since)


def test_an_operator_that_renewed_its_lease_once_did_not_lead() -> None:
    led = [float(second) for second in range(0, 20, 2)]
    again = [70.0 + second for second in range(0, 20, 2)]
    assert unled([*led, 60.0, *again]) == [(18.0, 70.0)]
    assert unled([*led, 40.0, 42.0, *again]) == [(18.0, 40.0), (42.0, 70.0)]


def test_the_time_until_a_kubelet_starts_a_container_again_is_known() -> None:
    def container(name: str, state: Object) -> Object:
        ended = {"terminated": {"finishedAt": "2026-11-28T18:03:45Z"}}
        return {"name": name, "lastState": ended, "state": state}

    running = {"running": {"startedAt": "2026-11-28T18:03:57Z"}}
    pod: Object = {"status": {"containerStatuses": [container("robot", running), container("mux", running)]}}
    ((ended, begun),) = restarts(pod, "mux")
    assert begun - ended == 12.0
    waiting: Object = {"status": {"containerStatuses": [container("mux", {"waiting": {"reason": "CrashLoopBackOff"}})]}}
    assert list(restarts(waiting, "mux")) == []
    assert list(restarts({}, "mux")) == []

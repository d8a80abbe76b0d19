"""Which instance a closed gate admitted last, also if somebody has deleted the gate and its record."""

from __future__ import annotations

import pytest

from understudy.failover.interfaces import GateState, Instance
from understudy.failover.pinned import PinnedPod
from understudy.failover.progress import Progress
from understudy.monitor.notices import PublishedStatus
from understudy.monitor.observe.last_driver import last_driver

CLAIMED = Instance("spare-1", "uid-s", pool="spare", claim="u/1", running=True)
STATUS = PublishedStatus(adopted="spare-1", driven_epoch=7)


def test_the_record_of_the_gate_names_it() -> None:
    pinned = (PinnedPod(name="w-2", uid="uid-2", ip="10.0.0.2"), PinnedPod(name="w-1", uid="uid-1", ip="10.0.0.1"))
    found = last_driver(GateState(epoch=7, pinned=pinned), STATUS, [CLAIMED])
    assert found is not None
    assert found.uid == "uid-2"


def test_without_the_record_the_status_of_an_earlier_monitor_names_it() -> None:
    found = last_driver(GateState(epoch=7), STATUS, [CLAIMED])
    assert found is not None
    assert (found.name, found.uid) == ("spare-1", "uid-s")


@pytest.mark.parametrize(
    "gate",
    [
        GateState(epoch=8),  # closed by a commit
        GateState(epoch=7, active="w-1", active_uid="uid-1"),
        GateState(epoch=7, recovery=Progress.begin("it ended", last_healthy=1.0, detected=2.0)),
    ],
)
def test_the_status_counts_only_for_a_gate_that_was_created_again(gate: GateState) -> None:
    assert last_driver(gate, STATUS, [CLAIMED]) is None


def test_a_pod_of_a_stateful_set_may_be_the_next_one_of_that_name() -> None:
    assert last_driver(GateState(epoch=7), STATUS, [Instance("spare-1", "uid-n", running=True)]) is None
    assert last_driver(GateState(epoch=7), STATUS, []) is None

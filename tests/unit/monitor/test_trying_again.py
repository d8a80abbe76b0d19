"""What came to nothing is put off, longer each time, but not once what was wrong may have been corrected; and it is told."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from understudy.api.workloads import Attempt, Recovery
from understudy.monitor.reporting import describe, in_vain
from understudy.monitor.supervising import BACKOFF_FIRST, Supervisor

LATER = 1060.0


def supervisor(**more: Any) -> Any:
    view = SimpleNamespace(policy={"strategies": 1}, spec={"bringUp": 1}, settings={"pools": 1})
    found = SimpleNamespace(_view=view, _given=(), _backoff=60.0, _not_before=LATER)
    for name, value in more.items():
        setattr(found, name, value)
    Supervisor._notice_correction(found, 1000.0)
    return found


@pytest.mark.parametrize("what", ["policy", "spec", "settings"])
def test_a_correction_is_tried_at_once(what: str) -> None:
    found = supervisor()
    found._not_before, found._backoff = LATER, 60.0
    setattr(found._view, what, {"corrected": 1})
    Supervisor._notice_correction(found, 1001.0)
    assert (found._not_before, found._backoff) == (1001.0, BACKOFF_FIRST)


def test_the_same_once_more_is_no_correction() -> None:
    found = supervisor()
    found._not_before, found._backoff = LATER, 60.0
    found._view.policy = dict(found._view.policy)  # as after a change of its status
    Supervisor._notice_correction(found, 1001.0)
    assert (found._not_before, found._backoff) == (LATER, 60.0)


def test_the_cooldown_after_a_recovery_stays() -> None:
    found = supervisor(_backoff=BACKOFF_FIRST)
    found._view.policy = {"another": 1}
    Supervisor._notice_correction(found, 1001.0)
    assert found._not_before == LATER


def test_a_recovery_tells_what_was_tried_in_vain_before() -> None:
    hung = "strategies[0].recovery.sequence[0].wait_for: node /nobody is not there within 14 s"
    recovery = Recovery(
        id="1",
        reason="/cmd_vel is silent",
        result="Recovered",
        strategy="Restart",
        from_pod="w-1",
        to_pod="w-3",
        recovery_seconds=16.0,
        attempts=[
            Attempt(strategy="Fallback", result="NotAvailable", message="no pool"),
            Attempt(strategy="Fallback/Initialized", pod="w-2", result="NotVerified", message=hung),
            Attempt(strategy="Restart", pod="w-3", result="Verified"),
        ],
    )
    told = f"Fallback/Initialized with w-2 was tried in vain: {hung}"
    assert in_vain(recovery) == [told]
    assert describe(recovery).endswith(f"by Restart in 16.000 s, epoch 0. Before that: {told}")

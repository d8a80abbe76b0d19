"""A policy with two strategies, and recoveries that succeeded, for tests."""

from __future__ import annotations

from typing import Any

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover.progress import PodIdentity, Progress


def policy(**more: Any) -> FailurePolicySpec:
    return FailurePolicySpec.model_validate(
        {
            "monitoring": {"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}},
            "strategies": [{"type": "Restart"}] * 2,
            **more,
        }
    )


def took_over(index: int, at: float) -> Progress:
    progress = Progress.begin("it ended", last_healthy=at - 1, detected=at - 1)
    progress.index, progress.result = index, "Recovered"
    progress.target = PodIdentity(name="w-1", uid="uid-1")
    progress.moments["verified"] = at
    return progress

"""The monitor's loop, where it decides with which strategy to begin."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

from understudy.api.policies import FailurePolicySpec
from understudy.mitigation.interfaces import GateState, Instance
from understudy.mitigation.progress import PodIdentity, Progress
from understudy.monitor.detection import Failure
from understudy.monitor.supervising import BACKOFF_FIRST, Parts, Supervisor

ACTIVE = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True)


class Told:
    """What a supervisor says."""

    def __init__(self) -> None:
        self.conditions: dict[str, tuple[str, str, str]] = {}
        self.events: list[tuple[str, str, str]] = []

    def condition(self, type_: str, status: str, reason: str, message: str = "") -> bool:
        self.conditions[type_] = (status, reason, message)
        return True

    def event(self, kind: str, reason: str, message: str) -> None:
        self.events.append((kind, reason, message))


def policy(strategies: int) -> FailurePolicySpec:
    return FailurePolicySpec.model_validate(
        {
            "monitoring": {"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}},
            "strategies": [{"type": "Restart"}] * strategies,
        }
    )


def supervisor(told: Told, *, strategies: int = 2) -> Supervisor:
    parts: dict[str, Any] = {
        "view": SimpleNamespace(policy=policy(strategies), settings=SimpleNamespace(), spec=None),
        "fleet": SimpleNamespace(),
        "gate": SimpleNamespace(state=GateState(epoch=3, active="w-1", active_uid="uid-1")),
        "sidecars": SimpleNamespace(),
        "sight": SimpleNamespace(graph=None, coming=None),
        "probes": SimpleNamespace(),
        "reporter": told,
        "journal": SimpleNamespace(),
        "crash_points": SimpleNamespace(),
        "keeping": SimpleNamespace(),
        "black_box": SimpleNamespace(),
    }
    return Supervisor(Parts(**parts))


def took_over(index: int, at: float) -> Progress:
    progress = Progress.begin("it ended", last_healthy=at - 1, detected=at - 1)
    progress.index, progress.result = index, "Recovered"
    progress.target = PodIdentity(name="w-1", uid="uid-1")
    progress.moments["verified"] = at
    return progress


def test_after_every_strategys_instance_failed_at_once_there_is_a_pause_that_is_told() -> None:
    told, now = Told(), time.time()
    watching = supervisor(told)
    watching._escalation.note(took_over(0, now))
    failure = Failure("no /cmd_vel for 500 ms", now + 1, now + 1.5)
    assert watching._first(failure, "uid-1") == 1
    watching._escalation.note(took_over(1, now))
    assert watching._first(failure, "uid-1") is None
    status, reason, message = told.conditions["Recovering"]
    assert (status, reason) == ("False", "EndsAgainAndAgain")
    assert "no /cmd_vel for 500 ms, as soon as it was in control" in message
    assert ("Warning", "EndsAgainAndAgain") in [(kind, reason) for kind, reason, _ in told.events]
    assert watching._not_before >= now + BACKOFF_FIRST
    assert watching._backoff == 2 * BACKOFF_FIRST
    assert watching._first(failure, "uid-1") == 0, "and then the first one is tried again"

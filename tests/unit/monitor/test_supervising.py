"""The monitor's loop, where it decides with which strategy to begin, and which pod is in control first."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from understudy.api.policies import FailurePolicySpec
from understudy.cluster.client import ApiError
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


class Asked:
    """Instances of a workload of which none runs."""

    def __init__(self, *instances: Instance) -> None:
        self.instances, self.asked, self.away = instances, 0, False

    def of_workload(self) -> Any:
        return self.instances

    async def replace(self, failed: Any) -> None:
        self.asked += 1
        if self.away:
            raise ApiError(503, "Unavailable", "try again")


def at_a_closed_gate(fleet: Asked) -> Supervisor:
    watching = supervisor(Told())
    watching._fleet = cast(Any, fleet)
    watching._gate = cast(Any, SimpleNamespace(state=GateState(epoch=4), exists=True))
    watching._reporter = cast(Any, SimpleNamespace(set=lambda **_: None))
    return watching


@pytest.mark.parametrize("left", [(), (replace(ACTIVE, terminating=True),), (replace(ACTIVE, running=False),)])
async def test_where_nothing_runs_and_nothing_is_recovered_a_pod_is_asked_for(left: tuple[Instance, ...]) -> None:
    # The operator may have scaled the workload's own ReplicaSet to none, for a pod of a shared pool that drove then.
    fleet = Asked(*left)
    watching = at_a_closed_gate(fleet)
    await watching._bootstrap(policy(1), 1000.0)
    assert fleet.asked == 1
    await watching._bootstrap(policy(1), 1000.1)
    assert fleet.asked == 1, "not with every look"
    fleet.away = True
    await watching._bootstrap(policy(1), 1000.0 + BACKOFF_FIRST)
    await watching._bootstrap(policy(1), 1000.0 + 2 * BACKOFF_FIRST)
    assert fleet.asked == 3, "again and again, until one comes"


async def test_a_gate_that_is_opened_after_a_recovery_came_to_nothing_still_tells_which_pods_had_failed() -> None:
    watching = at_a_closed_gate(Asked(replace(ACTIVE, has_agent=False)))
    committed: list[tuple[Instance, Progress]] = []

    class Gate:
        exists = True
        state = GateState(epoch=4, recovery=took_over(0, 1.0).model_copy(update={"failed": [], "result": "Running"}))

        async def commit(self, target: Instance, progress: Progress) -> None:
            committed.append((target, progress))

    for pod in (PodIdentity(name="w-0", uid="uid-0"), PodIdentity(name="w-1", uid="uid-1")):
        Gate.state.recovery.failed.append(pod)  # type: ignore[union-attr]
    watching._gate = cast(Any, Gate())
    watching._reporter = cast(Any, SimpleNamespace(set=lambda **_: None, event=lambda *_: None))
    await watching._bootstrap(policy(1), 1000.0)
    ((target, progress),) = committed
    assert target.name == "w-1"
    assert ([pod.name for pod in progress.failed], progress.result) == (["w-0"], "Failed"), "nobody goes on with it"

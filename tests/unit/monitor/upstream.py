"""What a monitor sees of a workload that its own depends on, for tests: planning depends on localization."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime
from typing import Any

from tests.support.notices import RecordedNotices
from tests.unit.monitor.cluster_objects import NAMESPACE, ClusterObjects, gate_object, settings_of
from understudy.api.kinds.robot_workload import DependencyRecovery, RobotWorkloadStatus
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import Progress, rfc3339
from understudy.kube.client import WORKLOADS, Object
from understudy.monitor.notices import Notices, PublishedStatus
from understudy.monitor.observe.objects.dependencies import Dependencies

NOW = datetime(2026, 11, 22, 14, 2, 11, tzinfo=UTC).timestamp()
BRING_UP = {"yaml": {"set_lifecycle": {"node": "/plan", "state": "active"}}, "within": "20s"}
REINITIALIZE = {"name": "localization", "onRecovery": "Reinitialize"}


def recovery(id: str, *, onset: float, verified: float | None = None, result: str = "Recovered") -> Progress:
    """A recovery of localization."""
    progress = Progress.begin("no /pose for 500 ms", last_healthy=onset, detected=onset + 0.5)
    progress.id, progress.result = id, result  # type: ignore[assignment]
    if verified is not None:
        progress.moments["verified"] = verified
    return progress


def active(*, created: float = NOW - 3600, agent: bool = True) -> Instance:
    """The active instance of planning."""
    return Instance(
        name="planning-1", uid="uid-1", created=rfc3339(created)[:19] + "Z", has_agent=agent, running=True, ready=True
    )


def planning(*depends_on: Object) -> dict[str, Any]:
    """The fields of planning's spec."""
    return {
        "outputs": [{"topic": "/plan", "type": "nav_msgs/msg/Path"}],
        "bringUp": BRING_UP,
        "dependsOn": list(depends_on or (REINITIALIZE,)),
    }


def adopted_status(adopted: str | None) -> PublishedStatus:
    """What the monitor before this one published: after which recovery of localization it did something."""
    before = DependencyRecovery(name="localization", recovery=adopted or "")
    return PublishedStatus(followed=(before,) if adopted is not None else ())


class Upstream:
    """The objects of localization, and the dependencies of planning."""

    def __init__(
        self,
        *depends_on: Object,
        adopted: str | None = None,
        objects: ClusterObjects | None = None,
        dependencies: Dependencies | None = None,
    ) -> None:
        self.objects = objects or ClusterObjects(workload="planning", notices=RecordedNotices(adopted_status(adopted)))
        self.notices = self.objects.notices
        self.objects.put_workload(**planning(*depends_on))
        self.dependencies = dependencies or Dependencies(self.objects.view, self.notices, self.objects.wakeups)
        self.dependencies.follow(settings_of("planning", upstream=[{"name": "localization"}]))

    async def take_in(self, now: float = NOW) -> None:
        """Wait until the last change was seen, and take it in."""
        async with asyncio.timeout(5):
            await self.objects.wakeups.evaluation.wait()
        await asyncio.sleep(0.01)  # there may be several
        self.dependencies.update(now)

    async def _status(self, status: Object, now: float) -> None:
        self.objects.wakeups.evaluation.clear()
        self.objects.client.store(WORKLOADS, NAMESPACE, {"metadata": {"name": "localization"}, "status": status})
        await self.take_in(now)

    async def report_health(self, health: str, *recoveries: Progress, now: float = NOW, **status: Any) -> None:
        """Localization's monitor says how it is."""
        statuses = [one.to_recovery(number) for number, one in enumerate(recoveries, 1)]
        found = RobotWorkloadStatus(health=health, recoveries=statuses[::-1], **status)  # type: ignore[arg-type]
        await self._status(found.to_wire(), now)

    async def write_status(self, notices: Notices, now: float = NOW) -> None:
        """Localization's monitor writes its status."""
        await self._status(notices.status.to_wire(), now)

    async def committed(self, progress: Progress, now: float = NOW) -> None:
        """Its gate is committed by a recovery."""
        kind = self.objects.view.gate_kind
        self.objects.wakeups.evaluation.clear()
        state = GateState(epoch=7, recovery=progress)
        self.objects.client.store(kind.resource, NAMESPACE, gate_object(kind, "localization", state))
        await self.take_in(now)

    def condition(self) -> tuple[str, str, str]:
        """What planning's status says of it."""
        return self.notices.conditions["DependencyFailed"]

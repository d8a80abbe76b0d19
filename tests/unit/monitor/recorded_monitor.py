"""A monitor whose black box records real nodes, for tests."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

from geometry_msgs.msg import Twist
from mcap.reader import make_reader
from rclpy.serialization import serialize_message

from tests.support.notices import RecordedNotices
from tests.unit.kube.memory import MemoryClient
from tests.unit.monitor.cluster_objects import ClusterObjects, parsed_spec
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import GateStatus
from understudy.failover.interfaces import Instance
from understudy.failover.progress import PodIdentity, Progress
from understudy.kube.client import ApiError, Object, Resource
from understudy.monitor.notices import PublishedStatus
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.monitor.report.black_box import BlackBox
from understudy.monitor.report.recording_archive import RecordingArchive
from understudy.ros.observe.sample_rings import SampleRing

BOX: dict[str, Any] = {"window": "10s"}


EVENT = {
    "metadata": {"name": "e"}, "involvedObject": {"kind": "RobotWorkload", "name": "robot-1"},
    "type": "Warning", "reason": "FailureDetected", "message": "no /cmd_vel",
}  # fmt: skip


def policy(black_box: dict[str, Any] | None) -> FailurePolicySpec:
    health = {"topic": {"name": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "gap": "500ms"}}
    spec: dict[str, Any] = {"monitoring": {"yaml": health}, "strategies": [{"type": "Restart"}], "blackBox": black_box}
    return FailurePolicySpec.model_validate(spec)


class Recorded(HealthObserver):
    """A real observer whose ring a test can look into."""

    ring: SampleRing | None = None

    def record(self, ring: SampleRing | None) -> None:
        self.ring = ring
        super().record(ring)


class Cluster(MemoryClient):
    """Has Events, as an API server does."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[str] = []
        self.refuses = False

    async def list(
        self,
        resource: Resource,
        namespace: str | None = None,
        *,
        labels: str | None = None,
        fields: str | None = None,
        cached: bool = False,
    ) -> Object:
        self.asked.append(fields or "")
        if self.refuses:
            raise ApiError(403, "Forbidden", "events is forbidden")
        now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        return {"items": [{**EVENT, "lastTimestamp": now}] if "RobotWorkload" in (fields or "") else []}


class Monitored:
    """A monitor's black box, a real node that commands beside it, and what the monitor's loop does with both."""

    def __init__(self, folder: Path) -> None:
        self.observer, self.cluster = Recorded(), Cluster()
        self.notices = RecordedNotices(PublishedStatus(health="Healthy", active="a", gate=GateStatus(epoch=3)))
        self.objects = ClusterObjects(workload="robot-1", client=self.cluster, notices=self.notices)
        self.view = self.objects.view
        self.objects.put_workload()
        self.objects.put_policy(policy(BOX))
        self.objects.put_pods(Instance("a", "1"))
        self.archive = RecordingArchive(folder)
        self.box = BlackBox(self.view, self.observer, self.notices, self.archive)
        self.publisher = self.observer.graph.node.create_publisher(Twist, "/cmd_vel", 10)
        self.sent: list[bytes] = []
        self.observer.follow(policy(BOX), parsed_spec())

    def drive(self, speed: float) -> None:
        message = Twist()
        message.linear.x = speed
        self.publisher.publish(message)
        self.sent.append(bytes(serialize_message(message)))

    async def look(self, seconds: float) -> None:
        """As the monitor's loop does."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.observer.drain([], "")
            self.observer.verdict(now=time.time(), since=time.time())
            await asyncio.sleep(0.02)

    async def driven(self, count: int = 20) -> None:
        """Until so many of its commands were received."""
        before = self.received
        end = time.monotonic() + 20
        while self.received < before + count:
            assert time.monotonic() < end
            self.drive(len(self.sent) / 100)
            await self.look(0.02)

    @property
    def received(self) -> int:
        record = self.observer.observations.topic("/cmd_vel")
        return record.count if record is not None else 0

    def fail(self, **more: Any) -> Progress:
        now = time.time()
        progress = Progress.begin(
            "no /cmd_vel", last_healthy=now - 0.5, detected=now, failed=[PodIdentity(name="a", uid="1")], **more
        )
        self.notices.set(health="Failed")
        self.box.begin(progress)
        return progress

    def recovered(self, progress: Progress) -> None:
        progress.result, progress.strategy = "Recovered", "Restart"
        progress.moments["routed"] = time.time()
        self.notices.set(health="Healthy")
        self.box.end(progress)
        self.notices.record(progress)

    async def recorded(self, count: int = 1) -> None:
        end = time.monotonic() + 20
        while len(self.archive.recordings) < count:
            assert time.monotonic() < end
            await self.look(0.05)

    def messages(self, topic: str, recording: int = 0) -> list[bytes]:
        with self.archive.path(self.archive.recordings[recording]).open("rb") as file:
            return [message.data for _, _, message in make_reader(file).iter_messages(topics=[topic])]

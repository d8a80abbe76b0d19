"""The monitor joins poses that it keeps with real odometry, and says when it can't."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message

from tests.unit.dds import isolate_discovery
from tests.unit.monitor.state_monitor import POSE, STANDBY, Monitor, next_monitor
from understudy.api.kinds.robot_workload import Recovery
from understudy.api.kinds.state_spec import RestoredState, State
from understudy.api.protocol.kept_state import Motion
from understudy.monitor.act.instances import state_manager as module
from understudy.ros.runtime.graph_node import Graph
from understudy.state.state_store import StateStore

pytestmark = pytest.mark.ros

STATE = State.model_validate(
    {
        "keep": [{"topic": "/amcl_pose", "type": POSE, "restoreTo": "/initialpose", "carriedBy": {"topic": "/odom"}}],
        "margin": "100ms",
        "period": "50ms",
    }
)


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    isolate_discovery(monkeypatch)
    made = Graph("keeper")
    yield made
    made.close()


class Robot:
    """A robot that drives at 1 m/s along x, as the clock says; map and odometry are the same."""

    def __init__(self, graph: Graph) -> None:
        self._node = graph.node
        self.started_at = time.time()
        """When it was at 0."""
        self._publishers: dict[type, Any] = {}
        self.restart_odometry()
        self.publish_poses(QoSProfile(depth=1))

    def restart_odometry(self) -> None:
        """Have another publisher publish its odometry, from 0."""
        self.started_at = time.time()
        self._publish(Odometry, "/odom", QoSProfile(depth=10))

    def publish_poses(self, qos: QoSProfile) -> None:
        """Have another publisher publish its poses."""
        self._publish(PoseWithCovarianceStamped, "/amcl_pose", qos)

    def _publish(self, type_: type, topic: str, qos: QoSProfile) -> None:
        if (before := self._publishers.get(type_)) is not None:
            self._node.destroy_publisher(before)
        self._publishers[type_] = self._node.create_publisher(type_, topic, qos)

    def is_received(self, type_: type) -> bool:
        """Whether somebody receives its messages of a type."""
        return self._publishers[type_].get_subscription_count() > 0

    def say(self, *types: type) -> None:
        """Say where it is, in messages of these types."""
        now = time.time_ns()
        for type_ in types or (Odometry, PoseWithCovarianceStamped):
            message = type_()
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(now, 1_000_000_000)
            message.pose.pose.position.x = now * 1e-9 - self.started_at
            message.pose.pose.orientation.w = 1.0
            self._publishers[type_].publish(message)


@pytest.fixture
def robot(graph: Graph) -> Robot:
    return Robot(graph)


@pytest.fixture
async def monitor(graph: Graph, tmp_path: Path) -> Monitor:
    made = Monitor(graph, tmp_path)
    made.state = STATE
    return made


def motion(monitor: Monitor, onset: float | None = None) -> Motion | None:
    """What would carry the pose now."""
    samples = monitor.state_manager.select(time.time() if onset is None else onset).samples
    return samples[0].motion if samples else None


def carried(monitor: Monitor) -> bool:
    found = motion(monitor)
    return found is not None and not found.missing


async def test_a_pose_is_kept_with_the_odometry_of_its_time(monitor: Monitor, robot: Robot) -> None:
    await monitor.until(lambda: carried(monitor), each=robot.say)
    end = time.monotonic() + 1.0
    await monitor.until(lambda: time.monotonic() > end and carried(monitor), each=robot.say)
    onset, end = time.time(), time.monotonic() + 1.0
    await monitor.until(lambda: time.monotonic() > end, each=robot.say)
    (sample,) = monitor.state_manager.select(onset).samples
    found = sample.motion
    assert found is not None
    kept = deserialize_message(sample.data, PoseWithCovarianceStamped).pose.pose.position.x
    assert found.then.x == pytest.approx(kept, abs=0.02), "where odometry had it when the pose was so"
    assert robot.started_at + kept <= onset - 0.1, "from before the margin"
    assert found.last.x - found.then.x >= 0.9, "it has driven on since"
    assert found.driven == pytest.approx(found.last.x - found.then.x, abs=0.05)
    assert (found.missing, len(found.writer)) == ("", 16)


async def test_a_latched_pose_from_before_the_health_is_propagated_later(monitor: Monitor, robot: Robot) -> None:
    """Said once, and held for late joiners: it counts from when the health tree first holds."""
    robot.publish_poses(QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    monitor.health = "Starting"

    async def drive(seconds: float) -> None:
        end = time.monotonic() + seconds
        await monitor.until(lambda: time.monotonic() > end, each=lambda: robot.say(Odometry))

    await monitor.until(lambda: robot.is_received(Odometry) and robot.is_received(PoseWithCovarianceStamped))
    await drive(0.5)
    robot.say()
    await drive(4.0)  # several times over what is not needed any more is forgotten
    assert motion(monitor) is None, "nothing was healthy yet"
    monitor.health = "Healthy"
    await monitor.until(lambda: carried(monitor), each=lambda: robot.say(Odometry))


async def test_odometry_is_watched_during_a_recovery(monitor: Monitor, robot: Robot) -> None:
    await monitor.until(lambda: carried(monitor), each=robot.say)
    onset = time.time()
    before = motion(monitor, onset)
    assert before is not None
    async with monitor.state_manager.recovering():
        end = time.monotonic() + 20
        while time.time() < onset + 2.5:  # nobody asks for the state meanwhile
            robot.say(Odometry)
            await asyncio.sleep(0.02)
        after = motion(monitor, onset)
        assert after is not None
        assert after.last.x >= before.last.x + 2.0
        assert after.blind < before.blind + 2.0, "all came of it, not only what waits in a queue at the end"
        robot.restart_odometry()
        while not (found := motion(monitor, onset)) or not found.missing:
            assert time.monotonic() < end
            robot.say(Odometry)
            await asyncio.sleep(0.05)
    assert_golden("monitor", found.missing, "/odom", "another publisher")


async def test_the_odometry_of_a_pose_survives_a_restart_of_the_monitor(
    monitor: Monitor, robot: Robot, tmp_path: Path
) -> None:
    await monitor.until(lambda: carried(monitor), each=robot.say)
    onset = time.time()
    wanted = motion(monitor, onset)
    assert wanted is not None

    def persisted() -> bool:
        with next_monitor(tmp_path) as later:
            later.state_manager.take(STATE, {}, "w-1")
            found = motion(later, onset)
            return found is not None and found.then == wanted.then

    await monitor.until(lambda: StateStore(tmp_path).load() and persisted())


async def test_a_pose_that_cannot_be_propagated_is_reported(
    monitor: Monitor, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "UNCARRIED_FOR", 0.3)
    await monitor.until(
        lambda: monitor.notices.conditions.get("StateKept", ("", ""))[1] == "NotCarried",
        each=lambda: robot.say(PoseWithCovarianceStamped),
    )
    status, _, message = monitor.notices.conditions["StateKept"]
    assert status == "False"
    assert_golden("monitor", message, "/amcl_pose", "/odom")
    await monitor.until(lambda: monitor.notices.conditions["StateKept"][0] == "True", each=robot.say)


async def test_a_standby_receives_propagated_poses(monitor: Monitor, robot: Robot) -> None:
    monitor.waiting = [(STANDBY, 0.1)]
    await monitor.until(
        lambda: any(
            s.motion and not s.motion.missing for _, kept_state in monitor.agents.restored for s in kept_state.samples
        ),
        each=robot.say,
    )


async def test_the_state_restored_in_a_recovery_is_reported(monitor: Monitor) -> None:
    restored = RestoredState(name="/amcl_pose", restored=True, age_seconds=0.75, carried_metres=0.4321)
    recovery = Recovery(id="1", reason="x", result="Recovered", to_pod="w-2", state=[restored])
    monitor.state_manager.report_restored(recovery)
    status, reason, message = monitor.notices.conditions["StateRestored"]
    assert (status, reason) == ("True", "Restored")
    assert_golden("monitor", message, "w-2", "/amcl_pose", "0.8 s", "0.43 m")
    uncertain = restored.model_copy(
        update={
            "message": "/odom was missing for 4.0 s of the time since the pose was recorded, so the restored pose may be inaccurate"
        }
    )
    monitor.state_manager.report_restored(recovery.model_copy(update={"state": [uncertain]}))
    status, reason, message = monitor.notices.conditions["StateRestored"]
    assert (status, reason) == ("True", "Restored")
    assert_golden("monitor", message, "w-2", "/amcl_pose", "0.8 s", "0.43 m", "/odom", "4.0 s")
    assert not monitor.notices.events
    missing = RestoredState(
        name="/amcl_pose", restored=True, age_seconds=0.75, message="the pose cannot be propagated with /odom"
    )
    monitor.state_manager.report_restored(recovery.model_copy(update={"state": [missing]}))
    text = "w-2 was given /amcl_pose (0.8 s old). /amcl_pose: the pose cannot be propagated with /odom."
    assert monitor.notices.conditions["StateRestored"] == ("False", "NotCarried", text)
    assert monitor.notices.events == [("Warning", "StateNotCarried", text)]

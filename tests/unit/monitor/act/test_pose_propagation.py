"""The monitor joins poses that it keeps with real odometry, and says when it can't."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message

from tests.unit.dds import keep_to_itself
from tests.unit.monitor.state_monitor import POSE, STANDBY, Monitor
from understudy.api.kinds.robot_workload import Recovery
from understudy.api.kinds.state_spec import RestoredState, State
from understudy.api.protocol.kept_state import Motion
from understudy.monitor.act.instances import state_keeping as module
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
    keep_to_itself(monkeypatch)
    made = Graph("keeper")
    yield made
    made.close()


class Robot:
    """A robot that drives at 1 m/s along x, as the clock says; map and odometry are the same."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._begun = time.time()
        self._publishers: dict[type, Any] = {Odometry: None}
        self.begin_anew()
        self._publishers[PoseWithCovarianceStamped] = graph.node.create_publisher(
            PoseWithCovarianceStamped, "/amcl_pose", 1
        )

    def begin_anew(self) -> None:
        """Its odometry is published by another publisher, from 0."""
        if self._publishers[Odometry] is not None:
            self._graph.node.destroy_publisher(self._publishers[Odometry])
        self._publishers[Odometry] = self._graph.node.create_publisher(Odometry, "/odom", 10)

    def say(self, *types: type) -> None:
        """Say where it is, in messages of these types."""
        now = time.time_ns()
        for type_ in types or (Odometry, PoseWithCovarianceStamped):
            message = type_()
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(now, 1_000_000_000)
            message.pose.pose.position.x = now * 1e-9 - self._begun
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
    samples = monitor.keeping.select(time.time() if onset is None else onset).samples
    return samples[0].motion if samples else None


def carried(monitor: Monitor) -> bool:
    found = motion(monitor)
    return found is not None and not found.missing


async def test_a_pose_is_kept_with_where_odometry_was_then(monitor: Monitor, robot: Robot) -> None:
    await monitor.until(lambda: carried(monitor), each=robot.say)
    end = time.monotonic() + 1.0
    await monitor.until(lambda: time.monotonic() > end and carried(monitor), each=robot.say)
    onset, end = time.time(), time.monotonic() + 1.0
    await monitor.until(lambda: time.monotonic() > end, each=robot.say)
    (sample,) = monitor.keeping.select(onset).samples
    found = sample.motion
    assert found is not None
    kept = deserialize_message(sample.data, PoseWithCovarianceStamped).pose.pose.position.x
    assert found.then.x == pytest.approx(kept, abs=0.02), "where odometry had it when the pose was so"
    assert robot._begun + kept <= onset - 0.1, "from before the margin"
    assert found.last.x - found.then.x >= 0.9, "it has driven on since"
    assert found.driven == pytest.approx(found.last.x - found.then.x, abs=0.05)
    assert (found.missing, len(found.writer)) == ("", 16)


async def test_a_pose_from_before_it_is_healthy_is_carried_once_it_is(
    monitor: Monitor, robot: Robot, graph: Graph
) -> None:
    """Said once, and held for late joiners: it counts from when the health tree first holds."""
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    robot._graph.node.destroy_publisher(robot._publishers[PoseWithCovarianceStamped])
    robot._publishers[PoseWithCovarianceStamped] = graph.node.create_publisher(
        PoseWithCovarianceStamped, "/amcl_pose", latched
    )
    monitor.health = "Starting"
    carrier = monitor.keeping._carrier
    await monitor.until(
        lambda: "/odom" in carrier._odometry and carrier._odometry["/odom"].track.last, each=lambda: robot.say(Odometry)
    )
    robot.say()
    await monitor.until(lambda: carrier._poses["/amcl_pose"].moments, each=lambda: robot.say(Odometry))
    end = time.monotonic() + 3.0  # several times over what is not needed any more is forgotten
    await monitor.until(lambda: time.monotonic() > end, each=lambda: robot.say(Odometry))
    monitor.health = "Healthy"
    await monitor.until(lambda: carried(monitor), each=lambda: robot.say(Odometry))


async def test_odometry_is_watched_during_a_recovery(monitor: Monitor, robot: Robot) -> None:
    await monitor.until(lambda: carried(monitor), each=robot.say)
    onset = time.time()
    before = motion(monitor, onset)
    assert before is not None
    async with monitor.keeping.recovering():
        end = time.monotonic() + 20
        while monitor.keeping._carrier._odometry["/odom"].track.last.pose.x < before.last.x + 0.5:
            assert time.monotonic() < end
            robot.say(Odometry)
            await asyncio.sleep(0.05)
        robot.begin_anew()
        robot._begun = time.time()
        while not (found := motion(monitor, onset)) or not found.missing:
            assert time.monotonic() < end
            robot.say(Odometry)
            await asyncio.sleep(0.05)
    assert (
        found.missing == "it cannot be propagated by /odom: odometry began again since: it comes from another publisher"
    )


async def test_it_outlasts_the_monitor(monitor: Monitor, robot: Robot, graph: Graph, tmp_path: Path) -> None:
    await monitor.until(lambda: carried(monitor), each=robot.say)
    onset = time.time()
    wanted = motion(monitor, onset)
    assert wanted is not None

    def persisted() -> bool:
        later = Monitor(graph, tmp_path)
        later.keeping.take(STATE, {}, "w-1")
        found = motion(later, onset)
        later.keeping._capturing.close()
        later.keeping._odometry.close()
        return found is not None and found.then == wanted.then

    await monitor.until(lambda: StateStore(tmp_path).load() and persisted())


async def test_a_pose_that_can_not_be_carried_is_told(
    monitor: Monitor, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "UNCARRIED_FOR", 0.3)
    await monitor.until(
        lambda: monitor.told.conditions.get("StateKept", ("", ""))[1] == "NotCarried",
        each=lambda: robot.say(PoseWithCovarianceStamped),
    )
    status, _, message = monitor.told.conditions["StateKept"]
    assert status == "False"
    assert "/amcl_pose: it cannot be propagated by /odom: nothing has come on it" in message
    await monitor.until(lambda: monitor.told.conditions["StateKept"][0] == "True", each=robot.say)


async def test_a_standby_is_kept_up_with_what_is_carried(monitor: Monitor, robot: Robot) -> None:
    monitor.waiting = [(STANDBY, 0.1)]
    await monitor.until(
        lambda: any(s.motion and not s.motion.missing for _, given in monitor.agents.given for s in given.samples),
        each=robot.say,
    )


async def test_what_became_of_it_in_a_recovery_is_told(monitor: Monitor) -> None:
    given = RestoredState(name="/amcl_pose", restored=True, age_seconds=0.75, carried_metres=0.4321)
    recovery = Recovery(id="1", reason="x", result="Recovered", to_pod="w-2", state=[given])
    monitor.keeping.report_restored(recovery)
    assert monitor.told.conditions["StateRestored"] == (
        "True",
        "Restored",
        "w-2 was given /amcl_pose (0.8 s old, carried by 0.43 m).",
    )
    uncertain = given.model_copy(
        update={"message": "/odom was not watched for 4.0 s of the time over which it was propagated"}
    )
    monitor.keeping.report_restored(recovery.model_copy(update={"state": [uncertain]}))
    assert monitor.told.conditions["StateRestored"] == (
        "True",
        "Restored",
        "w-2 was given /amcl_pose (0.8 s old, carried by 0.43 m). "
        "/amcl_pose: /odom was not watched for 4.0 s of the time over which it was propagated.",
    )
    assert not monitor.told.events
    missing = RestoredState(
        name="/amcl_pose", restored=True, age_seconds=0.75, message="it cannot be propagated by /odom"
    )
    monitor.keeping.report_restored(recovery.model_copy(update={"state": [missing]}))
    text = "w-2 was given /amcl_pose (0.8 s old). /amcl_pose: it cannot be propagated by /odom."
    assert monitor.told.conditions["StateRestored"] == ("False", "NotCarried", text)
    assert monitor.told.events == [("Warning", "StateNotCarried", text)]

"""A kept pose is given as it is at the moment it is given: where real odometry has taken the robot by then."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest

from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message, serialize_message

from tests.unit.dds import isolate_discovery
from understudy.agent.restoration.pose_restoration import composed
from understudy.agent.restoration.state_restoration import StateRestorer
from understudy.api.protocol.kept_state import KeptSample, KeptState, Motion, RestoreReport
from understudy.kinematics.pose_decoding import Reading
from understudy.kinematics.poses import DRIFT, Pose
from understudy.ros.actions.instance_calls import InstanceCaller
from understudy.ros.runtime.graph_node import Graph

pytestmark = pytest.mark.ros

POSE, ODOMETRY = "geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry"
WITHIN = 25.0
"""Seconds for what is done at once on a machine that is not busy."""


def planar(x: float, y: float = 0.0, heading: float = 0.0) -> Pose:
    return Pose(x, y, 0.0, 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))


class Wheels:
    """A robot that says its odometry from a thread of its own, until it is stopped."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._publisher = graph.node.create_publisher(Odometry, "/odom", 10)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.pose = planar(2.0)
        self._thread.start()

    @property
    def gid(self) -> bytes:
        """What its messages' writer is known by."""
        (publisher,) = self._graph.publishers("/odom")
        return publisher.gid

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(0.02):
            message = Odometry()
            message.header.frame_id, message.child_frame_id = "odom", "base_link"
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)
            at, turn = message.pose.pose.position, message.pose.pose.orientation
            at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w = self.pose
            self._publisher.publish(message)


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    isolate_discovery(monkeypatch)
    made = Graph("robot")
    yield made
    made.close()


@pytest.fixture
def wheels(graph: Graph) -> Iterator[Wheels]:
    made = Wheels(graph)
    yield made
    made.stop()


@pytest.fixture
def caller(graph: Graph) -> Iterator[InstanceCaller]:
    made = InstanceCaller("restorer")
    yield made
    made.close()


def kept(motion: Motion | None, *, stamp: str = "kept") -> KeptSample:
    """The robot was at (10, 5) on the map, looking along its y."""
    message = PoseWithCovarianceStamped()
    message.header.frame_id = "map"
    message.header.stamp.sec = 42
    message.pose.pose.position.x, message.pose.pose.position.y = 10.0, 5.0
    message.pose.pose.orientation.z = message.pose.pose.orientation.w = math.sqrt(0.5)
    message.pose.covariance[0] = message.pose.covariance[7] = 0.01
    data = serialize_message(message)
    return KeptSample("/amcl_pose", POSE, time.time() - 3, data, to="/initialpose", stamp=stamp, motion=motion)


def motion(gid: bytes, **fields: object) -> Motion:
    """It drove a metre along odometry's x since, half of which the monitor has seen."""
    pose_time = time.time_ns() - 1_000_000_000
    usual = Motion(
        topic="/odom",
        type=ODOMETRY,
        writer=gid,
        frame="odom",
        child="base_link",
        then=planar(1.0),
        last=planar(1.5),
        stamp=pose_time,
        received=pose_time * 1e-9,
        driven=0.5,
    )
    return replace(usual, **fields)


async def restored(
    caller: InstanceCaller, localizer: Callable[[], None], sample: KeptSample
) -> tuple[RestoreReport, PoseWithCovarianceStamped]:
    """Returns the result of the restoration, and what the instance received."""
    localizer()
    await caller.bring_to("/localizer", "inactive", WITHIN)
    report = await StateRestorer(lambda: caller).restore(KeptState((sample,)), within=WITHIN)
    taken = await caller.wait_sample("/amcl_pose", POSE, WITHIN)
    return report, deserialize_message(taken.data, PoseWithCovarianceStamped)


async def test_a_pose_is_propagated_to_the_time_of_its_restoration(
    localizer: Callable[[], None], caller: InstanceCaller, wheels: Wheels
) -> None:
    before = time.time()
    report, got = await restored(caller, localizer, kept(motion(wheels.gid)))
    (entry,) = report.restored
    assert (entry.name, entry.carried, entry.note) == ("/amcl_pose", pytest.approx(1.0), "")
    assert report.not_restored == ()
    at, turn = got.pose.pose.position, got.pose.pose.orientation
    assert (at.x, at.y) == (pytest.approx(10.0), pytest.approx(6.0)), "ahead, and not along odometry's x"
    assert (turn.z, turn.w) == (pytest.approx(math.sqrt(0.5)), pytest.approx(math.sqrt(0.5)))
    assert got.header.frame_id == "map"
    assert before < got.header.stamp.sec + got.header.stamp.nanosec * 1e-9 <= time.time(), "odometry's"
    assert got.pose.covariance[0] == pytest.approx(0.01 + DRIFT**2)


async def test_a_pose_is_restored_as_kept_if_odometry_has_another_source(
    localizer: Callable[[], None], caller: InstanceCaller, wheels: Wheels
) -> None:
    report, got = await restored(caller, localizer, kept(motion(b"x" * 16)))
    (entry,) = report.restored
    assert entry.carried is None
    assert_golden("agent", entry.note, "/odom", "another publisher")
    assert (got.header.stamp.sec, got.pose.pose.position.y, got.pose.covariance[0]) == (42, 5.0, 0.01)


async def test_a_pose_is_restored_as_kept_if_odometry_is_silent(
    localizer: Callable[[], None], caller: InstanceCaller
) -> None:
    report, got = await restored(caller, localizer, kept(motion(b"x" * 16)))
    (entry,) = report.restored
    assert_golden("agent", entry.note, "/odom", "5 s")
    assert got.pose.pose.position.y == 5.0


async def test_a_pose_is_restored_as_kept_if_the_monitor_requests_it(
    localizer: Callable[[], None], caller: InstanceCaller, wheels: Wheels
) -> None:
    missing = Motion("/odom", ODOMETRY, missing="the pose cannot be propagated with /odom: nobody publishes it")
    report, got = await restored(caller, localizer, kept(missing))
    assert_golden("agent", report.restored[0].note, "/odom", "nobody publishes")
    assert got.pose.pose.position.y == 5.0


async def test_a_pose_that_must_be_propagated_and_cannot_be_is_not_restored(
    localizer: Callable[[], None], caller: InstanceCaller, wheels: Wheels
) -> None:
    localizer()
    await caller.bring_to("/localizer", "inactive", WITHIN)
    sample = kept(motion(wheels.gid, last=planar(500.0), required=True))
    report = await StateRestorer(lambda: caller).restore(KeptState((sample,)), within=WITHIN)
    assert report.restored == ()
    assert_golden("agent", report.problem.partition(" within ")[0], "/amcl_pose", "/odom", "498.00 m")


async def test_a_type_that_is_not_installed_propagates_nothing(
    localizer: Callable[[], None], caller: InstanceCaller, wheels: Wheels
) -> None:
    report, _ = await restored(caller, localizer, kept(motion(wheels.gid, type="wheel_msgs/msg/Odometry")))
    assert "wheel_msgs/msg/Odometry is not installed" in report.restored[0].note


async def test_unobserved_time_is_reported(
    localizer: Callable[[], None], caller: InstanceCaller, wheels: Wheels
) -> None:
    report, _ = await restored(caller, localizer, kept(motion(wheels.gid, blind=4.0)))
    assert_golden("agent", report.restored[0].note, "/odom", "4.0 s")
    assert report.restored[0].carried == pytest.approx(1.0)


# -- what is composed -----------------------------------------------------------------------------------------------


def now(child: str = "base_link") -> Reading:
    return Reading(1_000_000_007, "odom", child, planar(2.0))


def test_a_pose_without_covariance_is_propagated() -> None:
    message = PoseStamped()
    message.pose.position.x, message.pose.orientation.w = 3.0, 1.0
    sample = KeptSample("/pose", "geometry_msgs/msg/PoseStamped", 1.0, serialize_message(message), to="/pose")
    got = deserialize_message(composed(sample, planar(1.0), now(), driven=1.0, turned=0.0), PoseStamped)
    assert (got.pose.position.x, got.header.stamp.sec, got.header.stamp.nanosec) == (4.0, 1, 7)


def test_a_pose_of_another_body_is_not_propagated() -> None:
    message = Odometry(child_frame_id="arm")
    message.pose.pose.orientation.w = 1.0
    sample = KeptSample("/global", ODOMETRY, 1.0, serialize_message(message), to="/global")
    with pytest.raises(ValueError, match="that odometry is of frame base_link, but /global is of frame arm"):
        composed(sample, planar(1.0), now(), driven=1.0, turned=0.0)
    composed(sample, planar(1.0), now(""), driven=1.0, turned=0.0)


def test_a_stamp_now_is_the_present_time() -> None:
    got = deserialize_message(
        composed(kept(None, stamp="now"), planar(1.0), now(), driven=1.0, turned=0.0), PoseWithCovarianceStamped
    )
    assert abs(got.header.stamp.sec - time.time()) < 60


def test_a_kept_message_without_an_orientation_is_not_a_pose() -> None:
    message = PoseStamped()
    message.pose.orientation.w = 0.0
    sample = KeptSample("/pose", "geometry_msgs/msg/PoseStamped", 1.0, serialize_message(message), to="/pose")
    with pytest.raises(ValueError, match="is not a rotation"):
        composed(sample, planar(1.0), now(), driven=1.0, turned=0.0)

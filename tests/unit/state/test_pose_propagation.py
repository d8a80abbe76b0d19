"""A kept pose is joined with odometry's motion since, over the monitor's restart too, or it is said why not."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from tests.support.golden import assert_golden
from understudy.api.kinds.state_spec import RestoredState, State
from understudy.api.protocol.kept_state import KeptSample, KeptState, Motion, Restored, RestoreReport
from understudy.failover.progress import Progress
from understudy.kinematics.poses import Pose
from understudy.state.pose_propagation import Carrier
from understudy.state.state_capture import Key, Version
from understudy.state.state_store import StateStore

ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped"
START = 1_700_000_000.0
ROBOT, OTHER = b"r" * 16, b"o" * 16


def policy(**carried_by: object) -> State:
    by = {"topic": "/odom"} | carried_by
    pose = {"topic": "/amcl_pose", "type": POSE, "restoreTo": "/initialpose", "carriedBy": by}
    return State.model_validate({"keep": [pose, {"topic": "/map", "restoreTo": "/map"}]})


def header(stamp: float) -> bytes:
    whole, rest = divmod(round(stamp * 1e9), 1_000_000_000)
    return b"\0\1\0\0" + struct.pack("<iI", whole, rest)


def text(data: bytes, string: str) -> bytes:
    data += b"\0" * (-len(data) % 4)
    return data + struct.pack("<I", len(string) + 1) + string.encode() + b"\0"


def odometry(x: float, stamp: float, heading: float = 0.0) -> bytes:
    """As ROS serializes it, up to where the pose ends."""
    data = text(text(header(stamp), "odom"), "base_link")
    data += b"\0" * ((4 - len(data)) % 8)
    return data + struct.pack("<7d", x, 0.0, 0.0, 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))


def pose(stamp: float) -> bytes:
    return text(header(stamp), "map")


def kept(stamp: float, topic: str = "/amcl_pose") -> KeptSample:
    return KeptSample(topic, POSE, stamp + 0.02, pose(stamp), to="/initialpose")


def drive(
    carrier: Carrier,
    begin: float,
    end: float,
    *,
    speed: float = 0.5,
    stamps: Sequence[float] = (),
    writer: bytes = ROBOT,
) -> None:
    """Odometry ten times a second, and a pose of some moments, each heard a little later; seconds since START."""
    for i in range(round((end - begin) * 10) + 1):
        t = begin + i / 10
        for moment in stamps:
            if t <= moment + 0.02 < t + 0.1:
                carrier.kept("/amcl_pose", pose(START + moment), taken_at=START + moment + 0.02)
        data = odometry(speed * t, START + t)
        carrier.moved("/odom", ODOMETRY, data, received_at=START + t + 0.01, writer=writer)
        carrier.settle(START + t + 0.05)


def motion(carrier: Carrier, moment: float, now: float) -> Motion:
    (sample,) = carrier.carry(KeptState((kept(START + moment),)), START + now).samples
    assert sample.motion is not None
    return sample.motion


@pytest.fixture
def carrier() -> Carrier:
    made = Carrier()
    made.follow(policy())
    return made


def test_the_motion_contains_the_odometry_at_the_time_of_the_pose_and_now(carrier: Carrier) -> None:
    drive(carrier, 0.0, 3.0, stamps=[1.04])
    found = motion(carrier, 1.04, 3.05)
    assert found.missing == ""
    assert found.then.place == pytest.approx((0.52, 0.0, 0.0), abs=1e-6)
    assert found.last.place == pytest.approx((1.5, 0.0, 0.0))
    assert (found.frame, found.child, found.writer) == ("odom", "base_link", ROBOT)
    assert found.driven == pytest.approx(0.98, abs=0.03)
    assert found.stamp == round((START + 3.0) * 1e9)
    assert found.blind == 0.0


def test_a_pose_that_is_newer_than_odometry_waits_for_it(carrier: Carrier) -> None:
    drive(carrier, 0.0, 1.0)
    carrier.kept("/amcl_pose", pose(START + 1.05), taken_at=START + 1.07)
    carrier.settle(START + 1.1)
    drive(carrier, 1.1, 1.5)
    assert motion(carrier, 1.05, 1.5).then.x == pytest.approx(0.525)


def test_the_odometry_of_a_pose_is_kept_as_long_as_the_pose(carrier: Carrier) -> None:
    drive(carrier, 0.0, 60.0, stamps=[1.0, 2.0])
    assert motion(carrier, 2.0, 60.0).then.x == pytest.approx(1.0)
    carrier.prune({Key("Topic", "/amcl_pose"): [Version(START + 2.02, START + 2.02, pose(START + 2.0), POSE)]})
    assert motion(carrier, 2.0, 60.0).missing == ""
    assert_golden("kept_state", motion(carrier, 1.0, 60.0).missing, "/odom")


def test_a_topic_that_is_not_propagated_is_unchanged(carrier: Carrier) -> None:
    drive(carrier, 0.0, 1.0, stamps=[0.5])
    chart = KeptSample("/map", "nav_msgs/msg/OccupancyGrid", START, b"", to="/map")
    state = KeptState((chart,))
    assert carrier.carry(state, START + 1) == state
    assert Carrier().carry(KeptState((kept(START),)), START + 1).samples[0].motion is None


def test_missing_odometry_is_reported(carrier: Carrier) -> None:
    carrier.kept("/amcl_pose", pose(START), taken_at=START)
    assert_golden("kept_state", motion(carrier, 0.0, 5.0).missing, "/odom", "no message has arrived")
    carrier.note({"/odom": "nobody publishes it"})
    assert_golden("kept_state", motion(carrier, 0.0, 5.0).missing, "/odom", "nobody publishes")
    reasons = carrier.reasons(KeptState((kept(START),)), START + 5)
    assert list(reasons) == ["/amcl_pose"]
    assert_golden("kept_state", reasons["/amcl_pose"], "/odom", "nobody publishes")


def test_invalid_odometry_is_reported(carrier: Carrier) -> None:
    carrier.moved("/odom", ODOMETRY, b"\0\1\0\0", received_at=START, writer=ROBOT)
    assert "its message cannot be read: " in motion(carrier, 0.0, 1.0).missing


@pytest.mark.parametrize(
    ("x", "writer", "reason"),
    [
        (1.5, OTHER, "another publisher took over this topic"),
        (0.0, ROBOT, "the odometry jumped by 1.50 m within 0.10 s"),
    ],
)
def test_a_restart_of_odometry_makes_earlier_poses_unusable(
    carrier: Carrier, x: float, writer: bytes, reason: str
) -> None:
    drive(carrier, 0.0, 3.0, stamps=[1.0])
    carrier.moved("/odom", ODOMETRY, odometry(x, START + 3.1), received_at=START + 3.11, writer=writer)
    assert_golden("kept_state", motion(carrier, 1.0, 3.2).missing, "/odom", f"{reason}")
    for i in range(2, 10):
        data = odometry(x + 0.05 * i, START + 3 + i / 10)
        carrier.moved("/odom", ODOMETRY, data, received_at=START + 3.01 + i / 10, writer=writer)
    carrier.kept("/amcl_pose", pose(START + 3.5), taken_at=START + 3.52)
    assert motion(carrier, 3.5, 4.0).missing == "", "what came after it is carried again"


def test_a_pose_that_must_be_propagated_and_cannot_be_is_omitted() -> None:
    carrier = Carrier()
    carrier.follow(policy(required=True))
    state = carrier.carry(KeptState((kept(START),)), START + 1)
    assert state.samples == ()
    assert [entry.name for entry in state.left_out] == ["/amcl_pose"]
    assert_golden("kept_state", state.left_out[0].reason, "/odom", "no message has arrived")
    assert state.left_out[0].failed, "a tree that restores it must not go on"


def test_a_gap_in_odometry_is_reported(carrier: Carrier) -> None:
    drive(carrier, 0.0, 2.0, stamps=[1.0])
    drive(carrier, 6.0, 7.0, speed=0.5)
    assert motion(carrier, 1.0, 7.05).blind == pytest.approx(4.0)
    assert motion(carrier, 1.0, 10.0).blind == pytest.approx(4.0 + 2.99, abs=0.01)


def restarted(carrier: Carrier, folder: Path, state: State | None = None) -> Carrier:
    """What an earlier monitor's carrier is in the next one."""
    StateStore(folder).save(carrier.packed(time.time()))
    found: Mapping[Key, list[Version]] = StateStore(folder).load()
    later = Carrier()
    later.follow(state or policy())
    later.adopt(found)
    return later


def test_propagation_continues_after_a_restart_of_the_monitor(carrier: Carrier, tmp_path: Path) -> None:
    drive(carrier, 0.0, 3.0, stamps=[1.0])
    later = restarted(carrier, tmp_path)
    drive(later, 5.0, 6.0)
    found = motion(later, 1.0, 6.05)
    assert (found.then.x, found.last.x) == (pytest.approx(0.5), pytest.approx(3.0))
    assert found.driven == pytest.approx(2.5, abs=0.05)
    assert found.blind == pytest.approx(2.0), "nobody watched meanwhile, which is told"


def test_a_restart_of_odometry_during_a_restart_of_the_monitor_is_detected(carrier: Carrier, tmp_path: Path) -> None:
    drive(carrier, 0.0, 3.0, stamps=[1.0])
    later = restarted(carrier, tmp_path)
    drive(later, 5.0, 6.0, writer=OTHER)
    assert_golden("kept_state", motion(later, 1.0, 6.05).missing, "another publisher")


def test_saved_odometry_of_another_topic_is_not_used(carrier: Carrier, tmp_path: Path) -> None:
    drive(carrier, 0.0, 3.0, stamps=[1.0])
    later = restarted(carrier, tmp_path, policy(topic="/wheels"))
    assert_golden("kept_state", motion(later, 1.0, 3.0).missing, "/wheels")


def test_damaged_data_is_ignored(carrier: Carrier) -> None:
    drive(carrier, 0.0, 3.0, stamps=[1.0])
    packed = {
        key: [Version(v.taken_at, v.good_from, v.data[:-3]) for v in vs] for key, vs in carrier.packed(1.0).items()
    }
    later = Carrier()
    later.follow(policy())
    later.adopt(packed)
    assert motion(later, 1.0, 3.0).missing


def test_a_changed_policy_drops_odometry_that_it_does_not_use(carrier: Carrier) -> None:
    drive(carrier, 0.0, 3.0, stamps=[1.0])
    carrier.follow(policy(required=True))
    assert motion(carrier, 1.0, 3.0).missing == "", "by the same odometry"
    carrier.follow(State())
    assert carrier.topics == {}
    assert carrier.packed(1.0) == {}


def test_a_clock_step_does_not_invalidate_stamped_odometry(carrier: Carrier) -> None:
    drive(carrier, 0.0, 3.0, stamps=[1.0])
    carrier.shift(3600.0)
    found = motion(carrier, 1.0, 3603.05)
    assert (found.missing, found.blind) == ("", 0.0)


def test_memory_is_bounded(carrier: Carrier) -> None:
    sizes = []
    for i in range(20):
        drive(carrier, 10.0 * i, 10.0 * i + 9.9, stamps=[10.0 * i + j for j in range(1, 9)])
        carrier.prune({Key("Topic", "/amcl_pose"): [Version(0, 0, pose(START + 10.0 * i + 8.0), POSE)]})
        sizes.append(sum(len(v.data) for versions in carrier.packed(1.0).values() for v in versions))
    assert len(set(sizes)) == 1, "of one version there is one moment"
    assert sizes[0] < 500
    assert carrier.waiting == 0


def test_a_motion_is_unchanged_by_encoding_and_decoding() -> None:
    moved = Motion(
        "/odom",
        ODOMETRY,
        True,
        "",
        ROBOT,
        "odom",
        "base",
        Pose(1, 2, 0, 0, 0, 0.6, 0.8),
        stamp=7,
        received=1.5,
        driven=2.0,
    )
    for sample in (
        KeptSample("/a", POSE, 1.0, b"\0", motion=found) for found in (None, moved, Motion("/o", ODOMETRY, False, "x"))
    ):
        assert KeptSample.from_wire(sample.to_wire()) == sample


def test_a_recovery_records_the_propagated_distance_and_poses_that_were_not_propagated() -> None:
    report = RestoreReport(
        (Restored("/amcl_pose", 98.5, 0.43219), Restored("/dock", 99.0, None, "it can't be carried"))
    )
    assert RestoreReport.from_wire(report.to_wire()) == report
    progress = Progress.begin("silent", last_healthy=100.0, detected=100.5, failed=[])
    progress.note_state(report)
    assert progress.to_recovery(1).state == [
        RestoredState(name="/amcl_pose", restored=True, age_seconds=1.5, carried_metres=0.432),
        RestoredState(name="/dock", restored=True, age_seconds=1.0, message="it can't be carried"),
    ]

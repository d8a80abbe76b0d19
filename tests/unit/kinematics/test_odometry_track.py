"""Odometry is kept for a limited time, interpolated between its messages, and discarded when its source starts again."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from understudy.kinematics.odometry_track import LENGTH, MARK_STEP, Point, Track
from understudy.kinematics.poses import Pose

SECOND = 1_000_000_000
START = 1_000 * SECOND


def planar(x: float, y: float = 0.0, heading: float = 0.0) -> Pose:
    return Pose(x, y, 0.0, 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))


def point(pose: Pose, seconds: float, *, writer: bytes = b"w" * 16, late: float = 0.01, stamped: bool = True) -> Point:
    stamp = START + round(seconds * SECOND)
    received = stamp + round(late * SECOND)
    return Point(pose, stamp if stamped else 0, received, "odom", "base_link", writer)


def drive(speed: float = 0.5, turn: float = 0.0, *, seconds: float = 3.0, period: float = 0.1) -> Iterator[Point]:
    """A robot that drives in an arc from where it is at second 0."""
    for i in range(round(seconds / period) + 1):
        t = i * period
        if turn:
            radius = speed / turn
            yield point(planar(radius * math.sin(turn * t), radius * (1 - math.cos(turn * t)), turn * t), t)
        else:
            yield point(planar(speed * t), t)


def followed(*points: Point) -> Track:
    track = Track()
    assert [reason for p in points if (reason := track.add(p))] == []
    return track


def moment(seconds: float) -> tuple[int, int]:
    return START + round(seconds * SECOND), START + round((seconds + 0.01) * SECOND)


def test_a_pose_between_two_messages_is_interpolated() -> None:
    found = followed(*drive()).at(*moment(1.04))
    assert found is not None
    assert found.pose.x == pytest.approx(0.52)
    assert found.driven == pytest.approx(0.52, abs=MARK_STEP)


def test_a_pose_on_an_arc_is_exact_to_a_few_millimetres() -> None:
    found = followed(*drive(0.5, 1.0, period=0.2)).at(*moment(1.1))
    assert found is not None
    assert found.pose.place == pytest.approx((0.5 * math.sin(1.1), 0.5 * (1 - math.cos(1.1)), 0.0), abs=0.004)
    assert found.pose.angle == pytest.approx(1.1)


def test_the_pose_at_the_time_of_a_message_is_that_of_the_message() -> None:
    found = followed(*drive()).at(*moment(2.0))
    assert found is not None
    assert found.pose.x == pytest.approx(1.0)


def test_messages_without_a_stamp_use_their_arrival_time() -> None:
    track = followed(*(point(planar(0.05 * i), 0.1 * i, stamped=False) for i in range(20)))
    found = track.at(0, moment(0.55)[1])
    assert found is not None
    assert found.pose.x == pytest.approx(0.275)
    by_receipt = track.at(*moment(0.55))
    assert by_receipt == found, "a stamp says nothing where odometry has none"


def test_a_future_time_is_awaited_and_then_uses_the_last_message() -> None:
    track = followed(*drive())
    assert track.at(*moment(3.09)) is None
    last = track.at(*moment(3.09), last=True)
    assert last == track.present
    assert track.at(*moment(3.5), last=True) is None


def test_a_pose_from_before_the_track_is_unknown() -> None:
    track = followed(*drive())
    assert track.at(*moment(-0.5)) is None
    assert track.at(*moment(-0.01)) is None, "before the first message nobody knows how it moved"
    assert Track().at(*moment(0)) is None


def test_memory_is_bounded() -> None:
    track = followed(*drive(seconds=30.0))
    assert track.at(*moment(30 - 0.1 * LENGTH - 1)) is None
    assert track.at(*moment(30 - 0.1 * LENGTH + 1)) is not None
    assert sum(track.at(*moment(step / 10)) is not None for step in range(301)) == LENGTH


def test_the_distance_is_the_length_of_the_path_not_of_the_displacement() -> None:
    track = followed(*drive(0.5, 1.0, seconds=2 * math.pi, period=math.pi / 60))
    present = track.present
    assert present is not None
    assert present.pose.distance(planar(0)) < 0.01
    assert present.driven == pytest.approx(0.5 * 2 * math.pi, rel=0.01)
    assert present.turned == pytest.approx(2 * math.pi, rel=0.01)


def test_noise_of_a_standing_robot_adds_no_distance() -> None:
    track = followed(*(point(planar(0.004 * (i % 3), 0.003 * (i % 2)), 0.1 * i) for i in range(100)))
    assert track.present is not None
    assert track.present.driven == 0.0


@pytest.mark.parametrize(
    ("after", "reason"),
    [
        pytest.param(point(planar(0.05), 3.1), "the odometry jumped by 1.45 m within 0.10 s", id="reset to the origin"),
        pytest.param(point(planar(1.15), 3.1), "the odometry jumped by 0.35 m within 0.10 s", id="small step back"),
        pytest.param(
            point(planar(1.55, 0.0, 2.0), 3.1), "the odometry turned by 2.00 rad within 0.10 s", id="sudden turn"
        ),
        pytest.param(
            point(planar(1.55), 3.1, writer=b"x" * 16), "another publisher took over this topic", id="another publisher"
        ),
        pytest.param(point(planar(1.55), 0.5), "the time of the odometry went back by 2.5 s", id="time goes back"),
        pytest.param(point(planar(90.0), 8.0), "the odometry jumped by 88.50 m within 5.00 s", id="impossible speed"),
        pytest.param(
            Point(planar(1.55), START + 3_100_000_000, 0, "odom2", "base_link", b"w" * 16),
            "the frames of the odometry changed from odom and base_link to odom2 and base_link",
            id="frames",
        ),
    ],
)
def test_a_restart_of_odometry_is_detected_and_discards_the_track(after: Point, reason: str) -> None:
    track = followed(*drive())
    assert track.add(after) == reason
    assert track.at(*moment(2.0)) is None
    assert track.last == after


@pytest.mark.parametrize(
    "points",
    [
        pytest.param([*drive(), point(planar(1.5), 3.1), point(planar(1.5), 3.2)], id="sudden stop"),
        pytest.param([*drive(0.0, seconds=1.0), point(planar(0.1), 1.1), point(planar(0.2), 1.2)], id="sudden start"),
        pytest.param([*drive(), point(planar(1.55), 3.1), point(planar(1.55), 3.1)], id="repeated message"),
        pytest.param(
            [*drive(), point(planar(1.58, 0.03), 3.1), point(planar(1.63, 0.03), 3.2)], id="corrected a little"
        ),
        pytest.param([*drive(3.0, seconds=2.0)], id="fast"),
        pytest.param([*drive(), point(planar(1.8), 4.5)], id="gap"),
        pytest.param([*drive(0.3, 2.0, seconds=10.0, period=0.1)], id="circles"),
    ],
)
def test_ordinary_motion_is_no_restart_of_odometry(points: list[Point]) -> None:
    followed(*points)


def test_time_without_a_message_is_counted() -> None:
    track = followed(*drive(), point(planar(2.0), 7.5), point(planar(2.05), 7.6))
    assert track.present is not None
    assert track.present.blind == pytest.approx(4.5)
    assert track.present.driven == pytest.approx(2.05, abs=2 * MARK_STEP)


def test_a_track_continues_after_a_restart_of_the_process() -> None:
    before = followed(*drive())
    track = Track.unpack(before.pack())
    assert (track.last, track.present) == (before.last, before.present)
    assert track.add(point(planar(1.8), 5.0)) == ""
    assert track.present is not None
    assert (track.present.driven, track.present.blind) == (pytest.approx(1.8, abs=0.05), pytest.approx(2.0))
    assert track.add(point(planar(0.0), 5.1, writer=b"x" * 16)) == "another publisher took over this topic"


def test_an_empty_track_stays_empty_after_a_restart() -> None:
    assert Track.unpack(Track().pack()).last is None


@pytest.mark.parametrize("data", [b"x", b"\xff" * 200, b"\0" * 150])
def test_damaged_data_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="bytes are not an odometry track"):
        Track.unpack(data)


def test_a_clock_step_moves_arrival_times_but_not_stamps() -> None:
    track = followed(*(point(planar(0.05 * i), 0.1 * i, stamped=False) for i in range(20)))
    track.shift(100.0)
    assert track.at(0, moment(0.5)[1]) is None
    found = track.at(0, moment(100.5)[1])
    assert found is not None
    assert found.pose.x == pytest.approx(0.25)

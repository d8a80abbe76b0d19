from __future__ import annotations

import math

import pytest
from navigation_stack.poses import Odometry, Pose


def test_a_transformation_and_its_inverse_cancel() -> None:
    a, b = Pose(1.0, 2.0, 0.7), Pose(-0.5, 3.0, -2.9)
    assert a.then(a.to(b)) == pytest.approx(b)
    assert a.then(a.inverse()) == pytest.approx((0, 0, 0))


def test_odometry_between_two_messages_is_interpolated() -> None:
    odometry = Odometry()
    odometry.add(1.0, Pose(0.0, 0.0, 3.1))
    odometry.add(2.0, Pose(1.0, 0.0, -3.1))
    middle = odometry.at(1.5)
    assert middle is not None
    assert (middle.x, abs(middle.heading)) == pytest.approx((0.5, math.pi), abs=1e-6)


def test_odometry_far_outside_the_known_time_is_unknown() -> None:
    odometry = Odometry()
    assert odometry.at(1.0) is None
    odometry.add(1.0, Pose(0.0, 0.0, 0.0))
    assert odometry.at(1.3) == Pose(0.0, 0.0, 0.0)
    assert odometry.at(1.6) is None
    assert odometry.at(0.4) is None


def test_a_restarted_source_of_odometry_begins_a_new_history() -> None:
    odometry = Odometry()
    odometry.add(5.0, Pose(9.0, 0.0, 0.0))
    odometry.add(1.0, Pose(0.0, 0.0, 0.0))
    assert odometry.latest == (1.0, Pose(0.0, 0.0, 0.0))
    assert odometry.at(5.0) is None

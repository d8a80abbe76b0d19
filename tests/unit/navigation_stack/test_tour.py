"""Localization, planner and pursuit together, in generated worlds."""

from __future__ import annotations

import numpy as np
import pytest
from navigation_stack.poses import Pose

from tests.unit.navigation_stack.drives import Tour, tour


@pytest.fixture(scope="module", params=[8])
def driven(request: pytest.FixtureRequest) -> Tour:
    return tour(request.param, 2, start_error=Pose(0.1, -0.1, 0.1))


def test_every_goal_is_reached(driven: Tour) -> None:
    for end, goal in driven.ends:
        assert end.distance(goal) < 0.2
        assert abs(goal.heading - end.heading) % (2 * np.pi) == pytest.approx(0, abs=0.25) or abs(
            goal.heading - end.heading
        ) % (2 * np.pi) == pytest.approx(2 * np.pi, abs=0.25)


def test_the_robot_never_touches_an_obstacle(driven: Tour) -> None:
    assert min(driven.clearances) > 0.18


def test_the_estimated_pose_is_accurate(driven: Tour) -> None:
    settled = np.array(driven.errors[20:])
    assert np.sqrt(np.mean(settled**2)) < 0.05
    assert settled.max() < 0.15
    assert np.mean(driven.turned) < 0.03

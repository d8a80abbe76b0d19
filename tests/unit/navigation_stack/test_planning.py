from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from navigation_stack.grid import Grid, distances
from navigation_stack.planning import GoalBlocked, Inflation, NoPath, Planner, StartBlocked
from navigation_stack.poses import Pose
from navigation_world import ROBOT_RADIUS, generate

from tests.unit.navigation_stack.drives import as_pose, charted


def walled(rows: int = 60, columns: int = 80) -> np.ndarray:
    cells = np.zeros((rows, columns), np.int8)
    cells[[0, -1], :] = 100
    cells[:, [0, -1]] = 100
    return cells


def length(path: list[Pose]) -> float:
    return sum(a.distance(b) for a, b in itertools.pairwise(path))


def test_distances_are_exact_up_to_the_maximum() -> None:
    random = np.random.default_rng(3)
    marked = random.random((30, 40)) < 0.02
    rows, columns = np.nonzero(marked)
    r, c = np.mgrid[0:30, 0:40]
    truth = np.hypot(r[..., None] - rows, c[..., None] - columns).min(axis=2) * 0.05
    assert distances(marked, 0.05, 0.6) == pytest.approx(np.minimum(truth, 0.6), abs=1e-5)


def test_distances_without_marked_cells_are_the_maximum() -> None:
    assert (distances(np.zeros((4, 5), bool), 0.1, 1.0) == 1.0).all()


@pytest.mark.parametrize("seed", [1, 7, 23])
def test_paths_avoid_obstacles_and_end_at_the_goal(seed: int) -> None:
    world = generate(seed)
    planner, at = Planner(charted(world)), as_pose(world.start)
    for goal in map(as_pose, world.goals(5)):
        path = planner.plan(at, goal)
        x, y = np.array([p.x for p in path]), np.array([p.y for p in path])
        assert world.clearance(x, y).min() > ROBOT_RADIUS
        assert path[0][:2] == at[:2]
        assert path[-1] == pytest.approx(goal)
        assert max(a.distance(b) for a, b in itertools.pairwise(path)) < 0.11
        at = goal


def test_a_path_across_an_open_floor_is_straight() -> None:
    planner = Planner(Grid(walled(), 0.05))
    start, goal = Pose(1.0, 1.0, 0.0), Pose(3.0, 1.9, 1.0)
    assert length(planner.plan(start, goal)) == pytest.approx(start.distance(goal), rel=0.01)


def test_the_planner_plans_again_for_another_start_or_goal() -> None:
    planner = Planner(Grid(walled(), 0.05))
    goal = Pose(3.0, 1.5, 1.0)
    planner.plan(Pose(1.0, 1.0, 0.0), goal)
    again = planner.plan(Pose(0.5, 2.5, 0.0), goal)
    assert again[0][:2] == (0.5, 2.5)
    other = planner.plan(again[3], Pose(0.6, 0.6, 0.0))
    assert other[-1] == pytest.approx((0.6, 0.6, 0.0))


def test_unknown_ground_is_not_crossed() -> None:
    cells = walled()
    cells[1:40, 38:42] = -1
    path = Planner(Grid(cells, 0.05)).plan(Pose(1.0, 0.6, 0.0), Pose(3.0, 0.6, 0.0))
    assert max(p.y for p in path) > 2.0 + 0.2


def test_a_missing_path_is_reported() -> None:
    cells = walled()
    cells[:, 40] = 100
    with pytest.raises(NoPath, match="all around the goal or the robot"):
        Planner(Grid(cells, 0.05)).plan(Pose(1.0, 1.0, 0.0), Pose(3.0, 1.0, 0.0))


def test_a_gap_narrower_than_the_robot_is_not_crossed() -> None:
    cells = walled()
    cells[:, 40] = 100
    cells[27:34, 40] = 0
    grid = Grid(cells, 0.05)
    with pytest.raises(NoPath):
        Planner(grid).plan(Pose(1.0, 1.0, 0.0), Pose(3.0, 1.0, 0.0))
    assert Planner(grid, Inflation(robot_radius=0.1, margin=0.02)).plan(Pose(1.0, 1.0, 0.0), Pose(3.0, 1.0, 0.0))


def test_a_goal_in_a_wall_is_moved_by_at_most_the_tolerance() -> None:
    planner = Planner(Grid(walled(), 0.05), tolerance=0.25)
    path = planner.plan(Pose(1.0, 1.0, 0.0), Pose(3.0, 0.15, 0.0))
    assert path[-1].y > 0.25
    assert math.hypot(path[-1].x - 3.0, path[-1].y - 0.15) <= 0.3
    with pytest.raises(GoalBlocked, match=r"the goal 3.00, -2.00 and all within 0.25 m"):
        planner.plan(Pose(1.0, 1.0, 0.0), Pose(3.0, -2.0, 0.0))


def test_a_robot_outside_the_map_is_reported() -> None:
    with pytest.raises(StartBlocked, match=r"the robot is at 50.00, 1.00"):
        Planner(Grid(walled(), 0.05)).plan(Pose(50.0, 1.0, 0.0), Pose(3.0, 1.0, 0.0))


def test_a_robot_that_is_too_close_to_a_wall_can_leave() -> None:
    path = Planner(Grid(walled(), 0.05)).plan(Pose(1.0, 0.2, 0.0), Pose(3.0, 1.0, 0.0))
    assert path[0][:2] == (1.0, 0.2)


def test_a_path_from_the_goal_to_itself_has_the_pose_of_the_goal() -> None:
    path = Planner(Grid(walled(), 0.05)).plan(Pose(1.0, 1.0, 0.3), Pose(1.0, 1.0, 2.0))
    assert path[-1] == pytest.approx((1.0, 1.0, 2.0))

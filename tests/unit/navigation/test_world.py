"""Worlds from seeds: every one can be driven, and its map shows what is there."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from navigation_world import (
    DEPTH,
    FREE,
    OCCUPIED,
    ROBOT_RADIUS,
    UNKNOWN,
    WIDTH,
    World,
    __main__,
    generate,
)
from navigation_world.generating import LEAST_WAY, PASSAGE
from navigation_world.grids import component
from navigation_world.partition import CORRIDOR, LEAST

SEEDS = range(1, 9)


@pytest.fixture(scope="module")
def worlds() -> dict[int, World]:
    return {seed: generate(seed) for seed in SEEDS}


def test_a_seed_determines_the_world(worlds: dict[int, World]) -> None:
    again = generate(3)
    assert again == worlds[3]
    assert again.goals(5) == worlds[3].goals(5)
    assert again.goals(5, seed=1) != again.goals(5)
    assert len({world.walls for world in worlds.values()}) == len(worlds)


@pytest.mark.parametrize("seed", SEEDS)
def test_every_room_and_every_goal_can_be_reached_with_clearance(worlds: dict[int, World], seed: int) -> None:
    world = worlds[seed]
    assert len(world.rooms) >= 4
    assert world.things
    assert world.fits(world.start.x, world.start.y, ROBOT_RADIUS + 0.1)
    for room in world.rooms:
        assert min(room.width, room.depth) >= min(LEAST, CORRIDOR) - 1e-9
    grid = world.map.grid
    x, y = grid.centres()
    # By the map alone, as a planner sees it: what it shows as occupied, widened by the robot's radius.
    obstacles = np.argwhere(world.map.cells != FREE)
    wide = np.ones_like(world.map.cells, bool)
    for row, column in obstacles:
        reach = math.ceil(ROBOT_RADIUS / grid.resolution) + 1
        wide[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1] = False
    ways = component(wide, grid.cell(world.start.x, world.start.y))
    for room in world.rooms:
        inside = (x > room.left) & (x < room.right) & (y > room.bottom) & (y < room.top)
        assert (ways & inside).any(), f"no way into {room}"
    before = world.start
    for goal in world.goals(20):
        assert world.reachable(goal.x, goal.y)
        assert ways[grid.cell(goal.x, goal.y)], f"no way to {goal} in the map"
        assert world.fits(goal.x, goal.y, PASSAGE)
        assert math.hypot(goal.x - before.x, goal.y - before.y) >= LEAST_WAY
        before = goal


@pytest.mark.parametrize("seed", SEEDS)
def test_the_map_shows_the_world(worlds: dict[int, World], seed: int) -> None:
    world = worlds[seed]
    grid, cells = world.map.grid, world.map.cells
    x, y = grid.centres()
    free = world.clearance(x, y)
    inside = (x > 0) & (x < WIDTH) & (y > 0) & (y < DEPTH)
    assert (cells[inside & (free > grid.resolution)] == FREE).all()
    assert (cells[inside & (free < -grid.resolution)] == OCCUPIED).all()
    assert (cells[inside] != UNKNOWN).all()
    assert (cells[0] == UNKNOWN).all()
    for wall in world.walls:
        assert cells[grid.cell(wall.x, wall.y)] == OCCUPIED


def test_the_files_contain_the_map_of_the_world(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["navigation_world", "--seed", "7", "--out", str(tmp_path)])
    __main__.main()
    assert "the robot starts at" in capsys.readouterr().out
    world = generate(7)
    described = yaml.safe_load((tmp_path / "map.yaml").read_text())
    header, size, most, data = (tmp_path / described["image"]).read_bytes().split(b"\n", 3)
    assert (header, most) == (b"P5", b"255")
    columns, rows = map(int, size.split())
    grey = np.frombuffer(data, np.uint8).reshape(rows, columns)[::-1]
    # As map_server reads it (map_io.cpp, trinary).
    probability = (255 - grey) / 255
    read = np.where(
        probability > described["occupied_thresh"],
        OCCUPIED,
        np.where(probability < described["free_thresh"], FREE, UNKNOWN),
    )
    assert (read == world.map.cells).all()
    assert described["origin"][:2] == [world.map.grid.left, world.map.grid.bottom]
    assert described["resolution"] == world.map.grid.resolution


def test_isolated_places_are_not_reached() -> None:
    free = np.ones((20, 30), bool)
    free[:, 10] = False
    free[5:, 20] = False
    assert component(free, (0, 0)).sum() == 200
    assert component(free, (19, 29)).sum() == free.sum() - 200
    assert component(free, (0, 10)).sum() == 0

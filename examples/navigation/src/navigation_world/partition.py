"""A floor plan by binary space partition: rooms on both sides of a corridor, every room with a door.

The method is the one of Shaker, Liapis, Togelius, Lopes and Bidarra, "Constructive generation methods for dungeons and
levels", in: Procedural Content Generation in Games, Springer 2016, section 3.2: an area is halved at a random place
until its parts are as small as rooms, and siblings are joined. The first cut is a corridor instead of a wall.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

import numpy as np

from navigation_world.geometry import Box, Rectangle

WALL = 0.1
"""How thick walls are."""

CORRIDOR = 1.5
"""How wide the corridor is between its walls."""

DOOR = 1.0
"""How wide doors are."""

LEAST = 2.2
"""The least that a side of a room measures."""

MOST = 4.0
"""A room with a longer side is halved."""

SECOND_DOOR = 0.35
"""The probability that a wall gets one more door, so that more than one way exists."""


@dataclass(frozen=True, slots=True)
class Wall:
    """A wall in the middle of a cut: at ``at`` on one axis, from ``start`` to ``end`` on the other."""

    vertical: bool
    at: float
    start: float
    end: float


@dataclass(frozen=True, slots=True)
class Door:
    """An opening in a wall."""

    x: float
    y: float


@dataclass(frozen=True, slots=True)
class Plan:
    """Rooms (the corridor is one of them), and what is between them."""

    rooms: tuple[Rectangle, ...]
    walls: tuple[Box, ...]
    doors: tuple[Door, ...]


def plan(width: float, depth: float, height: float, random: np.random.Generator) -> Plan:
    """A plan of a floor whose outer walls lie around ``0, 0`` to ``width, depth``."""
    whole = Rectangle(0.0, 0.0, width, depth)
    rooms: list[Rectangle] = []
    cuts: list[Wall] = []
    for part in _corridor(whole, rooms, cuts, random):
        _halve(part, rooms, cuts, random)
    walls: list[Box] = []
    doors: list[Door] = []
    for cut in cuts:
        openings = _openings(cut, rooms, random)
        doors += [Door(cut.at, o) if cut.vertical else Door(o, cut.at) for o in openings]
        ends = [cut.start, *chain.from_iterable((o - DOOR / 2, o + DOOR / 2) for o in openings), cut.end]
        walls += [_wall(cut, start, end, height) for start, end in zip(ends[::2], ends[1::2], strict=True)]
    return Plan(tuple(rooms), (*_outside(whole, height), *walls), tuple(doors))


def _corridor(
    whole: Rectangle, rooms: list[Rectangle], cuts: list[Wall], random: np.random.Generator
) -> tuple[Rectangle, Rectangle]:
    """Lays the corridor along the longer axis; what is left on its sides."""
    vertical = whole.depth > whole.width
    span = whole.width if vertical else whole.depth
    half = (CORRIDOR + WALL) / 2
    middle = random.uniform(LEAST + WALL + half, span - LEAST - WALL - half)
    first, corridor = _cut(whole, vertical, middle - half, cuts)
    corridor, second = _cut(corridor, vertical, middle + half, cuts)
    rooms.append(corridor)
    return first, second


def _halve(part: Rectangle, rooms: list[Rectangle], cuts: list[Wall], random: np.random.Generator) -> None:
    """Halves a part again and again, until its rooms are small enough."""
    vertical = part.width >= part.depth
    span = part.width if vertical else part.depth
    if span <= MOST or span < 2 * (LEAST + WALL):
        rooms.append(part)
        return
    start = part.left if vertical else part.bottom
    at = start + random.uniform(LEAST + WALL / 2, span - LEAST - WALL / 2)
    for half in _cut(part, vertical, at, cuts):
        _halve(half, rooms, cuts, random)


def _cut(part: Rectangle, vertical: bool, at: float, cuts: list[Wall]) -> tuple[Rectangle, Rectangle]:
    """The two free areas beside a wall."""
    half = WALL / 2
    if vertical:
        cuts.append(Wall(True, at, part.bottom, part.top))
        return (
            Rectangle(part.left, part.bottom, at - half, part.top),
            Rectangle(at + half, part.bottom, part.right, part.top),
        )
    cuts.append(Wall(False, at, part.left, part.right))
    return (
        Rectangle(part.left, part.bottom, part.right, at - half),
        Rectangle(part.left, at + half, part.right, part.top),
    )


def _openings(cut: Wall, rooms: list[Rectangle], random: np.random.Generator) -> list[float]:
    """Where the doors of a wall are: never where another wall meets it.

    One door is enough to join the two sides, since each of them is one room or has been joined in itself.
    """
    stretches = list(_shared(cut, rooms))
    if not stretches:
        raise ValueError(f"no two rooms share {DOOR} m of the wall at {cut.at:.2f}")
    chosen = {int(random.integers(len(stretches)))}
    chosen |= {i for i in range(len(stretches)) if random.random() < SECOND_DOOR}
    margin = DOOR / 2 + WALL
    return sorted(float(random.uniform(stretches[i][0] + margin, stretches[i][1] - margin)) for i in chosen)


def _shared(cut: Wall, rooms: list[Rectangle]) -> list[tuple[float, float]]:
    """Stretches of a wall that have one room on each side, and space for a door."""
    near, far = cut.at - WALL / 2, cut.at + WALL / 2
    before, after = [], []
    for room in rooms:
        low, high = (room.left, room.right) if cut.vertical else (room.bottom, room.top)
        span = (room.bottom, room.top) if cut.vertical else (room.left, room.right)
        if span[0] < cut.end and span[1] > cut.start:
            if abs(high - near) < 1e-9:
                before.append(span)
            elif abs(low - far) < 1e-9:
                after.append(span)
    found = [(max(a[0], b[0]), min(a[1], b[1])) for a in before for b in after]
    return sorted((start, end) for start, end in found if end - start > DOOR + 2 * WALL + 0.1)


def _wall(cut: Wall, start: float, end: float, height: float) -> Box:
    middle, half = (start + end) / 2, (end - start) / 2
    if cut.vertical:
        return Box(cut.at, middle, WALL / 2, half, height=height)
    return Box(middle, cut.at, half, WALL / 2, height=height)


def _outside(whole: Rectangle, height: float) -> list[Box]:
    half = WALL / 2
    width, depth = whole.width / 2, whole.depth / 2
    return [
        Box(-half, depth, half, depth + WALL, height=height),
        Box(whole.width + half, depth, half, depth + WALL, height=height),
        Box(width, -half, width, half, height=height),
        Box(width, whole.depth + half, width, half, height=height),
    ]

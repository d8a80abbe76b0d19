"""A world as files: the map as Nav2's map server reads it, and the world as MuJoCo reads it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from navigation_world.generating import DEPTH, WIDTH, World
from navigation_world.geometry import Box, Shape
from navigation_world.grids import OCCUPIED, UNKNOWN, Map

_GREY = {"free": 254, "unknown": 205, "occupied": 0}
"""What map_saver writes for each."""


def write(world: World, folder: Path) -> None:
    """Writes map.pgm, map.yaml and world.xml."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "map.pgm").write_bytes(pgm(world.map))
    (folder / "map.yaml").write_text(_yaml(world.map))
    (folder / "world.xml").write_text(mjcf(world))


def pgm(world_map: Map) -> bytes:
    """The map as a binary portable greymap; its first row is the uppermost."""
    cells = world_map.cells
    grey = np.where(
        cells == OCCUPIED, _GREY["occupied"], np.where(cells == UNKNOWN, _GREY["unknown"], _GREY["free"])
    ).astype(np.uint8)
    rows, columns = grey.shape
    return f"P5\n{columns} {rows}\n255\n".encode() + grey[::-1].tobytes()


def _yaml(world_map: Map) -> str:
    grid = world_map.grid
    return (
        "image: map.pgm\n"
        "mode: trinary\n"
        f"resolution: {grid.resolution}\n"
        f"origin: [{grid.left}, {grid.bottom}, 0.0]\n"
        "negate: 0\n"
        "occupied_thresh: 0.65\n"
        # Nav2's own 0.25 would read the grey of unknown cells, (255 - 205) / 255, as free.
        "free_thresh: 0.196\n"
    )


def geoms(world: World) -> str:
    """What belongs into a MuJoCo model's worldbody: the floor (group 0), walls and things (group 1).

    What meets the floor has bit 2 of contype and conaffinity, what meets walls and things bit 1.
    """
    lines = [
        f'<geom name="floor" type="plane" pos="{WIDTH / 2} {DEPTH / 2} 0" size="{WIDTH} {DEPTH} 1" '
        'friction="1 .005 .0001" contype="2" conaffinity="2" rgba=".75 .75 .72 1"/>'
    ]
    for kind, shapes, colour in (("wall", world.walls, ".45 .5 .6 1"), ("thing", world.things, ".7 .5 .3 1")):
        lines += [_geom(f"{kind}{number}", shape, colour) for number, shape in enumerate(shapes)]
    return "\n".join(lines)


def _geom(name: str, shape: Shape, colour: str) -> str:
    half = shape.height / 2
    if isinstance(shape, Box):
        kind = "box"
        size = f"{shape.half_width} {shape.half_depth} {half}"
        turned = f' axisangle="0 0 1 {shape.heading}"' if shape.heading else ""
    else:
        kind, size, turned = "cylinder", f"{shape.radius} {half}", ""
    return (
        f'<geom name="{name}" type="{kind}" group="1" pos="{shape.x} {shape.y} {half}" size="{size}"{turned} '
        f'rgba="{colour}"/>'
    )


def mjcf(world: World, *, body: str = "", after: str = "") -> str:
    """A whole MuJoCo model.

    Args:
        body: what else is in the worldbody, such as a robot.
        after: further sections, such as actuators.
    """
    return f"""<mujoco model="navigation-{world.seed}">
<compiler angle="radian"/>
<option timestep="0.005" integrator="implicitfast" cone="elliptic"/>
<worldbody>
<light pos="{WIDTH / 2} {DEPTH / 2} 6" dir="0 0 -1" diffuse=".7 .7 .7"/>
{geoms(world)}
{body}
</worldbody>
{after}
</mujoco>
"""

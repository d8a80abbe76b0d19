"""Writes a world's files: ``python -m navigation_world --seed 7 --out FOLDER``."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from navigation_world.files import write
from navigation_world.generating import generate


def main() -> None:
    """Writes map.pgm, map.yaml and world.xml; says where the robot starts."""
    parser = argparse.ArgumentParser(prog="navigation_world", description=__doc__)
    parser.add_argument("--seed", type=int, default=int(os.environ.get("NAVIGATION_SEED", "7")))
    parser.add_argument("--out", type=Path, required=True, help="the folder; it is made")
    options = parser.parse_args()
    world = generate(options.seed)
    write(world, options.out)
    start = world.start
    print(
        f"{options.out}: {len(world.rooms)} rooms, {len(world.things)} things; the robot starts at "
        f"{start.x:.2f}, {start.y:.2f}, heading {start.heading:.2f}"
    )


if __name__ == "__main__":
    main()

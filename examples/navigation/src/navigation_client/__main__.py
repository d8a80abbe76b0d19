"""Drives the robot through goals: ``python -m navigation_client --goals 6``.

The goals are random places of the world (NAVIGATION_SEED). One JSON record a line goes to standard output and to the
file that NAVIGATION_CLIENT_LOG names; the exit status is 0 when every goal succeeded.
"""

from __future__ import annotations

import os
import sys

from navigation_world import generate

from navigation_client import running
from navigation_client.client import Client


def main() -> int:
    """Send the goals; returns the exit status."""
    parser = running.parser(Client, __doc__)
    parser.add_argument("--seed", type=int, default=int(os.environ.get("NAVIGATION_SEED", "7")), help="of the world")
    parser.add_argument("--tour", type=int, help="another list of goals in the same world")
    return running.run(Client, parser, lambda told: generate(told.seed).goals(told.goals, told.tour))


if __name__ == "__main__":
    sys.exit(main())

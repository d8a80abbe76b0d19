"""Drives the robot through goals: ``python -m navigation_client --goals 6``.

The goals are random places of the world (NAVIGATION_SEED). One JSON record a line goes to standard output and to the
file that NAVIGATION_CLIENT_LOG names; the exit status is 0 when every goal succeeded.
"""

from __future__ import annotations

import argparse
import os
import sys

import rclpy
from navigation_robot.journal import Journal
from navigation_world import generate
from rclpy.executors import ExternalShutdownException

from navigation_client.client import Client, Patience


def main() -> int:
    """Send the goals; returns the exit status."""
    parser = argparse.ArgumentParser(prog="navigation_client", description=__doc__)
    parser.add_argument("--seed", type=int, default=int(os.environ.get("NAVIGATION_SEED", "7")), help="of the world")
    parser.add_argument("--goals", type=int, default=6, help="how many")
    parser.add_argument("--tour", type=int, help="another list of goals in the same world")
    parser.add_argument("--within", type=float, default=300.0, help="seconds that a goal may take")
    parser.add_argument("--wait", type=float, default=120.0, help="seconds to wait for the server and for acceptance")
    options = parser.parse_args()
    rclpy.init()
    patience = Patience(server=options.wait, acceptance=options.wait, result=options.within)
    client = Client(Journal(os.environ.get("NAVIGATION_CLIENT_LOG")), patience)
    try:
        return 0 if client.run(generate(options.seed).goals(options.goals, options.tour)) else 1
    except (KeyboardInterrupt, ExternalShutdownException):
        return 1
    finally:
        client.close()


if __name__ == "__main__":
    sys.exit(main())

"""How a client runs as a command: its options, and its exit status."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from navigation_robot.journal import Journal
from rclpy.executors import ExternalShutdownException
from rclpy.utilities import remove_ros_args

from navigation_client.client import Client, Patience


def parser(client: type[Client], description: str | None) -> argparse.ArgumentParser:
    """The options of every client."""
    made = argparse.ArgumentParser(prog=client.NAME, description=description)
    made.add_argument("--goals", type=int, default=6, help="how many")
    made.add_argument("--within", type=float, default=300.0, help="seconds that a goal may take")
    made.add_argument("--wait", type=float, default=120.0, help="seconds to wait for the server and for acceptance")
    return made


def run(
    client: type[Client],
    parser: argparse.ArgumentParser,
    goals: Callable[[argparse.Namespace], Sequence[Any]],
) -> int:
    """Send the goals that the command line asks for; returns the exit status, 0 when every one succeeded.

    The records go to the file that the variable with the client's name names, such as NAVIGATION_CLIENT_LOG.
    """
    options = parser.parse_args(remove_ros_args(sys.argv)[1:])
    rclpy.init()
    patience = Patience(server=options.wait, acceptance=options.wait, result=options.within)
    running = client(Journal(os.environ.get(f"{client.NAME.upper()}_LOG")), patience)
    try:
        return 0 if running.run(goals(options)) else 1
    except (KeyboardInterrupt, ExternalShutdownException):
        return 1
    finally:
        running.close()

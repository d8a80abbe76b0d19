"""How a simulated robot runs: tick after tick by the clock, until it is asked to stop."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

import rclpy

from navigation_robot.journal import Journal

LATE = 0.25
"""Seconds that are caught up at most; a process that was stopped for longer goes on from where it was."""


class Robot(Protocol):
    """What runs."""

    def run(self) -> None:
        """Until ROS is shut down."""

    def close(self) -> None:
        """Leave the graph."""


def until_stopped(robot: Robot) -> None:
    """Run a robot until it is asked to stop."""
    try:
        robot.run()
    except KeyboardInterrupt:
        pass
    except Exception:
        if rclpy.ok():  # otherwise a signal ended ROS in the middle of a tick
            raise
    finally:
        robot.close()


def tick(each: Callable[[float], None], period: float, journal: Journal) -> None:
    """Call something with the steady clock's seconds, once in every period (seconds), until ROS is shut down."""
    begun, ticks = time.monotonic(), 0
    while rclpy.ok():
        now = time.monotonic()
        behind = now - begun - ticks * period
        if behind > LATE:
            journal.write("late", time=time.time(), seconds=behind)
            begun += behind
        elif behind < 0:
            time.sleep(-behind)
        each(time.monotonic())
        ticks += 1

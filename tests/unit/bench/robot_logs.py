"""Logs of robots that instances drive with a steady rate."""

from __future__ import annotations

from collections.abc import Iterator

from understudy_demo.robotview import Command, RobotLog


def log(*parts: tuple[str, float, float], period: float) -> RobotLog:
    """Return a log with the commands of instances, each from a moment to another, by the time of their arrival."""

    def commands() -> Iterator[Command]:
        for source, begin, end in parts:
            for number in range(round((end - begin) / period) + 1):
                at = begin + period * number
                yield Command(at, source, 0, at, *[0.0] * 6)

    return RobotLog(sorted(commands(), key=lambda command: command.received))

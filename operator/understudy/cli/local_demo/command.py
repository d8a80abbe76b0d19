"""``understudy try``: shows on one machine how a robot survives a frozen application."""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any

from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.option_rules import add_examples, duration, whole
from understudy.cli.common.text import terminal
from understudy.cli.common.text.wording import wrapped
from understudy.cli.local_demo.course import Demo, Ended
from understudy.cli.local_demo.stand import Stand, running
from understudy.cli.local_demo.summary import Summary
from understudy.cli.local_demo.view import Display, Lines, Screen

SURVIVED, NOT_SURVIVED = 0, 1
"""Exit statuses besides ERROR."""

NEEDED = ("rclpy", "geometry_msgs", "nav_msgs", "std_msgs")
"""What must be importable."""


@reports_errors("try")
def main(arguments: list[str]) -> int:
    """Run the command. The view goes to standard output, and the summary after it."""
    options = _parser().parse_args(arguments)
    _require_ros()
    if not options.failures and not _has_keys():
        raise CommandError("--failures 0 needs a terminal with a keyboard: give the number of failures")
    before = {number: signal.signal(number, _interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    demo: Demo | None = None
    try:
        with contextlib.suppress(KeyboardInterrupt, BrokenPipeError, Ended), running(options.gap) as stand:
            display = _display()
            try:
                with _keys() as key:
                    demo = _demo(stand, display, key, options)
                    demo.run()
            finally:
                display.close()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if demo is None or not demo.failovers:
        print("understudy try: ended before the first freeze", file=sys.stderr)
        return NOT_SURVIVED
    summary = Summary(demo.failovers, stand.robot, stand.monitor, gap=options.gap, within=options.within)
    columns = terminal.columns(sys.stdout)
    terminal.write(
        part for line in summary.lines() for part in (wrapped(line, columns, indent=0, hanging=2) if line else [""])
    )
    return SURVIVED if summary.is_good else NOT_SURVIVED


def _require_ros() -> None:
    """Raise CommandError if a part of ROS 2 is not installed."""
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        raise CommandError(
            f"ROS 2 is not installed ({', '.join(missing)} not found). Install Understudy with it, in a clone of its repository:\n"
            "python3 -m venv .venv && .venv/bin/pip install '.[ros]'\n"
            ".venv/bin/understudy try\n"
            "On Debian and Ubuntu, the first command needs the package python3-venv\n"
            "The packages come from PyPI, for x86-64 Linux. On other machines, source a ROS 2 Jazzy installation"
        )


def _demo(stand: Stand, display: Display, key: Callable[[], str], options: argparse.Namespace) -> Demo:
    return Demo(
        stand, display, key, failures=options.failures, freeze_after=options.freeze_after, within=options.within
    )


def _display() -> Display:
    return (Screen if terminal.redraws(sys.stdout) else Lines)(sys.stdout, time.monotonic())


def _has_keys() -> bool:
    return sys.stdin.isatty() and terminal.redraws(sys.stdout)


@contextlib.contextmanager
def _keys() -> Iterator[Callable[[], str]]:
    """Yield a function that returns the key that was pressed, or nothing."""
    if not _has_keys():
        yield str
        return
    import termios
    import tty

    keyboard = sys.stdin.fileno()
    before = termios.tcgetattr(keyboard)
    tty.setcbreak(keyboard)
    try:
        yield lambda: os.read(keyboard, 1).decode(errors="replace") if select.select([keyboard], [], [], 0)[0] else ""
    finally:
        termios.tcsetattr(keyboard, termios.TCSADRAIN, before)


def _interrupt(*_: Any) -> None:
    raise KeyboardInterrupt


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy try",
        description="Shows on this machine how a robot survives a frozen application: without a cluster, without containers and without "
        "root. It starts a simulated robot, two instances of an application, a mux and a monitor, freezes the instance that drives, and "
        "measures at the robot how long no command arrived. Later the frozen instance continues, and the gate keeps it from the robot. "
        "The gate, the DDS partitions and the health tree are those of a cluster. The processes use the loopback interface and a "
        "ROS domain of their own, and end with the command.",
        epilog="Exit status: 0 if the standby drove the robot in time after each freeze, and never two instances did; 1 otherwise; 2 on an "
        "error.",
    )
    add_examples(parser, "understudy try", "understudy try --failures 5 --freeze-after 2s --gap 150ms")
    parser.add_argument(
        "--failures",
        metavar="COUNT",
        type=whole(0),
        default=2,
        help="freeze this many times, then end (default: 2); with 0, only when f is pressed, until q is pressed",
    )
    parser.add_argument(
        "--freeze-after",
        metavar="DURATION",
        type=duration,
        default=5.0,
        help="time before each freeze (default: 5s); in a terminal, f freezes at once",
    )
    parser.add_argument(
        "--gap",
        metavar="DURATION",
        type=duration,
        default=0.25,
        help="silence that counts as a failure (default: 250ms); the application sends every 50 ms",
    )
    parser.add_argument(
        "--within",
        metavar="DURATION",
        type=duration,
        default=1.0,
        help="longest time without commands at the robot that counts as survived (default: 1s)",
    )
    return parser

"""``understudy try``: shows on one machine how a robot survives a frozen application."""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from typing import Any

from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.option_rules import add_examples, duration, whole
from understudy.cli.common.text import terminal
from understudy.cli.common.text.wording import counted, wrapped
from understudy.cli.local_demo.record import Failover, failover
from understudy.cli.local_demo.stand import INSTANCES, Stand, running
from understudy.cli.local_demo.view import Display, Lines, Screen

SURVIVED, NOT_SURVIVED = 0, 1
"""Exit statuses besides ERROR."""

STARTS_WITHIN = 60.0
"""Seconds within which the robot must be driven."""

LOOK = 0.03
"""Seconds between two looks at the journals."""

FROZEN_FOR, WATCHED_FOR = 2.0, 2.0
"""Seconds for which the failed instance stays frozen after its standby took over, and for which it is watched when it sends again."""

NEEDED = ("rclpy", "rmw_fastrtps_cpp", "geometry_msgs", "nav_msgs", "std_msgs")
"""What must be importable. The middleware has no module in a ROS installation, so only the wheels are asked for it."""

NEXT = (
    ("docs/concepts.md", "how it works, in five minutes"),
    ("docs/tutorial.md", "the same with your own two scripts in a cluster"),
    ("scripts/demo", "three failures in a real cluster"),
)


class _Ended(Exception):
    """The user has ended the demo."""


@reports_errors("try")
def main(arguments: list[str]) -> int:
    """Run the command. The view goes to standard output, and the summary after it."""
    options = _parser().parse_args(arguments)
    _require_ros()
    if not options.failures and not _has_keys():
        raise CommandError("--failures 0 needs a terminal with a keyboard: give the number of failures")
    before = {number: signal.signal(number, _interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    found: list[Failover] = []
    try:
        with running(options.gap) as stand:
            display = _display()
            try:
                with _keys() as key, contextlib.suppress(KeyboardInterrupt, BrokenPipeError, _Ended):
                    _Demo(stand, display, options, key, found).run()
            finally:
                with contextlib.suppress(BrokenPipeError):
                    display.close()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    return _end(stand, found, options)


class _Demo:
    """The course of the demo."""

    def __init__(
        self,
        stand: Stand,
        display: Display,
        options: argparse.Namespace,
        key: Callable[[], str],
        found: list[Failover],
    ) -> None:
        """Each failover is added to ``found``."""
        self._stand, self._display, self._options, self._key, self._found = stand, display, options, key, found
        self._freezes_now = False

    def run(self) -> None:
        """Start, freeze as often as asked for, and return. Raises CommandError, and _Ended if the user ends it."""
        self._start()
        while not self._options.failures or len(self._found) < self._options.failures:
            self._fail()

    def _start(self) -> None:
        stand = self._stand
        self._note("starting a robot, two instances, a mux and a monitor")

        def is_driven() -> bool:
            return bool(stand.robot.commands) and all(stand.monitor.sends.get(name, 0) for name in INSTANCES)

        if not self._wait(is_driven, STARTS_WITHIN):
            raise CommandError(f"the robot is not driven after {STARTS_WITHIN:.0f} s{stand.output()}")
        self._note(f"{stand.monitor.active} drives; {self._standby()} does the same, and the gate keeps it from the robot")

    def _fail(self) -> None:
        """Freeze the active instance, and later let it continue."""
        stand, options = self._stand, self._options
        self._freezes_now = False
        automatic = options.freeze_after if options.failures else float("inf")
        self._wait(lambda: self._freezes_now, automatic)
        active, standby = stand.monitor.active, self._standby()
        at = stand.freeze(active)
        self._note(f"{active} is frozen (SIGSTOP): it still runs, and sends nothing")

        def now() -> Failover:
            return failover(stand.robot, stand.monitor, active, at, standby)

        self._wait(lambda: now().first is not None, options.within + 5.0)
        found = now()
        self._found.append(found)
        if found.gap is None:
            self._note("no standby has taken over")
            raise _Ended
        self._note(f"{standby} drives: the robot was without commands for {found.gap * 1000:.0f} ms")
        self._wait(lambda: False, FROZEN_FOR)
        woken = stand.wake(active)
        self._note(f"{active} continues (SIGCONT), and sends commands as before")
        self._wait(lambda: False, WATCHED_FOR)
        found.leaked = stand.robot.received(active, since=woken, until=time.monotonic())
        found.kept = stand.monitor.sends.get(active, 0.0)
        self._note(f"{active} sends {found.kept:.0f} commands/s, and {found.leaked or 'none'} of them reached the robot")

    def _standby(self) -> str:
        return next(name for name in INSTANCES if name != self._stand.monitor.active)

    def _wait(self, holds: Callable[[], bool], most: float) -> bool:
        """Show what happens until something holds; returns False if it does not in time. Raises CommandError and _Ended."""
        end = time.monotonic() + most
        while True:
            self._stand.update()
            now = time.monotonic()
            self._display.show(self._stand, now)
            pressed = self._key()
            if pressed in ("q", "\x04"):
                raise _Ended
            self._freezes_now |= pressed == "f"
            if holds():
                return True
            if now >= end:
                return False
            time.sleep(LOOK)

    def _note(self, text: str) -> None:
        self._display.note(time.monotonic(), text)


def _end(stand: Stand, found: Sequence[Failover], options: argparse.Namespace) -> int:
    """Print the summary and return the exit status."""
    survived = [one for one in found if one.gap is not None and one.gap <= options.within]
    changes = len(stand.robot.drivers) - 1
    one_driver = changes == sum(one.gap is not None for one in found) and not any(one.leaked for one in found)
    lines = ["", f"The robot survived {len(survived)} of {counted(len(found), 'freeze')}."]
    for number, one in enumerate(found, 1):
        lines.append(f"  {number}. {_described(one, options.within)}")
    total = len(stand.robot.commands)
    if one_driver:
        lines.append(f"Never two drivers: {total} commands reached the robot, each from the instance in control.")
    else:
        lines.append(f"TWO DRIVERS: {total} commands reached the robot, from {' then '.join(stand.robot.drivers)}.")
    lines += stand.monitor.problems
    lines += [
        "",
        f"Real: the gate (understudy mux, DDS partitions), the detection (a health tree: /cmd_vel, gap {options.gap * 1000:.0f} ms) and the "
        "measurement, which is the robot's own record.",
        "Simulated: the robot, its application, the freeze (SIGSTOP), and the cluster. There, the monitor writes the gate to the API server "
        "before it gives its order, and a failed instance is replaced.",
        "",
        "Next:",
        *(f"  {place:18}{what}" for place, what in NEXT),
    ]
    columns = terminal.columns(sys.stdout)
    terminal.write(
        part for line in lines for part in (wrapped(line, columns, indent=0, hanging=2) if line else [""])
    )
    return SURVIVED if found and len(survived) == len(found) and one_driver else NOT_SURVIVED


def _described(one: Failover, within: float) -> str:
    """Describe a failover in a sentence or two."""
    if one.gap is None:
        return f"{one.frozen} froze, and nobody took over."
    detected = f", {(one.detected - one.last) * 1000:.0f} ms of them until it was detected" if one.detected else ""
    stopped = "the robot stopped meanwhile" if one.stopped else "the robot did not stop"
    late = f" That is more than {within:g} s." if one.gap > within else ""
    return f"{one.frozen} froze; {one.standby} took over after {one.gap * 1000:.0f} ms{detected}; {stopped}.{late}"


def _require_ros() -> None:
    """Raise CommandError if a part of ROS 2 is not installed."""
    if missing := [name for name in NEEDED if name != "rmw_fastrtps_cpp" and find_spec(name) is None]:
        raise CommandError(
            f"ROS 2 is not installed ({', '.join(missing)} not found). Install Understudy with it, in a clone of its repository:\n"
            "python3 -m venv ~/understudy && ~/understudy/bin/pip install '.[ros]'\n"
            "~/understudy/bin/understudy try\n"
            "The packages come from PyPI, for x86-64 Linux. On other machines, source a ROS 2 Jazzy installation"
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
        "The gate, the DDS partitions and the health tree are those of a cluster. The processes use the loopback interface and a ROS "
        "domain of their own, and end with the command.",
        epilog="Exit status: 0 if the robot was driven by the standby in time after each freeze, and never by two instances; 1 otherwise; 2 on "
        "an error.",
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

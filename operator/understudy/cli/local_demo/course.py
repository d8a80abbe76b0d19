"""The course of the demo: start, freeze the instance that drives, let it continue, and again."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from understudy.cli.common.errors import CommandError
from understudy.cli.local_demo.record import Failover, failover, leaked
from understudy.cli.local_demo.stand import INSTANCES, Stand
from understudy.cli.local_demo.view import Display

STARTS_WITHIN = 60.0
"""Seconds within which the robot must be driven."""

LOOK = 0.03
"""Seconds between two looks at the journals."""

FROZEN_FOR, WATCHED_FOR = 2.0, 2.0
"""Seconds for which the failed instance stays frozen after its standby took over, and for which it is watched when it sends again."""

LATE = 5.0
"""Seconds for which a standby is waited for that is too late."""


class Ended(Exception):
    """The user has ended the demo."""


class Demo:
    """The course of the demo."""

    def __init__(
        self,
        stand: Stand,
        display: Display,
        key: Callable[[], str],
        *,
        failures: int,
        freeze_after: float,
        within: float,
    ) -> None:
        """``key`` returns the key that was pressed, or nothing. ``failures`` is the number of freezes, or 0 for no end.

        The others are seconds: before each freeze, and without a command at the robot that it survives.
        """
        self.failovers: list[Failover] = []
        self._stand, self._display, self._key = stand, display, key
        self._failures, self._freeze_after, self._within = failures, freeze_after, within
        self._freezes_now = False
        self._seen = 0
        """Number of detections that were shown."""

    def run(self) -> None:
        """Start, freeze as often as asked for, and return. Raises CommandError, and Ended if the user ends it."""
        self._start()
        while not self._failures or len(self.failovers) < self._failures:
            self._fail()

    def _start(self) -> None:
        stand = self._stand
        self._note("starting a robot, two instances, a mux and a monitor")

        def is_driven() -> bool:
            return bool(stand.monitor.active and stand.robot.commands) and all(
                stand.monitor.sends.get(name, 0) for name in INSTANCES
            )

        if not self._wait(is_driven, STARTS_WITHIN):
            raise CommandError(f"the robot is not driven after {STARTS_WITHIN:.0f} s{stand.output()}")
        self._note(
            f"{stand.monitor.active} drives; {self._standby()} does the same, and the gate keeps it from the robot"
        )

    def _fail(self) -> None:
        """Freeze the active instance, and later let it continue."""
        stand = self._stand
        self._freezes_now = False
        self._wait(lambda: self._freezes_now, self._freeze_after if self._failures else math.inf)
        active, standby = stand.monitor.active, self._standby()
        at = stand.freeze(active)
        self._note(f"{active} is frozen (SIGSTOP): it still runs, and sends nothing")

        def now() -> Failover:
            return failover(stand.robot, stand.monitor, active, at, standby)

        self._wait(lambda: now().first is not None, self._within + LATE)
        found = now()
        self.failovers.append(found)
        if found.gap is None:
            self._note("no standby has taken over")
            raise Ended
        self._note(f"{standby} drives: the robot was without commands for {found.gap * 1000:.0f} ms")
        self._wait(lambda: False, FROZEN_FOR)
        woken, before = stand.wake(active), stand.monitor.sent[active]
        self._note(f"{active} continues (SIGCONT), and does not know that it was replaced")
        self._wait(lambda: False, WATCHED_FOR)
        found.leaked = leaked(stand.robot, stand.monitor, active, woken, time.monotonic())
        if stand.monitor.active == active:
            self._note(f"{active} is in control again, because {standby} has failed meanwhile")
            return
        found.sent = stand.monitor.sent[active] - before
        self._note(f"{active} has sent {found.sent} commands, and {found.leaked or 'none'} of them reached the robot")

    def _standby(self) -> str:
        return next(name for name in INSTANCES if name != self._stand.monitor.active)

    def _wait(self, holds: Callable[[], bool], most: float) -> bool:
        """Show what happens until something holds; returns False if it does not in time. Raises CommandError and Ended."""
        end = time.monotonic() + most
        while True:
            self._stand.update()
            self._show_others()
            now = time.monotonic()
            self._display.show(self._stand, now)
            pressed = self._key()
            if pressed in ("q", "\x04"):
                raise Ended
            self._freezes_now |= pressed == "f"
            if holds():
                return True
            if now >= end:
                return False
            time.sleep(LOOK)

    def _show_others(self) -> None:
        """Show failures of instances that nobody froze, such as on a machine that is too busy."""
        detections = self._stand.monitor.detections
        for one in detections[self._seen :]:
            if one.instance not in self._stand.frozen:
                self._note(f"{one.instance} failed although nobody froze it ({one.reason}); is this machine busy?")
        self._seen = len(detections)

    def _note(self, text: str) -> None:
        self._display.note(time.monotonic(), text)

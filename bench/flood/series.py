"""Failures of one robot, one after the other, and their recoveries."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from understudy_demo.recovery import Recovered

from bench.recovery import EXPECTED
from tests.e2e.kubectl import Failed, Object
from tests.e2e.scenario import Robot

FIRST = 8.0
"""Seconds from the beginning of a flood to the first failure in it."""

SETTLED = 3.0
"""Seconds for which a standby is ready before the next failure, and for which the flood knows its address."""

LAST = 6.0
"""Seconds of a flood in which no failure begins any more."""

AFTERWARDS = 2.0
"""Seconds after a failure in which no standby is awaited."""

LINES = 20_000
"""Lines of the robot's log that are read: a few minutes."""

GAP = "robot: gap without commands"


@dataclass
class Found:
    """The results of one variant, or of all times without a flood."""

    values: dict[str, list[float]] = field(default_factory=dict)
    """Milliseconds, one for each failure, by figure."""
    rates: dict[tuple[str, str], list[float]] = field(default_factory=dict)
    """One for each flood, by figure and unit."""
    unasked: list[str] = field(default_factory=list)
    """Recoveries of failures that the bench did not make."""
    wrong: list[str] = field(default_factory=list)
    """Recoveries by another strategy, and failures without a recovery."""
    conditions: Counter[str] = field(default_factory=Counter)
    """How often each status and reason of the conditions was seen, once a second."""
    restarts: dict[str, int] = field(default_factory=dict)
    """Of containers by pod, and of pods that were replaced."""
    leaks: int = 0
    """Commands of a standby before the switch."""
    memory: dict[str, list[float]] = field(default_factory=dict)
    """Most memory of containers so far in MB, by container."""

    def add(self, figure: str, value: float) -> None:
        """Add the value of one failure."""
        self.values.setdefault(figure, []).append(value)


class Series:
    """Failures of one robot from now on, which end its active application."""

    def __init__(self, robot: Robot, found: Found) -> None:
        self._robot, self._found = robot, found
        self._killed: list[str] = []
        self._before = robot.status().get("recoveryCount", 0)

    @property
    def made(self) -> int:
        """The number of failures."""
        return len(self._killed)

    def fail(
        self, most: int, *, within: float, before_each: Callable[[], None] | None = None, to_the_end: bool = False
    ) -> None:
        """Make at most so many failures within so many seconds, each when a standby has been ready for a while.

        ``before_each`` is called at the beginning and when a standby is ready. ``to_the_end``: return when the seconds are over.
        """
        begun = time.monotonic()
        if before_each is not None:
            before_each()
        self._watch_until(begun + FIRST)
        while self.made < most and (active := self._await_standby(begun + within - LAST - SETTLED)):
            if before_each is not None:
                before_each()
            self._watch_until(time.monotonic() + SETTLED)
            self._kill(active)
            self._watch_until(time.monotonic() + AFTERWARDS)
        if to_the_end:
            self._watch_until(begun + within)

    def record(self) -> None:
        """Add what happened to the results."""
        robot, found = self._robot, self._found
        status = robot.status()
        entries = [Recovered.read(entry) for entry in reversed(status.get("recoveries") or [])]
        entries = [one for one in entries if one.number > self._before]
        if (missing := status.get("recoveryCount", 0) - self._before - len(entries)) > 0:
            found.unasked += ["a recovery that the status does not list any more"] * missing
        log = robot.log(tail=LINES)
        for one in entries:
            if one.old not in self._killed:
                found.unasked.append(f"{one.old} -> {one.new}: {one.reason}")
                continue
            handover = log.handover(one.old, one.new, switch=one.moments.get("decided"))
            if one.strategy != EXPECTED["executing"] or one.seconds is None or handover.gap is None:
                found.wrong.append(f"{one.old} -> {one.new} by {one.strategy or one.result}: {one.attempts}")
                continue
            found.add(GAP, 1000 * handover.gap)
            found.add("t_recovery", 1000 * one.seconds)
            found.add("t_detection", 1000 * one.parts["detection"])
            found.add("t_cluster", 1000 * one.parts["cluster"])
            found.add("decision to gate enforced", 1000 * (one.moments["routed"] - one.moments["decided"]))
            found.leaks += len(handover.early)
        unrecovered = set(self._killed) - {one.old for one in entries}
        found.wrong += [f"{pod} was not recovered" for pod in sorted(unrecovered)]

    def _kill(self, active: str) -> None:
        """End the application, unless something else has replaced it meanwhile."""
        if self._look().get("active") == active:
            try:
                self._robot.fail(active, "killed")
            except Failed as error:
                print(f"{active} is gone: {error}", file=sys.stderr)
            else:
                self._killed.append(active)

    def _await_standby(self, until: float) -> str:
        """Wait for a standby until a moment (monotonic seconds). Returns the active pod; empty if there is no standby then."""
        while time.monotonic() < until:
            status = self._look()
            protected = any(c["type"] == "Protected" and c["status"] == "True" for c in status.get("conditions") or [])
            ready = status.get("health") == "Healthy" and status.get("strategy") == "Executing" and protected
            if ready and status.get("active") and status["active"] not in self._killed:
                return str(status["active"])
            time.sleep(1.0)
        return ""

    def _watch_until(self, moment: float) -> None:
        while (left := moment - time.monotonic()) > 0:
            time.sleep(min(1.0, left))
            self._look()

    def _look(self) -> Object:
        """Note the conditions. Returns the status."""
        try:
            status = self._robot.status()
        except Failed as error:
            print(f"the API server does not answer: {error}", file=sys.stderr)
            return {}
        for one in status.get("conditions") or []:
            if one["type"] in ("SoleDriver", "GateEnforced"):
                self._found.conditions[f"{one['type']} {one['status']} {one['reason']}"] += 1
        return status


class Machine:
    """The use of this machine's processors from now on."""

    def __init__(self) -> None:
        self._begun = self._read()

    def shares(self) -> dict[str, float]:
        """Return the percentage of all processor time that was used, and that of software interrupts."""
        used = [now - then for now, then in zip(self._read(), self._begun, strict=True)]
        whole, (idle, waiting), soft = sum(used), used[3:5], used[6]
        return {
            "processors busy": 100 * (whole - idle - waiting) / whole,
            "software interrupts": 100 * soft / whole,
        }

    @staticmethod
    def _read() -> list[int]:
        return [int(word) for word in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]


def address(pod: Object) -> str:
    """Return the address of a pod that runs; empty if it has none or is being deleted."""
    return "" if pod["metadata"].get("deletionTimestamp") else str(pod["status"].get("podIP", ""))

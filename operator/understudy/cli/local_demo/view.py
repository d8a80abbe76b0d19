"""Shows the demo while it runs: as a screen that is redrawn, or as one line per event."""

from __future__ import annotations

from typing import TextIO

from understudy.api.plain_text import plain
from understudy.cli.common.text import terminal
from understudy.cli.common.text.tree_text import WORDS, coloured, rough
from understudy.cli.common.text.wording import wrapped
from understudy.cli.local_demo.stand import INSTANCES, Stand

RATED = 1.0
"""Seconds over which the commands at the robot are counted."""

BIN = 0.1
"""Seconds that one character of the strip shows."""

STRIP = 70
"""Most characters of the strip."""

PERIOD = 0.1
"""Seconds between two screens."""

ROOMY = 20
"""Least lines of a terminal in which there is space for an explanation besides the events."""

FOOT = "Press f to freeze the instance that drives, q to end."

SIMULATED = (
    "Simulated: the robot, its application, the freeze and the API server. Real: the gate (understudy mux), the health tree, and DDS "
    "between the processes."
)


class Lines:
    """Prints one line per event."""

    def __init__(self, out: TextIO, started: float) -> None:
        self._out, self._started = out, started
        self._note(started, SIMULATED)

    def show(self, stand: Stand, now: float) -> None:
        """Do nothing: figures that change are for a screen."""

    def note(self, at: float, text: str) -> None:
        """Print an event. Its time is in seconds of the monotonic clock."""
        self._note(at, text)

    def close(self) -> None:
        """Do nothing."""

    def _note(self, at: float, text: str) -> None:
        print(f"{at - self._started:6.2f} s  {plain(text)}", file=self._out, flush=True)


class Screen:
    """Redraws a table of the instances, and which commands reached the robot."""

    def __init__(self, out: TextIO, started: float) -> None:
        self._out, self._started, self._drawn = out, started, 0.0
        self._notes: list[str] = []
        terminal.begin(out)

    def show(self, stand: Stand, now: float) -> None:
        """Draw the present state, ten times a second. ``now`` is in seconds of the monotonic clock."""
        if now - self._drawn < PERIOD:
            return
        self._drawn = now
        robot, monitor = stand.robot, stand.monitor
        width = (terminal.columns(self._out) or 80) - 1
        strip = max(10, min(STRIP, width - len(INSTANCES[0]) - 2))
        health = coloured(WORDS[monitor.health], monitor.health, colours=terminal.colours(self._out))
        last = f"; last command {rough(now - robot.commands[-1].at)} ago" if robot.commands else ""
        lines = [
            f"understudy try, {now - self._started:.0f} s: one robot and two instances of its application",
            *(wrapped(SIMULATED, width, indent=0) if terminal.rows() >= ROOMY else ()),
            "",
            *(self._row(stand, name, now) for name in ("", *INSTANCES)),
            "",
            f"Commands at the robot in the last {strip * BIN:.0f} s, by the instance that sent them:",
            *(f"{name}  {marks(stand, name, now, strip)}" for name in INSTANCES),
            "",
            f"robot: {robot.speed:.1f} m/s at {robot.position[0]:.2f}, {robot.position[1]:.2f} m{last}",
            f"health tree: {health}{': ' if monitor.reason else ''}{plain(monitor.reason)}",
            "",
        ]
        lines += self._notes[-max(1, terminal.rows() - len(lines)) :]
        terminal.draw(self._out, lines, FOOT)

    def note(self, at: float, text: str) -> None:
        """Add an event to the screen. Its time is in seconds of the monotonic clock."""
        self._notes.append(f"{at - self._started:6.2f} s  {plain(text)}")
        self._drawn = 0.0

    def close(self) -> None:
        """Restore the terminal, and leave the events in it."""
        terminal.end(self._out)
        for line in self._notes:
            print(line, file=self._out)

    def _row(self, stand: Stand, name: str, now: float) -> str:
        if not name:
            return f"{'INSTANCE':12}{'STATE':12}{'SENDS':>8}{'REACHES THE ROBOT':>20}  IN CONTROL"
        active, is_frozen = stand.monitor.active, name in stand.frozen
        sends = stand.monitor.sends.get(name, 0.0)
        reaches = stand.robot.received(name, since=now - RATED, until=now) / RATED
        state = "frozen" if is_frozen else "drives" if name == active else "standby" if sends else "starting"
        colour = {"frozen": "Failed", "drives": "Healthy", "starting": "Starting"}.get(state, "")
        word = coloured(f"{state:12}", colour, colours=bool(colour) and terminal.colours(self._out))
        return f"{name:12}{word}{sends:6.0f}/s{reaches:18.0f}/s  {'yes' if name == active else ''}".rstrip()


def marks(stand: Stand, name: str, now: float, count: int) -> str:
    """Return one character for each tenth of a second until now: a bar if a command of the instance reached the robot then."""
    end = int(now / BIN)
    seen = [False] * count
    for command in reversed(stand.robot.commands):
        place = int(command.at / BIN) - end + count - 1
        if place < 0:
            break
        if command.source == name and place < count:
            seen[place] = True
    return "".join("|" if one else "." for one in seen)


Display = Lines | Screen

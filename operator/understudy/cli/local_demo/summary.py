"""The summary of the demo: what the robot recorded, what was simulated, and what to read next. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from understudy.cli.common.text.wording import counted
from understudy.cli.local_demo.record import Failover, MonitorRecord, RobotRecord, one_at_a_time
from understudy.cli.local_demo.robot import COMMANDS

NEXT = (
    ("docs/concepts.md", "how it works, in five minutes"),
    ("docs/tutorial.md", "the same with your own two scripts in a cluster"),
    ("scripts/demo", "three failures in a real cluster"),
)

SHOWN = 6
"""Most changes of the driver that are listed."""


@dataclass(frozen=True)
class Summary:
    """The result of all freezes."""

    failovers: Sequence[Failover]
    robot: RobotRecord
    monitor: MonitorRecord
    gap: float
    """Seconds of silence that count as a failure."""
    within: float
    """Seconds without a command at the robot that it survives."""

    @property
    def survived(self) -> int:
        """The number of freezes after which the standby drove in time."""
        return sum(one.gap is not None and one.gap <= self.within for one in self.failovers)

    @property
    def has_one_driver(self) -> bool:
        """Whether only the instance in control has reached the robot at each moment."""
        return one_at_a_time(self.robot, self.monitor) and not any(one.leaked for one in self.failovers)

    @property
    def is_good(self) -> bool:
        """Whether the robot survived everything."""
        return self.survived == len(self.failovers) and self.has_one_driver

    def lines(self) -> Iterator[str]:
        """Yield the text."""
        yield ""
        yield f"The robot survived {self.survived} of {counted(len(self.failovers), 'freeze')}."
        for number, one in enumerate(self.failovers, 1):
            yield f"  {number}. {self._described(one)}"
        total = len(self.robot.commands)
        if self.has_one_driver:
            sent = sum(one.sent for one in self.failovers)
            yield (
                f"Never two drivers: {total} commands reached the robot, each from the instance in control. Of {sent} commands of "
                "instances that continued after they had been replaced, the gate let none through."
            )
        else:
            drivers = self.robot.drivers
            more = ", and so on" if len(drivers) > SHOWN else ""
            yield f"TWO DRIVERS: {total} commands reached the robot, from {', then '.join(drivers[:SHOWN])}{more}."
        yield from self.monitor.problems
        yield ""
        yield (
            f"Real: the gate (understudy mux and DDS partitions), the detection (a health tree: {COMMANDS} with a gap of "
            f"{self.gap * 1000:.0f} ms at most), and the times, which the robot has recorded."
        )
        yield (
            "Simulated: the robot, its application, the freeze (SIGSTOP), and the cluster. In a cluster, the monitor first writes the gate "
            "to the API server, which takes some milliseconds, and a failed instance is replaced."
        )
        yield ""
        yield "Next:"
        for place, what in NEXT:
            yield f"  {place:18}{what}"

    def _described(self, one: Failover) -> str:
        if one.gap is None:
            return f"{one.frozen} froze, and nobody took over."
        reason = f" (detected: {one.reason})" if one.reason else ""
        stopped = "stopped meanwhile" if one.stopped else "did not stop"
        late = f" That is more than {self.within:g} s." if one.gap > self.within else ""
        return (
            f"{one.frozen} froze; {one.gap * 1000:.0f} ms after its last command at the robot, {one.standby} drove{reason}; the robot "
            f"{stopped}.{late}"
        )

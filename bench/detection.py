"""Measures how late the monitor notices failures on a machine whose cores are all busy, with a health tree of 20
leaves.

    scripts/bench detection [--failures 120] [--seed 1]

A robot at work (bench/leaves.py) is judged as in the monitor. Failures of all kinds come in random order: a process
is frozen (SIGSTOP), a rate is too low, a value is out of its bounds, a stamp is old, the diagnostics or the log
report an error, a node is deactivated. Meanwhile one process per core computes without a pause, at the same priority
as all others.

Lateness is the time from the moment at which the configuration makes it a failure until the verdict. For a gap or a
rate, that moment follows from the times of receipt. For the content of a message, it is the receipt of the message
plus ``for``. Publishers and nodes that end are reported separately, because the monitor looks at the ROS graph ten
times a second.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from bench.counting import falls_below, first_from
from bench.leaves import LEAVES, Leaf, at_work, await_grace, kinds, senders_fault, topics, traffic
from bench.load import Load
from bench.results import Report
from bench.roles import Role

PREMATURE = 0.001
"""Seconds that a verdict may be early because of rounding."""

GRAPH = "gone from the ROS graph"


@dataclass(frozen=True)
class Failure:
    """One way to fail."""

    kind: str
    leaf: str
    """The leaf that detects it."""
    change: Mapping[str, Any] = field(default_factory=dict)
    """The change of the leaf's stream. Its process is frozen if there is neither a change nor an action."""
    do: str = ""
    """The action that the process carries out instead."""
    undo: str = ""


FAILURES = (
    Failure("gap", "driving/cmd_vel"),
    Failure("gap", "sensors/joint_states"),
    Failure("gap", "sensors/wrist_camera"),
    Failure("gap of a transform", "transforms/base_link"),
    Failure("rate", "sensors/lidar"),
    Failure("rate", "sensors/imu", {"hertz": 50}),
    Failure("rate", "sensors/odom", {"hertz": 25}),
    Failure("value", "driving/tracking_error", {"spoil": "too far"}),
    Failure("value", "state/battery", {"spoil": "empty"}),
    Failure("value", "state/motor_temperature", {"spoil": "hot"}),
    Failure("age", "sensors/lidar_age", {"old": 1.0}),
    Failure("age of a transform", "transforms/base_link", {"old": 1.0}),
    Failure("diagnostics", "state/camera_driver", {"spoil": "camera: driver"}),
    Failure("diagnostics", "state/motors", {"spoil": "motors: left"}),
    Failure("log", "state/log", do="log"),
    Failure("lifecycle", "state/planner", do="deactivate", undo="activate"),
    Failure(GRAPH, "state/grip_commands", do="remove_publisher", undo="add_publisher"),
    Failure(GRAPH, "state/speaker", do="remove_node", undo="add_node"),
)


def due(leaf: Leaf, failure: Failure, begun: float, seen: Mapping[str, Any]) -> float | None:
    """Return when a failure met the configured condition, according to what was received; None if it did not.

    ``begun`` is when the failure was made, or when its first message was about to be sent. ``seen`` is the reported
    verdict. All times are Unix seconds.
    """
    arrivals: Sequence[float] = seen["arrivals"]
    if failure.kind == GRAPH:
        return begun
    if leaf.window is not None:
        return falls_below(arrivals, leaf.window.least, leaf.window.length, begun)
    if not failure.change and not failure.do:
        assert leaf.gap is not None, "what is frozen fails by a rate or a gap"
        # Other transforms are on the same topic, so only the tree knows which message was the last.
        last = seen["onset"] if leaf.kind == "transform" else arrivals[-1]
        return float(last) + leaf.gap
    received = first_from(arrivals, begun)
    return received + leaf.hold_off if received is not None else None


def plan(count: int, chance: random.Random) -> Iterator[Failure]:
    """Yield ``count`` failures in random order, each kind as often as the others."""
    left: list[Failure] = []
    for _ in range(count):
        if not left:
            left = chance.sample(FAILURES, len(FAILURES))
        yield left.pop()


@dataclass
class Bench:
    """The run: the lateness by kind of failure, in ms, and the verdicts without a cause."""

    roles: Mapping[str, Role]
    late: dict[str, list[float]] = field(default_factory=dict)
    uncalled: list[str] = field(default_factory=list)

    def fail(self, failure: Failure) -> None:
        """Make one failure, wait for the verdict, and restore the robot."""
        leaf = next(leaf for leaf in LEAVES if leaf.path == failure.leaf)
        process, judge = self.roles[leaf.process], self.roles["ours"]
        for told in judge.told_so_far():
            if told["told"] == "failed":
                fault = senders_fault(told, self.roles)
                self._note([told], f"while all was well{f', but its sender late: {fault}' if fault else ''}")
        begun = self._make(failure, leaf, process)
        seen = self._next("failed", judge)
        moment = due(leaf, failure, begun(), seen) if seen["leaf"] == failure.leaf else None
        if moment is None or seen["detected"] < moment - PREMATURE:
            self._note([seen], f"while {failure.leaf} was to fail by {failure.kind}")
        else:
            self.late.setdefault(failure.kind, []).append(1000 * (seen["detected"] - moment))
        self._mend(failure, leaf, process)
        self._next("healthy", judge)
        if leaf.window is not None:
            # While it recovers, a rate may cross its bound several times.
            time.sleep(leaf.window.length)
            self._note(
                [one for one in judge.told_so_far() if one.get("leaf") != leaf.path], f"after {leaf.path} was well"
            )

    def _make(self, failure: Failure, leaf: Leaf, process: Role) -> Callable[[], float]:
        """Make the failure. Returns a function that returns its start, once the verdict is known."""
        process.told_so_far()
        if failure.do:
            at = process.ask(failure.do)["at"]
            return lambda: at
        if failure.change:
            process.ask("set", stream=leaf.key, **failure.change)
            return lambda: process.told(10)["at"]
        at = time.time()
        process.signal(signal.SIGSTOP)
        return lambda: at

    def _mend(self, failure: Failure, leaf: Leaf, process: Role) -> None:
        if failure.undo:
            process.ask(failure.undo)
        elif failure.change:
            process.ask("set", stream=leaf.key)
        elif not failure.do:
            process.signal(signal.SIGCONT)

    def _next(self, state: str, judge: Role) -> dict[str, Any]:
        """Return the next report that the tree has entered a state."""
        while (told := judge.told(30))["told"] != state:
            self._note([told], f"before it was {state}")
        return told

    def _note(self, told: Sequence[Mapping[str, Any]], when: str) -> None:
        self.uncalled += [f"{one['leaf']} {when}: {one['reason']}" for one in told if one["told"] == "failed"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--failures", type=int, default=126)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    chance = random.Random(options.seed)
    report = Report("detection")
    with at_work() as roles, Load() as load:
        bench = Bench(roles)
        await_grace(roles["ours"])
        before = roles["ours"].ask("seen", windows={})
        cpu, begun = roles["ours"].cpu(), time.monotonic()
        for number, failure in enumerate(plan(options.failures, chance)):
            time.sleep(0.5 + chance.random())
            bench.fail(failure)
            if (number + 1) % 10 == 0:
                shown = sorted(late for kind, found in bench.late.items() if kind != GRAPH for late in found)
                print(
                    f"failure {number + 1}/{options.failures}: {shown[-1] if shown else 0:.1f} ms at most", flush=True
                )
        seen = roles["ours"].ask("seen", windows={})
        used = 1000 * (roles["ours"].cpu() - cpu) / (time.monotonic() - begun)
        loaded = load.note()
    timed = {kind: late for kind, late in sorted(bench.late.items()) if kind != GRAPH}
    report.figure(
        "past the configured time",
        [late for found in timed.values() for late in found],
        unit="ms",
        must={"p95": 15.0},
    )
    for kind, late in timed.items():
        report.figure(f"of these: {kind}", late, unit="ms")
    if GRAPH in bench.late:
        report.figure(f"past its end: {GRAPH}", bench.late[GRAPH], unit="ms", limit="looked at every 100 ms")
    report.figure("verdicts that nothing called for", [len(bench.uncalled)], unit="")
    report.figure("CPU of the monitor's process", [used], unit="milli-CPU")
    report.note("load", loaded)
    report.note("tree", f"{kinds()}; on {len(topics())} topics")
    report.note("traffic", traffic())
    report.note(
        "verdicts",
        f"{seen['verdicts'] - before['verdicts']}, of which {seen['doubted'] - before['doubted']} were put off since the monitor's "
        "process itself had been stalled",
    )
    for number, text in enumerate(bench.uncalled):
        report.note(f"uncalled for {number + 1}", text)
    print(report.table())
    print(report.write())
    sys.exit(0 if report.held else 1)


if __name__ == "__main__":
    main()

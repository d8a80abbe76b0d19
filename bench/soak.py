"""Checks whether the monitor ever raises a false alarm, and whether a robot is ever switched to another instance, while
nothing fails and all cores are busy.

    scripts/bench soak [--minutes 30] [--deadline 100] [--load 2] [--neighbours 0]

The bench causes no failure. One process per core computes without a pause, at the same priority as all others.

A robot at work (bench/leaves.py) is judged by 20 leaves as in the monitor. Its processes compete for the processor
like all others, and each records when it sent which message. If the message of an alarm was late by its sender's own
clock, the sender was starved and the alarm is true. The bench counts such alarms separately, with the sender's record.

Two robots on the cluster have an executing standby. One is recovered by the monitor after a gap of 500 ms, the other
has a reflex too. From the log of commands that each robot keeps, the bench counts how often its reader switched to
another instance, how often an instance was replaced, and the longest gap of each minute.
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.driven import Row, add_driven, crowd, driven, on_cluster, robots_table
from bench.leaves import LEAVES, OUTPUTS, at_work, await_grace, kinds, senders_fault, topics, traffic
from bench.load import Load
from bench.recovery import TIMEOUT, enforcer
from bench.results import Report
from bench.roles import Role
from tests.e2e.kubectl import Failed
from tests.e2e.scenario import Late, eventually

LOOK = 5.0
"""Seconds between two requests for what was received, of which the last 10 s are kept."""


@dataclass
class Soak:
    """The results, minute by minute."""

    roles: Mapping[str, Role]
    false: list[str] = field(default_factory=list)
    true: list[str] = field(default_factory=list)
    gaps: dict[str, list[float]] = field(default_factory=dict)
    """Worst gap in ms, by topic."""
    rates: dict[str, list[float]] = field(default_factory=dict)
    """Least rate in Hz over the leaf's window, by topic."""
    late: list[float] = field(default_factory=list)
    """The largest delay of a check, in ms."""
    waited: list[float] = field(default_factory=list)
    """The longest wait of a message that must be evaluated on arrival, in ms."""
    memory: list[float] = field(default_factory=list)
    """Resident memory, in MB."""
    cpu: list[float] = field(default_factory=list)
    verdicts: int = 0
    doubted: int = 0

    def begin(self) -> None:
        """Discard earlier results."""
        seen = self.roles["ours"].ask("seen", windows=WINDOWS)
        self.verdicts, self.doubted = -seen["verdicts"], -seen["doubted"]
        self.memory.append(self.roles["ours"].rss())

    def minute(self, length: float) -> None:
        """Record for this many seconds."""
        judge = self.roles["ours"]
        gaps: dict[str, float] = {}
        least: dict[str, float] = {}
        late, waited, cpu, begun = 0.0, 0.0, judge.cpu(), time.monotonic()
        while (rest := begun + length - time.monotonic()) > 0:
            time.sleep(min(LOOK, rest))
            for told in judge.told_so_far():
                if told["told"] == "failed":
                    self._judge_alarm(told)
            seen = judge.ask("seen", windows=WINDOWS)
            late, waited = max(late, seen["late"]), max(waited, seen["waited"])
            for topic, gap in seen["gaps"].items():
                gaps[topic] = max(gaps.get(topic, 0.0), gap)
            for topic, count in seen["least"].items():
                if count is not None:
                    least[topic] = min(least.get(topic, math.inf), count / WINDOWS[topic])
        self.cpu.append(1000 * (judge.cpu() - cpu) / (time.monotonic() - begun))
        self.late.append(1000 * late)
        self.waited.append(1000 * waited)
        self.memory.append(judge.rss())
        for topic, gap in gaps.items():
            self.gaps.setdefault(topic, []).append(1000 * gap)
        for topic, rate in least.items():
            self.rates.setdefault(topic, []).append(rate)
        self.seen = seen

    def end(self) -> None:
        """Add the number of verdicts."""
        self.verdicts += self.seen["verdicts"]
        self.doubted += self.seen["doubted"]

    def _judge_alarm(self, told: Mapping[str, Any]) -> None:
        text, fault = f"{told['leaf']}: {told['reason']}", senders_fault(told, self.roles)
        print(f"{'true' if fault else 'FALSE'} alarm: {text}{f' ({fault})' if fault else ''}", flush=True)
        if fault:
            self.true.append(f"{text}; its sender: {fault}")
        else:
            self.false.append(text)


WINDOWS = {leaf.topic: leaf.window.length for leaf in LEAVES if leaf.window is not None}
"""Lengths of the windows of rates in seconds, by topic."""


def limits(topic: str) -> str:
    """Return the limits of the leaves that judge a topic's gap."""
    found = [
        f"{leaf.path} fails at {1000 * leaf.gap:g}" for leaf in LEAVES if leaf.topic == topic and leaf.gap is not None
    ]
    return ", ".join(found)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--deadline", type=int, default=100, help="spec.gate.reflex.deadline in milliseconds")
    parser.add_argument(
        "--load",
        type=int,
        default=os.cpu_count(),
        help="processes that compute without a pause, by default one for each core; 0 if something else keeps the cores busy",
    )
    parser.add_argument(
        "--neighbours",
        type=int,
        default=0,
        help="pods on each node that compute without a pause: the processes outside compete with the whole cluster",
    )
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # whoever ends it, the pods must end too
    report = Report("soak")
    policies = enforcer()  # not later, because the cores are busy then
    whole = math.ceil(options.minutes)
    with on_cluster(Path(os.environ["KUBECONFIG"]), {"gap": None, "reflex": options.deadline}) as robots:
        crowd(robots["gap"].kubectl, options.neighbours)
        with at_work() as roles, Load(options.load) as load:
            await_grace(roles["ours"])
            soak, begun, armed = Soak(roles), time.time(), dict.fromkeys(robots, 0)
            soak.begin()
            for number in range(whole):
                soak.minute(60.0 * min(1.0, options.minutes - number))
                for name, robot in robots.items():
                    armed[name] += robot.armed()
                gap = max(soak.gaps, key=lambda topic: soak.gaps[topic][-1])
                print(
                    f"minute {number + 1}/{whole}: {len(soak.false)} false alarms, {len(soak.true)} true ones, looks late by "
                    f"{soak.late[-1]:.1f} ms at most and by {soak.waited[-1]:.1f} ms after a message, "
                    f"worst gap {soak.gaps[gap][-1]:.0f} ms of {gap}, {soak.memory[-1]:.1f} MB, "
                    f"cores {load.busy():.0f} % busy",
                    flush=True,
                )
            soak.end()
            loaded = load.note()
        # Not earlier, because kubectl would take processor time from the robots.
        logs = {name: eventually(robot.log, within=120, what=f"the log of {name}") for name, robot in robots.items()}
        recorded = {name: robot.recoveries() for name, robot in robots.items()}
    add_leaves(report, soak, options.minutes)
    rows = [Row("20 leaves (alarms)", len(soak.false) + len(soak.true), soak.gaps[OUTPUTS[0]["topic"]])]
    labels = {"gap": f"{1000 * TIMEOUT:g} ms gap", "reflex": f"{options.deadline} ms reflex"}
    for name, label in labels.items():
        found = driven(logs[name], begun, begun + 60 * options.minutes)
        most = max(1, int(options.minutes / 60)) if name == "reflex" else 0
        add_driven(report, label, found, recorded[name], begun, most=most)
        report.note(f"{label}: a standby could take over", f"at the end of {armed[name]} of {whole} minutes")
        gaps = [1000 * gap for gap in found.gaps]
        rows.append(Row(label, found.recoveries, gaps, switches=found.switches, armed=armed[name]))
    report.note("load", f"{loaded}; {options.neighbours} pods on each node")
    report.note("network policies", policies)
    print(report.table())
    print(f"\n{robots_table(rows)}\n")
    print(report.write())
    return 0 if report.held else 1


def add_leaves(report: Report, soak: Soak, minutes: float) -> None:
    """Add what the judge of 20 leaves found."""
    report.figure("false alarms", [len(soak.false)], unit=f"in {minutes:g} min", must={"max": 0})
    report.figure("true alarms: a sender was starved", [len(soak.true)], unit=f"in {minutes:g} min")
    report.figure("verdicts", [soak.verdicts], unit="")
    report.figure("failed verdicts put off after a stall of the monitor", [soak.doubted], unit="")
    report.figure("looks after they were due, most of each minute", soak.late, unit="ms")
    report.figure("looks after a message that calls for one, most of each minute", soak.waited, unit="ms")
    for topic, found in soak.gaps.items():
        if not any(found):
            continue  # such as a topic of transitions, of which there were none
        report.figure(f"worst gap of {topic}, each minute", found, unit="ms", limit=limits(topic))
    for leaf in LEAVES:
        if leaf.window is not None and leaf.topic in soak.rates:
            name = f"slowest by which {leaf.topic} came, each minute"
            limit = f"{leaf.path} fails unless {leaf.window.band} over {leaf.window.length:g} s"
            report.figure(
                name, [1000 / rate for rate in soak.rates[leaf.topic] if rate], unit="ms a message", limit=limit
            )
    report.figure("memory, each minute", soak.memory, unit="MB")
    report.figure("memory grown", [soak.memory[-1] - soak.memory[0]], unit="MB")
    report.figure("CPU of the monitor's process, each minute", soak.cpu, unit="milli-CPU")
    report.note("looks", f"the bench's own questions, every {LOOK:g} s, make one late by some ms")
    report.note("tree", f"{kinds()}; on {len(topics())} topics")
    report.note("traffic", traffic())
    for name, alarms in (("false alarm", soak.false), ("true alarm", soak.true)):
        for number, text in enumerate(alarms):
            report.note(f"{name} {number + 1}", text)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (Failed, Late) as error:
        sys.exit(str(error).partition(". ")[0])

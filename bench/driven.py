"""Robots on the cluster that are driven while nothing fails, and what their own logs say of it.

Each switch to another instance is needless then. What the API answers does not count: a robot's reader switches by
itself.
"""

from __future__ import annotations

import contextlib
import uuid
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path

from understudy_demo.recovery import Recovered
from understudy_demo.robotview import Command, RobotLog, Silence

from bench.chaos.judge import TOGETHER
from bench.counting import worst_gap
from bench.results import Report, columns, quantile
from tests.e2e.conftest import install
from tests.e2e.kubectl import Failed, Kubectl, Object
from tests.e2e.scenario import Robot, eventually, manifest

ARMED = 300.0
"""Maximum seconds until a standby could take over, before the cores are busy."""

_BUSY = "import hashlib; b = bytes(65536)\nwhile True: hashlib.sha256(b).digest()"

MINUTE = 60.0


@dataclass(frozen=True)
class Driven:
    """What a robot received in a time without a failure."""

    commands: int
    gaps: tuple[float, ...]
    """The longest time without a command in each minute, in seconds."""
    changes: tuple[Silence, ...]
    """The times without a command, however short, after which another instance drove."""
    switches: int
    """Changes of the instance; an instance that takes turns with the next until it is fenced counts once."""
    recoveries: int
    """How often an instance was replaced for good."""


def driven(log: RobotLog, begun: float, ended: float) -> Driven:
    """Return what a robot's log says of the time between two moments."""
    log = log.between(begun, ended)
    changes = tuple(one for one in log.silences(-1.0) if one.before != one.after)
    return Driven(
        len(log.commands),
        tuple(_worst_gaps([command.received for command in log.commands], begun, ended)),
        changes,
        bool(changes) + sum(after.end - before.end > TOGETHER for before, after in pairwise(changes)),
        _replaced(log.commands),
    )


def _worst_gaps(received: Sequence[float], begun: float, ended: float) -> Iterator[float]:
    """Yield the longest gap that ended in each minute, or lasted at its end."""
    since = begun
    while since < ended:
        until = min(since + MINUTE, ended)
        # The last command before the minute is the beginning of its first gap.
        first, end = bisect_left(received, since), bisect_left(received, until)
        times = [received[first - 1] if first else begun, *received[first:end]]
        yield max(worst_gap(times, since), until - times[-1])
        since += MINUTE


def _replaced(commands: Sequence[Command]) -> int:
    """Return how often an instance drove for the last time and another one drove on.

    A standby that the reader followed for a moment, before it went back, replaced nobody.
    """
    last = {command.source: index for index, command in enumerate(commands)}
    found, index = 0, last[commands[0].source] if commands else -1
    while index + 1 < len(commands):
        found, index = found + 1, last[commands[index + 1].source]
    return found


def add_driven(
    report: Report, label: str, found: Driven, recorded: Sequence[Recovered], begun: float, *, most: int
) -> None:
    """Add what a robot's log says to a report.

    ``recorded`` are the recoveries of its status, which explain the switches; ``most`` bounds the switches.
    """
    report.figure(f"{label}: needless switches of the reader", [found.switches], unit="", must={"max": most})
    report.figure(f"{label}: needless recoveries", [found.recoveries], unit="")
    report.figure(f"{label}: commands received", [found.commands], unit="commands")
    gaps = [1000 * gap for gap in found.gaps]
    report.figure(f"{label}: worst gap of /cmd_vel, each minute", gaps, unit="ms")
    for number, change in enumerate(found.changes, 1):
        text = f"{change.before} -> {change.after} after {1000 * change.seconds:.0f} ms without a command"
        report.note(f"{label}: change {number}", f"{text}, at {change.end - begun:.2f} s")
    for one in recorded:
        if (detected := one.moments.get("detected", 0.0)) >= begun:
            text = f"{one.strategy}, {one.old} -> {one.new}, at {detected - begun:.2f} s: {one.reason}"
            report.note(f"{label}: recovery {one.number} in its status", text)


@dataclass(frozen=True)
class Row:
    """One robot of the table."""

    robot: str
    needless: int
    """Recoveries, or alarms of a robot that nobody recovers."""
    gaps: Sequence[float]
    """The longest time without a command in each minute, in ms."""
    switches: int | None = None
    armed: int | None = None
    """Minutes at whose end a standby could take over: without one, nothing switches. None if it never has one."""


def robots_table(rows: Sequence[Row]) -> str:
    """Return the table with a row for each robot."""
    above = (100, 150, 200)
    head = ["robot", "minutes", "with a standby", "switches", "recoveries", "worst gap of a minute: p50 / p95 / max"]
    cells = [[*head, *(f"minutes above {limit} ms" for limit in above)]]
    for row in rows:
        optional = ["-" if value is None else str(value) for value in (row.armed, row.switches)]
        gaps = " / ".join(f"{quantile(row.gaps, fraction):.0f}" for fraction in (0.5, 0.95, 1.0))
        counts = [str(sum(gap > limit for gap in row.gaps)) for limit in above]
        cells.append([row.robot, str(len(row.gaps)), *optional, str(row.needless), f"{gaps} ms", *counts])
    return columns(cells)


class DrivenRobot(Robot):
    """A robot of the quickstart with an executing standby."""

    def __init__(self, kubectl: Kubectl, name: str, deadline: int | None) -> None:
        """``deadline`` is that of its reflex, in milliseconds; None if it has none."""
        super().__init__(kubectl, name)
        self._deadline = deadline

    def start(self) -> None:
        """Create the robot and its application."""
        self.kubectl.apply(self.objects(policy="quickstart-executing", edit=self._edit))

    def _edit(self, workload: Object) -> None:
        if self._deadline is not None:
            workload["spec"]["gate"] = {"reflex": {"deadline": f"{self._deadline}ms"}}

    def wait_armed(self) -> None:
        """Wait until a standby could take over."""
        self.wait_protected(ARMED)
        eventually(self.armed, within=ARMED, what=f"a standby of {self.name} is let through", note=self.describe)

    def armed(self) -> bool:
        """Return whether a standby could take over now: without one, nothing switches needlessly."""
        type_ = "Protected" if self._deadline is None else "Reflex"
        with contextlib.suppress(Failed):  # an API server that is late on a busy machine
            return bool(self.condition(type_).get("status") == "True")
        return False


def crowd(kubectl: Kubectl, count: int) -> None:
    """Start so many pods on each node that compute without a pause, with the share of processors of a robot's container.

    Processes outside of the cluster do not compete with one pod, but with the whole cluster.
    """
    template = next(item for item in manifest("robot.yaml") if item["kind"] == "Deployment")["spec"]["template"]["spec"]
    busy = {key: template["containers"][0][key] for key in ("image", "imagePullPolicy", "securityContext", "resources")}
    pods = []
    for node, number in product([item["metadata"]["name"] for item in kubectl.list("nodes")], range(count)):
        spec = {
            "nodeName": node,
            "terminationGracePeriodSeconds": 0,
            "securityContext": template["securityContext"],
            "containers": [{"name": "busy", "command": ["python3", "-c", _BUSY], **busy}],
        }
        pods.append({"apiVersion": "v1", "kind": "Pod", "metadata": {"name": f"busy-{node}-{number}"}, "spec": spec})
    if pods:
        kubectl.apply(pods)
        kubectl("wait", "--for=condition=Ready", "--timeout=50s", *(f"pod/{pod['metadata']['name']}" for pod in pods))


@contextlib.contextmanager
def on_cluster(kubeconfig: Path, deadlines: Mapping[str, int | None]) -> Iterator[dict[str, DrivenRobot]]:
    """Yield robots that are driven and protected, by name, in a namespace of their own.

    ``deadlines`` has the deadline of each one's reflex.
    """
    install(kubeconfig)
    kubectl = Kubectl(kubeconfig, f"bench-{uuid.uuid4().hex[:6]}")
    kubectl("create", "namespace", kubectl.namespace)
    try:
        kubectl.apply(manifest("strategies/executing.yaml"))
        robots = {name: DrivenRobot(kubectl, name, deadline) for name, deadline in deadlines.items()}
        for robot in robots.values():
            robot.start()
        for robot in robots.values():
            robot.wait_armed()
        yield robots
    finally:
        kubectl("delete", "namespace", kubectl.namespace, "--wait=false")

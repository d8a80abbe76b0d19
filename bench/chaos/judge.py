"""What a campaign meant for its robots, computed from what was recorded. All of it is pure.

The robot's log is the witness: each command with its sender, when it was sent and when it arrived. Commits of the gate say who was in
control at that time, statuses say which recoveries there were, and the faults say which of them were right.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, takewhile

from understudy_demo.recovery import Recovered
from understudy_demo.robotview import Command

from bench.chaos.plan import BY_NAME, STANDBY, Fault
from understudy.failover.limits import backoff

ENFORCEMENT = 0.05
"""Seconds after a commit in which commands of a fenced instance may still arrive."""

DELIVERY = 0.05
"""Seconds that a busy machine may take to expire a command beyond its lifespan, which is one period, or to deliver it."""

STALL = 0.5
"""Longest time in seconds for which a process may get no processor on a busy machine. Nothing else explains a command that is older."""

LAG = 0.75
"""Largest delay of the record of a commit, in seconds: the new instance's commands may arrive that much earlier."""

NOTICED = 1.5
"""Seconds after which the witness has noticed the deletion of a pod: it looks every second."""

DELETED = "is being deleted"
"""End of the reason of a failover from a pod that somebody deleted."""

TOGETHER = 1.0
"""Two instances drive together if their commands take turns with pauses shorter than this, in seconds."""

SHARE = 0.8
"""The part of the allowed gap that a robot must have been silent for before a failover, so that the failover was right."""

REPAIR = 1.5
"""Seconds within which the product undoes what somebody did to labels and gates; until then nobody can keep an instance from driving."""

TAMPERED = {"gate-delete", "gate-edit", "label-remove", "label-exchange"}
"""The kinds of faults that do such a thing."""

CATCHES_UP = 5.0
"""Seconds within which a node that was cut off applies the policies that it has missed, if the API server answers. Until then its network
lets an instance through that was fenced meanwhile, which no product on top of network policies can prevent."""

LEAK_ENDS = 6.0
"""Seconds after the last command of a leaking instance until the gate is open again that was closed for it: 5 of silence, and a margin."""

FIRST_SECONDS = r"within ([\d.]+) s of the monitor's start"
"""What a reason says of an instance that a new monitor has never heard, with the seconds that it listened."""

UNSEEN = "restarted while no monitor watched"
RESTART_KNOWN = 120.0
"""Seconds before a failover for a restart that no monitor saw, in which that had a reason: the kubelet reports it late."""

NODE_LOST = {"node-power", "node-cut"}
"""The kinds of faults that take everything on a node."""

LISTENS = 6.0
"""Seconds that a new monitor may take to hear the instances: DDS announces them every 3 s, and a busy machine is late."""

API = {"api-stop", "api-slow", "api-flap"}
"""The kinds of faults during which nobody learns of changes."""

MUX_STARTS = 3.0
"""Seconds from the start of a mux's container, a whole second, until it forwards: the process starts, and discovery finds it."""

UNORDERED = {"monitor-kill", "monitor-freeze", "discovery-kill", "mux-kill", "mux-freeze", *NODE_LOST, *API}
"""The kinds of faults during which a commit may not reach a mux: the one before stays in force, for one instance."""

LEADS = 5.0
"""Seconds within which a Service leads to a discovery server that is ready. After several outages of the API server in a row, Kubernetes
may have given up (kube-controller-manager: "Retry budget exceeded, dropping service out of the queue")."""

SERVER_STARTS = 3.0
"""Seconds from when a discovery server's pod is ready until the server starts (understudy.ros.dds.sole_server)."""

ACTIVATED = 5.0 + 2.0
"""Seconds until a gate that was deleted during a recovery opens again: 5 of silence of the instance that failed, and a margin."""

BLIND, REPLACES = 90.0, 5.0
"""Seconds after an outage of the API server in which Kubernetes' controllers may see no change, and those that they take to replace a
pod otherwise."""

STARTED_AGAIN = 60.0
"""Seconds within which a monitor must run again at the latest: Kubernetes waits 10, 20 or 40 s before a container's next start."""

EVICTED_AT = 3.0
"""Seconds between the eviction of a monitor and the moment from which on none was seen to run."""

BEFORE = 8.0
"""Seconds before a switch in which a fault may have been its cause."""

TAKES_STATE = 0.5
"""Seconds within which an application on a busy machine acts on the state that its middleware has received for it."""

STATE_AGE = 4.0
"""Seconds of work that a failover may lose: kept state is from before the failure, by the gap and the margin, and a quarter older."""

SWITCH = 0.6
"""Seconds beyond the timeout that a switch to an instance that drives already may take, and a silence without a recovery."""

VERIFY_WITHIN = {
    "Fallback/Executing": 3.0,
    "Fallback/Initialized": 15.0,
    "Fallback/Uninitialized": 30.0,
    "Restart": 60.0,
}
"""Seconds after which the next strategy is tried, by the policies of the quickstart. Each strategy that was tried may take so long."""

HEALTHY_DELAY = 2.0 + 0.5
"""Seconds after which a recovery counts as over (`limits.healthyDelay`), and a margin. An instance that fails earlier was not recovered."""


@dataclass(frozen=True)
class Injected:
    """A fault that was made, with times in Unix seconds."""

    fault: Fault
    begun: float
    ended: float
    told: str = ""
    """What it was made on."""
    refused: str = ""
    """Why it could not be made; empty if it was."""
    is_unsure: bool = False
    """Whether it may have been made nevertheless: the API server did not answer in time."""

    @property
    def waiting(self) -> tuple[float, float]:
        """From when to when a recovery may have to wait for it."""
        kind = BY_NAME[self.fault.kind]
        return self.begun, min(self.ended + kind.after, self.begun + kind.most)

    def overlaps(self, begin: float, end: float) -> bool:
        """Return whether its effects may have been felt between two moments."""
        return self.begun <= end and begin <= self.ended + BY_NAME[self.fault.kind].after


@dataclass(frozen=True)
class Commit:
    """Who was let through from a moment on."""

    seen: float
    """When it was seen, at most a little after it was made."""
    epoch: int
    let_through: tuple[str, ...]
    since: float = math.nan
    """The earliest moment at which it may have been made, if the gate was not watched then."""

    @property
    def earliest(self) -> float:
        return self.seen - LAG if math.isnan(self.since) else self.since


@dataclass(frozen=True)
class Seen:
    """What was recorded of one robot."""

    name: str
    index: int
    timeout: float
    """Seconds without commands that its policy treats as a failure."""
    reflex: float = 0.0
    """Seconds of silence after which its reader takes the standby's commands by itself; 0 if it does not."""
    muxed: bool = False
    """Whether a mux forwards one instance at a time to it, so that nothing explains commands of two that take turns."""
    commands: Sequence[Command] = ()
    commits: Sequence[Commit] = ()
    recoveries: Sequence[Recovered] = ()
    steps: Mapping[int, int] = field(default_factory=dict)
    """The application's step, by the sequence number of the command; empty if it does not count steps."""
    finished: Sequence[tuple[str, str]] = ()
    """Goals that the robot saw finished, each with the instance, once for each time."""
    goals: Mapping[str, str] = field(default_factory=dict)
    """The result of each accepted goal at its client; empty if the client still waits."""
    nodes: Mapping[str, str] = field(default_factory=dict)
    """The node of each instance."""
    monitors: Sequence[tuple[float, str]] = ()
    """When a monitor became ready, and on which node, in order."""
    unmonitored: Sequence[tuple[float, float]] = ()
    """From when to when no monitor of it ran."""
    evictions: Sequence[float] = ()
    """When Kubernetes evicted a monitor of it."""
    unled: Sequence[tuple[float, float]] = ()
    """From when to when no operator led."""
    servers: Sequence[tuple[float, str]] = ()
    """When a discovery server's pod became ready, and on which node, in order."""
    astray: Sequence[tuple[float, float]] = ()
    """From when to when the Service led to no discovery server although one was ready, so that nobody discovered a new process."""
    unstarted: Sequence[tuple[float, float]] = ()
    """From when to when a pod of it existed that no kubelet had begun to start."""
    unmuxed: Sequence[tuple[float, float]] = ()
    """From when to when the container of its mux had ended, and a kubelet had not started it again."""
    deleted: Mapping[str, float] = field(default_factory=dict)
    """When each pod that is or was being deleted was first seen to be."""
    created: Mapping[str, float] = field(default_factory=dict)
    """When each pod was created, in whole Unix seconds."""


@dataclass(frozen=True)
class Violation:
    """Something that must not happen."""

    what: str
    robot: str
    at: float
    text: str
    faults: tuple[int, ...] = ()
    """The numbers of the faults whose effects may have been felt then."""


@dataclass
class Judgement:
    """All that was found of one robot."""

    name: str
    violations: list[Violation] = field(default_factory=list)
    double_drives: list[float] = field(default_factory=list)
    """Lengths in seconds."""
    fenced: list[float] = field(default_factory=list)
    """Seconds after the switch at which each command of a fenced instance arrived, beyond the enforcement."""
    strangers: int = 0
    """Commands of instances that had never been in control."""
    stale: list[float] = field(default_factory=list)
    """Seconds before the switch at which commands were sent that arrived after it, beyond a period."""
    stalled: list[float] = field(default_factory=list)
    """The same for the last command of a process that stalled then, so that it could not expire the command."""
    held: list[float] = field(default_factory=list)
    """The same for a command that tampering let through before: the robot's reader holds a reliable sample until it knows of those before
    it, and these were dropped."""
    gaps: dict[str, list[float]] = field(default_factory=dict)
    """Seconds without commands by strategy, without what faults explain."""
    lost_steps: list[int] = field(default_factory=list)
    recoveries: Counter[str] = field(default_factory=Counter)
    caught_up: list[float] = field(default_factory=list)
    """Seconds from the return of a node that was cut off to the last command of a fenced instance on it, if that was soon enough."""
    unordered: list[float] = field(default_factory=list)
    """Seconds for which a fenced instance went on alone, because no monitor passed the order on to the mux, or the mux stood still."""
    unlearned: list[float] = field(default_factory=list)
    """Seconds for which a fenced instance went on alone while the API server failed, so that no node learned of the fence."""
    repaired: list[float] = field(default_factory=list)
    """Seconds from tampering to the last command that it let through, if that was soon enough."""
    unstarted: list[float] = field(default_factory=list)
    """Seconds that Kubernetes took until a kubelet began to start a pod, if that was long."""
    unmuxed: list[float] = field(default_factory=list)
    """Seconds until a kubelet started the container of a mux again that had ended."""
    astray: list[float] = field(default_factory=list)
    """Seconds for which Kubernetes led nobody to a discovery server that was ready."""
    unled: list[float] = field(default_factory=list)
    """Seconds without an operator that led, which restores what somebody deletes."""
    restarted_unwatched: list[int] = field(default_factory=list)
    """Steps that an instance lost that restarted in place while no monitor watched it, or the API server was away so that nobody could
    fence it."""
    unkept: list[int] = field(default_factory=list)
    """Steps that were lost because they were made while no monitor ran, or before a new one had received the instance."""
    unwatched: list[float] = field(default_factory=list)
    """Seconds without a monitor after the loss of its node."""
    one_sided: list[float] = field(default_factory=list)
    """Seconds without commands at the robot while a link lost packets, if no recovery began: the monitor may have received enough."""
    unexplained: int = 0
    """Failovers after a silence for which there was no fault: the machine was too busy."""


def judge(seen: Seen, injected: Sequence[Injected], period: float = 0.05) -> Judgement:
    """Judge one robot."""
    found = Judgement(seen.name)
    seen = replace(seen, commits=_dated(seen.commits, seen.recoveries))
    theirs = [one for one in injected if (not one.refused or one.is_unsure) and affects(one, seen)]

    def violation(what: str, at: float, text: str, since: float | None = None) -> None:
        begin = at - BEFORE if since is None else since - 2.0
        near = tuple(one.fault.number for one in theirs if one.overlaps(begin, at))
        found.violations.append(Violation(what, seen.name, at, text, near))

    def repairable(one: Injected) -> float:
        """Return when somebody can undo it: only an operator that leads restores what was deleted."""
        unled = [b for a, b in seen.unled if a <= one.ended <= b and one.fault.kind == "gate-delete"]
        return max([one.ended, *unled])

    tampered = [(one.begun, repairable(one)) for one in theirs if one.fault.kind in TAMPERED]

    def undone(begin: float, end: float) -> bool:
        done = [last for first, last in tampered if first <= begin + LAG and end <= last + REPAIR]
        found.repaired += [max(0.0, end - max(done))] if done else []
        return bool(done)

    leaked = list(closed_for_leaks(seen, injected))

    def is_late_network(begin: float, end: float, *pods: str) -> bool:
        behind = [moment for pod in pods if (moment := returned(seen.nodes.get(pod, ""), end, injected)) is not None]
        if behind:
            found.caught_up.append(max(0.0, end - max(behind)))
            leaked.append((begin, end + LEAK_ENDS))
        return bool(behind)

    together = seen.commits if seen.reflex and not seen.muxed else ()
    for begin, back, end, pods in double_drives(seen.commands, together):
        if not seen.muxed and (undone(back, end) or is_late_network(begin, end, *pods)):
            continue
        found.double_drives.append(end - begin)
        violation("double drive", end, f"{' and '.join(pods)} drove together for {end - begin:.3f} s", begin)
    for group in _runs(uncontrolled(seen.commands, seen.commits, period)):
        first, after = group[0]
        last_of_group = group[-1][0].received
        if seen.muxed and (late_order := ordered_late(seen, theirs, group)) is not None:
            found.unordered.append(late_order)
            continue
        if undone(first.received, last_of_group) or is_late_network(first.received, last_of_group, first.source):
            continue
        outages = [one.waiting for one in injected if one.fault.kind in API]
        late = group[-1][1]
        if late <= covered(outages, last_of_group - late, last_of_group) + ENFORCEMENT:
            found.unlearned.append(late)
            continue
        if math.isinf(after):
            found.strangers += len(group)
            violation(
                "not in control", first.received, f"{len(group)} commands of {first.source}, never in control yet"
            )
        else:
            found.fenced += [late for _, late in group]
            last = max(late for _, late in group)
            text = f"{len(group)} commands of {first.source}, up to {last:.3f} s after it was fenced"
            violation("fenced instance", first.received, text)
    routed = {recovery.epoch: recovery.moments.get("routed", math.inf) for recovery in seen.recoveries}
    for pod, switch, late_ones, stalled in stale(seen.commands, seen.commits, routed, period):
        found.stalled += stalled
        ages = [age for age in late_ones if not any(first <= switch - age <= last + REPAIR for first, last in tampered)]
        found.held += [age for age in late_ones if age not in ages]
        if not ages:
            continue
        found.stale += ages
        text = f"{len(ages)} commands of {pod}, up to {max(ages):.3f} s older than its switch, arrived after it"
        violation("stale command", switch, text)
    found.unled = [end - begin for begin, end in seen.unled]
    found.unstarted = [end - begin for begin, end in seen.unstarted]
    found.unmuxed = [end - begin for begin, end in seen.unmuxed]
    found.astray = [end - begin for begin, end in seen.astray]
    found.unwatched = [end - LISTENS - begin for begin, end in unwatched(seen, theirs) if not math.isinf(end)]
    lossy = [
        (one.begun, one.ended + BY_NAME[one.fault.kind].after)
        for one in theirs
        if BY_NAME[one.fault.kind].loses_packets and one.fault.victim != STANDBY
    ]
    for begin, end, length, strategy, allowed in gaps(seen, theirs, leaked):
        heard = min(end, _heard_until(seen, begin, end)) if strategy else end
        lost = covered(lossy, begin, heard)
        if lost and length - lost <= allowed:
            found.one_sided.append(lost if strategy else length)
            if not strategy:
                continue
            length -= lost
        found.gaps.setdefault(strategy or "no recovery", []).append(length)
        if length > allowed:
            text = f"{length:.2f} s without a command ({strategy or 'no recovery'}; {allowed:.2f} s are allowed)"
            violation("gap", end, text, begin)
    for last, first, steps in lost_steps(seen):
        at, pods = first.received, (last.source, first.source)
        alone = covered(unwatched(seen, theirs), at - 1.0, at) or is_unfenceable(seen, injected, first.source, at)
        if pods[0] == pods[1] and alone:
            found.restarted_unwatched.append(steps)
            continue
        if any(returned(seen.nodes.get(pod, ""), at, injected) is not None for pod in pods):
            continue  # the commands of two instances alternate
        if nobodys := min(steps, unkept(seen, theirs, last)):
            found.unkept.append(nobodys)
            steps -= nobodys
        found.lost_steps.append(steps)
        if steps > STATE_AGE / period:
            violation("state lost", at, f"{steps} steps, from {pods[0]} to {pods[1]}")
    for recovery in seen.recoveries:
        found.recoveries[recovery.strategy or recovery.result] += 1
        match rightness(recovery, seen, theirs):
            case "false":
                at = recovery.moments.get("detected", 0.0)
                violation("false failover", at, f"{recovery.old} -> {recovery.new}: {recovery.reason}")
            case "busy":
                found.unexplained += 1
    for goal, end in seen.goals.items():
        if end != "succeeded":
            violation("goal lost", 0.0, f"goal {goal[:8]}: {end or 'no result'}")
    for (goal, pod), count in Counter(seen.finished).items():
        if count > 1:
            violation("goal doubled", 0.0, f"goal {goal[:8]} was finished {count} times by {pod}")
    for goal, count in Counter(goal for goal, _ in set(seen.finished)).items():
        if count > 1:
            violation("goal doubled", 0.0, f"goal {goal[:8]} was finished by {count} instances")
    return found


def is_unfenceable(seen: Seen, injected: Sequence[Injected], pod: str, at: float) -> bool:
    """Return whether a failure of a pod was known, and the API server was away until its processes sent again at a time."""
    outages = [one.waiting for one in injected if one.fault.kind in API]
    known = (one.moments.get("detected", math.inf) for one in seen.recoveries if one.old == pod)
    return any(since <= at <= since + covered(outages, since, at) + ENFORCEMENT for since in known)


def ordered_late(seen: Seen, injected: Sequence[Injected], group: Sequence[tuple[Command, float]]) -> float | None:
    """Return for how long the commands of an instance that no commit lets through arrived at a robot with a mux, if that is explained.

    Either nobody passed the order on, because the monitor, what connects it with the mux, or the mux itself stood still. Or the mux
    switched by itself, and a later commit names it.
    """
    first, last = group[0][0], group[-1][0]
    length = last.received - first.received
    if any(commit.seen >= first.received and first.source in commit.let_through for commit in seen.commits):
        return length
    hindered = [
        one for one in injected if one.fault.kind in UNORDERED and one.overlaps(first.received - BEFORE, last.received)
    ]
    return length if hindered else None


def _dated(commits: Sequence[Commit], recoveries: Sequence[Recovered]) -> list[Commit]:
    """Return the commits as early as their recoveries say that they may have been made: on a busy machine the watch is late by more
    than ``LAG``."""
    switches = {recovery.epoch: recovery.earliest_switch for recovery in recoveries}
    return [
        commit
        if (switch := switches.get(commit.epoch)) is None
        else replace(commit, since=min(switch, commit.earliest))
        for commit in commits
    ]


def affects(injected: Injected, seen: Seen) -> bool:
    """Return whether a fault may have affected a robot.

    A pod that gets the label of another robot's workload is adopted by its ReplicaSet, which then deletes one of its two pods.
    """
    label, _, _ = injected.told.partition(" of ")
    is_named = injected.fault.kind == "label-exchange" and label.partition("=")[2].startswith(f"{seen.name}-")
    return bool(BY_NAME[injected.fault.kind].shared) or injected.fault.robot == seen.index or is_named


def returned(node: str, at: float, injected: Sequence[Injected]) -> float | None:
    """Return when a node came back that had been cut off, if it may not have caught up at a time; None if it had."""
    for cut in injected:
        if cut.fault.kind == "node-cut" and cut.told == node and not cut.refused and cut.begun <= at:
            away = covered([one.waiting for one in injected if one.fault.kind in API], cut.ended, at)
            if at - cut.ended - away <= CATCHES_UP:
                return cut.ended
    return None


def double_drives(
    commands: Sequence[Command], together: Sequence[Commit] = ()
) -> Iterator[tuple[float, float, float, tuple[str, str]]]:
    """Yield from when to when commands of two instances took turns at the robot, when the first one was back, and which two: up to the last
    change of the sender.

    One change of the sender is a handover. ``together`` are the commits of a robot with a reflex: its reader itself may go back to the
    instance before while both are let through.
    """
    changes = [
        (a.received, b.received, (a.source, b.source))
        for a, b in pairwise(commands)
        if a.source != b.source and not _may_both_drive({a.source, b.source}, together, b.received)
    ]
    run: list[tuple[float, float, tuple[str, str]]] = []
    for change in [*changes, (math.inf, math.inf, ("", ""))]:
        if run and (change[0] - run[-1][1] > TOGETHER or set(change[2]) != set(run[-1][2])):
            if len(run) > 1:
                yield run[0][0], run[1][1], run[-1][0], run[0][2]
            run = []
        run.append(change)


def _may_both_drive(pods: set[str], commits: Sequence[Commit], at: float) -> bool:
    """Whether a commit that may have been in force at a moment lets both of two pods through."""
    ends = [*(commit.seen for commit in commits[1:]), math.inf]
    return any(
        commit.earliest <= at <= end and pods <= set(commit.let_through)
        for commit, end in zip(commits, ends, strict=False)
    )


def uncontrolled(
    commands: Sequence[Command], commits: Sequence[Commit], period: float = 0.05
) -> Iterator[tuple[Command, float]]:
    """Yield commands of instances that no commit let through at that time, with the seconds since they were fenced; infinity if they
    were not in control before. A command from before the fence may be under way for a period."""
    for command in commands:
        known = [commit for commit in commits if commit.earliest <= command.received]
        ends = [*(later.seen + ENFORCEMENT for later in known[1:]), math.inf]
        in_force = [commit for commit, end in zip(known, ends, strict=False) if command.received <= end]
        if not known or any(command.source in commit.let_through for commit in in_force):
            continue
        fenced = [
            later.seen
            for commit, later in pairwise(known)
            if command.source in commit.let_through and command.source not in later.let_through
        ]
        late = command.received - fenced[-1] if fenced else math.inf
        if fenced and command.sent < fenced[-1] and late <= period + DELIVERY:
            continue
        yield command, late


def _runs(found: Iterable[tuple[Command, float]]) -> Iterator[list[tuple[Command, float]]]:
    """Yield what belongs together: of one instance, with pauses of less than two seconds."""
    run: list[tuple[Command, float]] = []
    for command, after in found:
        if run and (command.source != run[-1][0].source or command.received - run[-1][0].received > 2.0):
            yield run
            run = []
        run.append((command, after))
    if run:
        yield run


def stale(
    commands: Sequence[Command], commits: Sequence[Commit], routed: Mapping[int, float], period: float
) -> Iterator[tuple[str, float, list[float], list[float]]]:
    """Yield for each switch the instance, the moment, and how much older than the switch its commands were that arrived after it; those
    of a process that stalled in between apart.

    The switch is when the commit was seen, when its recovery (by the epoch) saw the gate open, or when the robot received the new
    instance's first command, whichever was first. A process that sent nothing between a command and its arrival stalled.
    """
    for before, after in pairwise(commits):
        for pod in set(after.let_through) - set(before.let_through):
            arrived = [c for c in commands if c.source == pod and c.received >= after.earliest]
            if not arrived:
                continue
            switch = min(after.seen, arrived[0].received, routed.get(after.epoch, math.inf))
            old = [c for c in arrived if switch - c.sent > period + DELIVERY]
            sent = [c.sent for c in commands if c.source == pod]
            ages: list[float] = []
            stalled: list[float] = []
            for c in old:
                has_stalled = c.received - c.sent < STALL and not any(c.sent < at <= c.received for at in sent)
                (stalled if has_stalled else ages).append(switch - c.sent)
            if old:
                yield pod, switch, ages, stalled


def closed_for_leaks(seen: Seen, injected: Sequence[Injected]) -> Iterator[tuple[float, float]]:
    """Yield the times in which the gate was closed because the network of a node that returned let a fenced instance through.

    The monitor may hear that instance by test packets alone, before the robot hears it.
    """
    nodes = set(seen.nodes.values())
    for before, closed, after in zip(seen.commits, seen.commits[1:], [*seen.commits[2:], None], strict=False):
        is_recovery = any(
            recovery.moments.get("detected", math.inf) - LAG <= closed.seen <= recovery.moments.get("routed", 0.0)
            for recovery in seen.recoveries
        )
        if closed.let_through or not before.let_through or is_recovery:
            continue
        if any(returned(node, closed.seen, injected) is not None for node in nodes):
            yield closed.earliest, (after.seen if after is not None else math.inf) + LAG


def gaps(
    seen: Seen, injected: Sequence[Injected], leaked: Sequence[tuple[float, float]] = ()
) -> Iterator[tuple[float, float, float, str, float]]:
    """Yield each silence that is longer than the timeout: its begin, its end, its length without the time that faults explain, the strategy
    that ended it (empty for none), and the length that this strategy may take.

    ``leaked`` are the times in which the gate may have been closed because the network let a fenced instance through.
    """
    for a, b in pairwise(seen.commands):
        if b.received - a.received <= seen.timeout:
            continue
        found = _recoveries(seen, a.received, b.received)
        waits = [one.waiting for one in injected if BY_NAME[one.fault.kind].delays]
        waits += unrepaired(seen, injected, a.received, b.received)
        nobodys = [*unwatched(seen, injected), *evicted(seen, injected)]
        nobodys += [(ended, begun + MUX_STARTS) for ended, begun in seen.unmuxed]
        tried = [one["strategy"] for recovery in found for one in recovery.attempts if one["result"] != "NotAvailable"]
        if not found or {"Restart", "Fallback/Uninitialized"} & set(tried):
            nobodys += [*seen.unstarted, *((first, last + LISTENS) for first, last in seen.astray)]
        given_up = not found and any(not c.let_through and a.received <= c.seen <= b.received for c in seen.commits)
        if given_up or {"Restart", "Fallback/Uninitialized"} & set(tried):
            nobodys += seen.unled  # new pods of pools come from the operator
        if given_up or "Restart" in tried:
            nobodys += unreplaced(seen, injected, a, b)
        explained = covered([*waits, *leaked, *nobodys], a.received, b.received)
        allowed = seen.timeout + SWITCH + sum(_allowed(recovery) for recovery in found)
        if given_up and _was_last(seen, injected, a, b):
            allowed += VERIFY_WITHIN["Restart"]
        if cut_short(seen, injected, a) or cut_short(seen, injected, b):
            allowed += ACTIVATED
        if not found and _has_just_recovered(seen, a):
            allowed += backoff.FIRST
        strategy = max(found, key=_allowed).strategy if found else ""
        yield a.received, b.received, b.received - a.received - explained, strategy, allowed


def cut_short(seen: Seen, injected: Sequence[Injected], command: Command) -> bool:
    """Return whether a command is of an instance for which the gate had just been opened when somebody deleted it."""
    at = command.received
    return any(one.fault.kind == "gate-delete" and one.overlaps(at, at) for one in injected) and any(
        abs(opened.seen - at) <= LAG
        and command.source in opened.let_through
        and not closed.let_through
        and closed.seen - opened.seen <= REPAIR
        for opened, closed in pairwise(seen.commits)
    )


def unreplaced(
    seen: Seen, injected: Sequence[Injected], last: Command, first: Command
) -> Iterator[tuple[float, float]]:
    """Yield from when to when a ReplicaSet had not replaced a deleted pod, soon after the API server was away.

    Kubernetes' controllers notice a connection that is half open after up to 45 s, and see no change until then.
    """
    deleted, created = seen.deleted.get(last.source, math.inf), seen.created.get(first.source, 0.0)
    after_outage = any(one.fault.kind in API and one.ended <= deleted <= one.ended + BLIND for one in injected)
    if after_outage and created - deleted > REPLACES:
        yield deleted, created


def _has_just_recovered(seen: Seen, last: Command) -> bool:
    """Return whether the last strategy of a policy activated an instance so soon before a silence that the monitor waits before it tries
    the first one again."""
    return any(
        one.strategy == "Restart"
        and one.new == last.source
        and 0.0 <= last.received - one.moments.get("routed", math.inf) <= HEALTHY_DELAY
        for one in seen.recoveries
        if one.result == "Recovered"
    )


def _was_last(seen: Seen, injected: Sequence[Injected], last: Command, first: Command) -> bool:
    """Return whether somebody deleted the last instance in a silence, so that the next one had to be started."""
    until = seen.created.get(first.source, 0.0) + 1.0
    return any(
        one.fault.kind == "delete" and one.told.split()[:1] == [last.source] and last.received <= one.begun <= until
        for one in injected
    )


def unrepaired(seen: Seen, injected: Sequence[Injected], begin: float, end: float) -> list[tuple[float, float]]:
    """Return the times without an operator in a silence if somebody tampered with the gate then, and the time to restore it."""
    tampered = [one.begun for one in injected if one.fault.kind in TAMPERED and begin - REPAIR <= one.begun <= end]
    return [(first, last + REPAIR) for first, last in seen.unled] if tampered else []


def unwatched(seen: Seen, injected: Sequence[Injected]) -> Iterator[tuple[float, float]]:
    """Yield the times in which a robot had no monitor, because that was on a node that was lost, or had one that could discover nobody,
    because the discovery server was there too."""
    for lost in injected:
        before = [node for ready, node in seen.monitors if ready <= lost.begun]
        if lost.fault.kind in NODE_LOST and before and before[-1] == lost.told:
            back = next((ready for ready, _ in seen.monitors if ready > lost.begun), math.inf)
            servers = [node for ready, node in seen.servers if ready <= lost.begun]
            if servers and servers[-1] == lost.told:
                # After a short cut, Kubernetes may not have taken it for unready.
                server = next((ready for ready, _ in seen.servers if ready > lost.begun), lost.ended)
                back = max(back, server + SERVER_STARTS)
            yield lost.begun, back + LISTENS


def evicted(seen: Seen, injected: Sequence[Injected]) -> Iterator[tuple[float, float]]:
    """Yield the times in which a robot had no monitor, because Kubernetes evicted it, or started its container again only after a while
    because it had been killed before.

    Kubernetes takes nodes for lost when the API server fails, and up to a minute later, because its controllers connect again late. How
    long the next pod or container takes to start is a matter of Kubernetes and of the machine, too.
    """
    for begin, end in seen.unmonitored:
        if any(abs(begin - at) <= EVICTED_AT for at in seen.evictions):
            yield begin, end + LISTENS
        elif any(one.fault.kind == "monitor-kill" and abs(begin - one.begun) <= TOGETHER for one in injected):
            yield begin, min(end, begin + STARTED_AGAIN) + LISTENS


def _recoveries(seen: Seen, begin: float, end: float) -> list[Recovered]:
    """Return the recoveries that took place in a silence."""
    return [
        recovery
        for recovery in seen.recoveries
        if recovery.moments.get("detected", math.inf) <= end
        and recovery.moments.get("routed", recovery.moments.get("verified", end)) >= begin
    ]


def _heard_until(seen: Seen, begin: float, end: float) -> float:
    """Return until when the monitor received the instance whose failure it noticed in a silence of the robot."""
    return min((one.moments.get("lastHealthy", begin) for one in _recoveries(seen, begin, end)), default=begin)


def _allowed(recovery: Recovered) -> float:
    """Return how many seconds the strategies that were tried may take together. A standby that drives already takes over at once."""
    tried = [attempt for attempt in recovery.attempts if attempt["result"] != "NotAvailable"]
    at_once = recovery.result == "Recovered" and "Executing" in recovery.strategy
    names = [attempt["strategy"] for attempt in (tried[:-1] if at_once else tried)]
    return sum(seconds for name in names for strategy, seconds in VERIFY_WITHIN.items() if strategy in name)


def covered(windows: Iterable[tuple[float, float]], begin: float, end: float) -> float:
    """Return how much of the time between two moments the windows cover."""
    total, reached = 0.0, begin
    for first, last in sorted(windows):
        first, last = max(first, reached), min(last, end)
        if last > first:
            total, reached = total + last - first, last
    return total


def lost_steps(seen: Seen) -> Iterator[tuple[Command, Command, int]]:
    """Yield between which two commands the application's steps went back, and by how many.

    Commands count in the order in which they were sent: one that arrives late is stale, and no state is lost by it. Those of a fenced
    instance do not count: what it did since nobody could keep, as on a node that was cut off. A new instance may
    take a moment, ``TAKES_STATE``, to act on its state.
    """
    fenced = {command.sequence for command, _ in uncontrolled(seen.commands, seen.commits)}
    counted = sorted((c for c in seen.commands if c.sequence in seen.steps.keys() - fenced), key=lambda c: c.sent)
    for index, (a, b) in enumerate(pairwise(counted), 1):
        before, reached = seen.steps[a.sequence], seen.steps[b.sequence]
        if reached < before and a.source != b.source:
            soon = takewhile(lambda c, first=b: c.sent - first.sent <= TAKES_STATE, counted[index:])
            its_own = [c for c in soon if c.source == b.source]
            reached = max(seen.steps[c.sequence] - count for count, c in enumerate(its_own))
        if reached < before:
            yield a, b, before - reached


def unkept(seen: Seen, injected: Sequence[Injected], last: Command) -> int:
    """Return how many steps an instance had made up to its last command since its monitor had ended, was frozen or cut off; 0 if one had
    received it since. All of them, if a node was lost with both: the state is kept on the monitor's node by default (docs/state.md).

    Nobody keeps these steps, which are lost if the instance fails then.
    """
    for lost in injected:
        monitors = [node for ready, node in seen.monitors if ready <= lost.begun]
        is_both = monitors[-1:] == [lost.told] and seen.nodes.get(last.source) == lost.told
        if lost.fault.kind in NODE_LOST and is_both and abs(last.received - lost.begun) <= TOGETHER:
            return seen.steps[last.sequence]
    frozen = [(one.begun, one.ended) for one in injected if one.fault.kind == "monitor-freeze"]
    away = [*seen.unmonitored, *frozen, *unwatched(seen, injected)]
    since = min((begin for begin, end in away if begin < last.received <= end + LISTENS), default=last.received)
    own = [c for c in seen.commands if c.source == last.source and c.received <= since]
    reached = max((seen.steps[c.sequence] for c in own if c.sequence in seen.steps), default=None)
    return seen.steps[last.sequence] - reached if reached is not None else 0


def rightness(recovery: Recovered, seen: Seen, injected: Sequence[Injected]) -> str:
    """Return whether a failover was ``right``, ``false``, or, after a silence for which there was no fault, ``busy``."""
    detected = recovery.moments.get("detected")
    if detected is None:
        return "right"
    # Nobody can keep a pod that is being deleted. The witness may notice the deletion after the monitor, which deletes failed pods itself.
    if seen.deleted.get(recovery.old, math.inf) <= detected + (NOTICED if recovery.reason.endswith(DELETED) else 0.0):
        return "right"
    before_it = RESTART_KNOWN if UNSEEN in recovery.reason else 2 * seen.timeout
    if (first := re.search(FIRST_SECONDS, recovery.reason)) is not None:
        before_it += float(first[1])
    if any(BY_NAME[i.fault.kind].disturbs and i.overlaps(detected - before_it, detected) for i in injected):
        return "right"
    end, limit = detected, seen.timeout
    if (
        "reflex" in recovery.strategy
    ):  # the robot's reader switches by itself, and the monitor notices that before or after it
        limit = seen.reflex
        end = next((c.received for c in seen.commands if c.received > detected), detected)
    before = [c.received for c in seen.commands if detected - 3 * seen.timeout <= c.received <= detected] + [end]
    silent = max((b - a for a, b in pairwise(before)), default=math.inf)
    return "busy" if silent >= SHARE * limit else "false"

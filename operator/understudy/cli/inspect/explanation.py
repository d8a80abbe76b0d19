"""Explains in words why a workload is in its state, what a failure now would lead to, and what is missing. Pure.

The operator's own functions decide which strategies could run, and why the others cannot.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic.alias_generators import to_camel

from understudy.api import names
from understudy.api.conditions import Condition
from understudy.api.health_reasons import decisive, why
from understudy.api.kinds.failure_policy import FailurePolicySpec, Strategy, in_force
from understudy.api.kinds.robot_workload import Recovery, RobotWorkloadSpec, RobotWorkloadStatus
from understudy.api.plain_text import plain
from understudy.cli.common.recovery_under_way import under_way
from understudy.cli.common.robots import DRIVEN, UNWATCHED, Problem, Robot, is_reported, pool, robot, status_of
from understudy.cli.common.text.time_bars import length
from understudy.cli.common.text.tree_text import coloured
from understudy.cli.common.text.wording import age, listed, wrapped
from understudy.cli.inspect import limit_text
from understudy.cli.inspect.cluster_observation import WorkloadObjects
from understudy.controller.desired import effective_policy, standby_pods
from understudy.controller.desired.workload_plan import WorkloadPlan, evaluate
from understudy.controller.observed import (
    dependency_graph,
    kube_objects,
    policy_reader,
    pool_reader,
    situation_strategies,
)
from understudy.controller.observed.observation import Observed
from understudy.controller.observed.pod_diagnosis import trouble
from understudy.controller.plan import Images
from understudy.controller.pods import pool_pods as pools
from understudy.controller.pods import pool_size
from understudy.controller.status import protection
from understudy.controller.status.protection import StrategyAvailability
from understudy.kube.client import Object
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateKind
from understudy.trees.languages.notations import load_monitoring
from understudy.trees.source.problems import TreeError

_TOLD = (pool_size.CONDITION, pools.MOVING)
"""Conditions of a shared pool that are shown with it."""

LATELY = 5
"""Number of Events that are shown."""


@dataclass(frozen=True)
class Facts:
    """All input of the explanation: the status, and the present objects of the cluster."""

    observed: Observed
    workload_plan: WorkloadPlan
    status: RobotWorkloadStatus
    robot: Robot
    """The summary of the status and the gate."""
    protected: Condition
    """The condition as it is now by the operator's rules. The status may be older, or the operator may not be
    running."""
    events: Sequence[Object]
    workloads: Mapping[str, Object] = field(default_factory=dict)
    """The workloads of the namespace, by name."""
    gates: Mapping[str, Object] = field(default_factory=dict)
    """The gates of these workloads, by the gates' names."""

    @classmethod
    def of(cls, around: WorkloadObjects) -> Facts:
        """Build it from the objects around a workload. Raises CommandError if its status cannot be parsed."""
        observed = around.observed
        workload_plan = evaluate(observed, Images(monitor=""))
        protected = protection.protected(observed, workload_plan)
        item = observed.workload
        others = {kube_objects.name(one): one for one in around.workloads}
        summary = robot(item, observed.gate, observed.now)
        return cls(observed, workload_plan, status_of(item), summary, protected, around.events, others, around.gates)

    @property
    def considered(self) -> Sequence[StrategyAvailability]:
        """The strategies that count now, in order, each with whether it could run."""
        return protection.considered(self.observed, self.workload_plan)

    @property
    def standby_ready(self) -> bool:
        """Whether a standby of this robot could take over, which takes no pod from other robots."""
        return any(
            one.availability.available
            and one.strategy.pool_ref is not None
            and pool_reader.has_standbys(self.observed.pools[one.strategy.pool_ref.name])
            for one in self.considered
        )

    @property
    def left_out(self) -> list[str]:
        """The pools of the policy that do not count while the robot is healthy: they have standbys only while it is
        degraded."""
        counted = {c.strategy.pool_ref.name for c in self.considered if c.strategy.pool_ref is not None}
        strategies = effective_policy.strategies(self.observed) if self.policy else []
        named = [s.pool_ref.name for s in strategies if s.pool_ref is not None]
        return [name for name in named if name not in counted]

    @property
    def pools(self) -> list[str]:
        """The pools from which its strategies take an instance, in order."""
        counted = [c.strategy.pool_ref.name for c in self.considered if c.strategy.pool_ref is not None]
        return list(dict.fromkeys([*counted, *self.left_out]))

    @property
    def is_watched(self) -> bool:
        """Whether its monitor is ready."""
        return any(kube_objects.ready(pod) for pod in self.observed.monitors)

    @property
    def health(self) -> str:
        """The health that its monitor reports, or UNWATCHED."""
        if not self.is_watched:
            return UNWATCHED
        return "Recovering" if self.robot.recovering is not None else self.status.health or "Unknown"

    @property
    def is_well(self) -> bool:
        """Whether it is protected and its active instance works."""
        return self.protected.status == "True" and self.health in DRIVEN

    @property
    def gate_kind(self) -> GateKind:
        """The kind of its gate."""
        return registry.of(self.observed.workload)

    @property
    def spec(self) -> RobotWorkloadSpec | None:
        """Its spec; None if it cannot be parsed."""
        return self.workload_plan.spec

    @property
    def policy(self) -> FailurePolicySpec | None:
        """Its policy with the health tree in force; None if the policy cannot be followed."""
        if self.spec is None or self.workload_plan.policy_problem is not None:
            return None
        item = self.observed.policies[self.spec.failure_policy_ref.name]
        return in_force(policy_reader.spec(item), item.get("status"))


@dataclass(frozen=True)
class _Entry:
    """One entry below a heading."""

    text: str
    state: str = ""
    """The state that colours its mark; empty for no mark."""
    depth: int = 0

    def to_wire(self) -> dict[str, str]:
        """Return the entry for scripts: ``state`` is Healthy for a tick, Failed for a cross, Degraded for a warning, or
        empty."""
        return {"text": self.text, "state": self.state}


_MARKS = {"Healthy": "✓ ", "Failed": "✗ ", "Degraded": "! ", "": ""}


def lines(known: Facts, *, columns: int | None, colours: bool) -> Iterator[str]:
    """Format the whole explanation."""
    colour = "Failed" if known.health == UNWATCHED else known.health
    health = coloured(plain(known.health), colour, colours=colours)
    yield f"{known.robot.namespace}/{known.robot.name}  {health}{_for(known)}"
    for entry in _state(known):
        yield from _drawn(entry, columns, colours)
    for heading, entries in _sections(known).items():
        if entries:
            yield ""
            yield heading
        for entry in entries:
            yield from _drawn(entry, columns, colours)


def for_scripts(known: Facts) -> dict[str, Any]:
    """Return the explanation as plain values: fields as far as possible, and sentences for the rest."""
    name, _ = kube_objects.active(known.observed.gate)
    strategies = [
        {
            "name": one.name,
            "available": one.availability.available,
            "reason": one.availability.reason,
            "message": one.availability.message,
            "verifyWithin": one.strategy.verify_within,
        }
        for one in known.considered
    ]
    sections = {"State": list(_state(known)), **_sections(known)}
    return {
        "namespace": known.robot.namespace,
        "name": known.robot.name,
        "health": known.health,
        "protected": known.protected.status == "True",
        "reason": known.protected.reason,
        "message": known.protected.message,
        "active": name,
        "strategies": strategies,
        **{
            to_camel(heading.lower().replace(" ", "_")): [entry.to_wire() for entry in entries]
            for heading, entries in sections.items()
        },
    }


def _sections(known: Facts) -> dict[str, list[_Entry]]:
    """Return the entries by heading, in order."""
    return {
        "If it failed now": list(_failing(known)),
        "Dependencies": list(_dependencies(known)),
        "Pools": list(_pools(known)),
        "Missing": list(_missing(known)),
        "Not covered": list(_not_covered(known)),
        "Lately": list(_lately(known.events, known.observed.now)),
    }


def _drawn(entry: _Entry, columns: int | None, colours: bool) -> Iterator[str]:
    mark, indent = _MARKS[entry.state], 2 + 2 * entry.depth
    first, *others = wrapped(entry.text, columns, indent=indent + len(mark))
    yield f"{' ' * indent}{coloured(mark, entry.state, colours=colours) if mark else ''}{first.lstrip()}"
    yield from others


# -- how it is --------------------------------------------------------------------------------------------------------


def _for(known: Facts) -> str:
    if known.is_watched and known.robot.recovering is not None:
        return f" for {age(known.robot.recovering.since, known.observed.now)}"
    found = decisive(known.health, known.robot.active, known.status.conditions or [])
    return f" for {age(found.last_transition_time, known.observed.now)}" if found is not None else ""


def _state(known: Facts) -> Iterator[_Entry]:
    """Explain the present state, and name the active instance."""
    status, observed = known.status, known.observed
    if not known.is_watched:
        last = f"; the last reported health is {status.health}" if status.health else ""
        yield _Entry(f"No monitor watches the workload, so its health is unknown{last}.")
    elif known.health != "Healthy":
        recovering = known.robot.recovering
        reason = recovering.message if recovering else why(known.health, known.robot.active, status.conditions or [])
        yield _Entry(f"{reason.rstrip('.')}.")
        yield _Entry(f"Its health tree leaf by leaf: understudy tree -n {known.robot.namespace} {known.robot.name}")
    name, uid = kube_objects.active(observed.gate)
    epoch = kube_objects.notes(observed.gate).get(names.EPOCH, "0") if observed.gate is not None else "0"
    if not name:
        yield _Entry(f"In control: nobody (gate epoch {epoch}).")
        return
    referred = observed.reference.pods if observed.reference is not None else ()
    pod = next((p for p in (*observed.pods, *referred) if kube_objects.uid(p) == uid), None)
    since = next((r for r in status.recoveries or [] if r.to_pod == name and r.result == "Recovered"), None)
    lines = [
        f"In control: {name} {_where(pod)}" if pod is not None else f"In control: {name}, which is gone",
        f"gate epoch {epoch}",
        f"since recovery #{since.number}" if since is not None else "",
    ]
    yield _Entry(f"{listed(lines)}.")
    if pod is not None and (found := trouble(pod)) is not None:
        yield _Entry(found.message, "Failed")
    yield from _situation(known)
    if admitted := kube_objects.notes(observed.gate).get(names.ADMITTED, "") if observed.gate is not None else "":
        yield _Entry(known.gate_kind.words_for_admitted(admitted))


def _situation(known: Facts) -> Iterator[_Entry]:
    """Name the situation of its policy that applies, and what is in force because of it."""
    conditions = known.status.conditions or []
    covered = next((one for one in conditions if one.type == situation_strategies.CONDITION), None)
    if known.policy is None or not known.policy.situations or covered is None:
        return
    present = known.status.situation
    line = f"Situation: {present.name} for {age(present.since, known.observed.now)}" if present else "Situation: none"
    why_ = f" ({present.reason})" if present is not None and present.reason else ""
    yield _Entry(f"{line}{why_}. {covered.message}")


def _where(pod: Object) -> str:
    node = (pod.get("spec") or {}).get("nodeName")
    return f"on {node}" if node else "on no node"


# -- if it failed now -------------------------------------------------------------------------------------------------


def _failing(known: Facts) -> Iterator[_Entry]:
    considered = known.considered
    if not known.is_watched:
        yield _Entry(
            "Until the monitor runs (see Missing), a failure is neither detected nor recovered. Then it would do this:",
            "Failed",
        )
    elif not considered:
        yield _Entry(known.protected.message, "Failed")
        if known.status.strategy:
            yield _Entry(
                f"Its monitor still uses the last accepted policy, and its next strategy is {known.status.strategy}."
            )
    yield from _limits(known)
    before: Strategy | None = None
    for number, one in enumerate(considered, 1):
        strategy, found = one.strategy, one.availability
        head = f"{number}. {one.name}"
        if not found.available:
            waits = f" It would wait for a pod for up to {strategy.wait_for}." if strategy.wait_for else ""
            yield _Entry(f"{head} cannot run ({found.reason}): {found.message.rstrip('.')}.{waits}", "Failed")
            continue
        ready = f": {found.message}" if found.message else ""
        if before is None:
            line = f"{head} would run{ready}"
        else:
            line = f"{head} is next, if that is not verified within {before.verify_within}{ready}"
        yield _Entry(f"{line}. {_experience(strategy, known)}", "Healthy")
        before = strategy
    if considered and before is None:
        yield _Entry("No strategy of its policy could run: the robot would be left without commands.", "Failed")
    elif before is not None:
        yield _Entry(
            f"If the last one is not verified within {before.verify_within} either, the monitor waits and then tries all of them again. "
            "It skips a strategy that is not available."
        )
    if before is not None:
        yield _Entry(known.gate_kind.how_it_switches(known.robot.name))
    if before is not None and known.left_out:
        yield _Entry(f"Left out: {listed(known.left_out)}, which has standbys only while the robot is degraded.")
    yield from _otherwise(known, considered)


def _limits(known: Facts) -> Iterator[_Entry]:
    """List the limits that would prevent or delay a recovery now."""
    item, now, policy = known.observed.workload, known.observed.now, known.policy
    policy_item = known.observed.policies.get(known.spec.failure_policy_ref.name) if known.spec is not None else None
    limits = limit_text.limits_in_force(known.spec, policy, policy_item, known.status, item, known.robot, now)
    for text, prevents in limit_text.sentences(limits, known.robot.name, now, standby_ready=known.standby_ready):
        yield _Entry(text, "Degraded" if prevents else "")
    yield from map(_Entry, limit_text.budget_left(policy, known.status, item, now))


def _experience(strategy: Strategy, known: Facts) -> str:
    """Describe how long the strategy took in earlier recoveries."""
    name = _recorded(strategy, known.observed)
    took = [
        r.recovery_seconds
        for r in known.status.recoveries or []
        if _is_by(r, name) and r.recovery_seconds is not None and r.result == "Recovered"
    ]
    if not took:
        return "It has not recovered this robot yet."
    which = "the last time" if len(took) == 1 else f"the median of the last {len(took)} times"
    return f"It took {length(statistics.median(took))}, {which}."


def _is_by(recovery: Recovery, name: str) -> bool:
    """Return whether a strategy made a recovery, also if the robot's reader had switched before (reflex)."""
    return not recovery.planned and not recovery.follows and recovery.strategy.removesuffix(" (reflex)") == name


def _recorded(strategy: Strategy, observed: Observed) -> str:
    """Return the name of a strategy in the record of a recovery."""
    if strategy.pool_ref is None:
        return strategy.type
    item = observed.pools.get(strategy.pool_ref.name)
    return f"{strategy.type}/{pool_reader.readiness(item) if item is not None else ''}"


def _otherwise(known: Facts, considered: Sequence[StrategyAvailability]) -> Iterator[_Entry]:
    """Report a different choice of the monitor, which knows the standbys' agents; this command does not."""
    reported = known.status.strategy
    if not reported or not considered or known.health in (UNWATCHED, "Recovering"):
        return
    first = next((one.strategy for one in considered if one.availability.available), None)
    found = _recorded(first, known.observed).rpartition("/")[2] if first is not None else "None"
    if reported != found:
        yield _Entry(
            f"The monitor reports a different next strategy: {reported}. The monitor also knows which agents are connected; this command "
            "knows only the readiness of the pods. If the two still differ after a few seconds, look at the log of the monitor.",
            "Degraded",
        )


# -- dependencies -----------------------------------------------------------------------------------------------------

_AFTERWARDS = {
    "Nothing": "the monitor leaves this workload as it is",
    "Reinitialize": "the monitor runs bringUp again",
    "Restart": "the monitor replaces the active pod",
    "Procedure": "the monitor runs a procedure",
}


def _dependencies(known: Facts) -> Iterator[_Entry]:
    """List its dependencies with their health, and the workloads that depend on it."""
    for one in known.spec.depends_on if known.spec is not None else ():
        after = f"After {one.name} recovers, {_AFTERWARDS[one.on_recovery]} (onRecovery: {one.on_recovery})."
        if one.name not in known.workloads:
            yield _Entry(f"depends on {one.name}, which does not exist. {after}", "Failed")
            continue
        status, gate = status_of(known.workloads[one.name]), known.gates.get(names.gate(one.name))
        recovering = under_way(status, gate, known.observed.now) is not None
        health = "Recovering" if recovering else status.health or "Unknown"
        state = "Healthy" if health in DRIVEN else "Failed"
        yield _Entry(f"depends on {one.name} ({health}). {after}", state)
    found = [name for name, one in known.workloads.items() if known.robot.name in dependency_graph.named(one)]
    if found:
        line = (
            f"Workloads that depend on this one: {listed(sorted(found))}. While this workload is not healthy, their monitors "
            "delay recoveries of failures that it may have caused."
        )
        yield _Entry(line)


# -- pools --------------------------------------------------------------------------------------------------------------


def _pools(known: Facts) -> Iterator[_Entry]:
    """Describe the pools that its policy names."""
    observed = known.observed
    for name in known.pools:
        item = observed.pools.get(name)
        if item is None or not pool_reader.serves(item, observed.workload):
            continue  # it is reported above
        if pool_reader.is_shared(item):
            yield from _shared(name, item, observed)
        else:
            yield from _own(name, item, observed)


def _shared(name: str, item: Object, observed: Observed) -> Iterator[_Entry]:
    held = observed.unclaimed.get(name, ())
    ready = pools.claimable_now(held, observed.held_policies.get(name))
    want, claimed = pool_size.size(item), pool(item).claimed
    taken = f"; {claimed} of its pods {'controls a robot' if claimed == 1 else 'control robots'}" if claimed else ""
    yield _Entry(f"{name} ({pool_reader.readiness(item)}, shared): {len(ready)} of {want} ready{taken}")
    conditions = (item.get("status") or {}).get("conditions") or []
    yield from (_Entry(one["message"], depth=1) for one in conditions if one["type"] in _TOLD)
    taking = {kube_objects.uid(pod) for pod in ready}
    yield from (_pod(pod) for pod in sorted(held, key=kube_objects.sort_key) if kube_objects.uid(pod) not in taking)


def _own(name: str, item: Object, observed: Observed) -> Iterator[_Entry]:
    found = protection.waiting(observed, item)
    ready = sum(kube_objects.ready(pod) for pod in found)
    yield _Entry(f"{name} ({pool_reader.readiness(item)}): {ready} ready, {standby_pods.wanted(observed, name)} wanted")
    yield from map(_pod, found)


def _pod(pod: Object) -> _Entry:
    found = trouble(pod)
    why_not = f" ({found.reason})" if found is not None else ""
    how = (
        "being deleted" if kube_objects.deleted(pod) else "ready" if kube_objects.ready(pod) else f"not ready{why_not}"
    )
    return _Entry(f"{kube_objects.name(pod)} {_where(pod)}: {how}", depth=1)


# -- what is missing ----------------------------------------------------------------------------------------------------


def _missing(known: Facts) -> Iterator[_Entry]:
    """List what is not as it should be, with the remedy that the reporting component wrote."""
    observed = known.observed
    found = [problem for problem in known.robot.problems if problem.type != "Protected"]
    if known.protected.status != "True":
        yield _Entry(_unprotected(known), "Failed")
    refused = known.workload_plan.problem
    if refused is not None and not any(problem.type == "Accepted" for problem in found):
        found.append(Problem(type="Accepted", reason=refused.reason, message=refused.message))
    for problem in found:
        state = (
            "Degraded" if problem.type in ("Degraded", "StateRestored", situation_strategies.CONDITION) else "Failed"
        )
        since = f", {age(problem.since, observed.now)}" if problem.since else ""
        yield _Entry(f"{problem.about} ({problem.reason}{since}): {problem.message}", state)
    messages = [problem.message for problem in found]
    messages += [one.availability.message for one in known.considered]
    for name in known.pools:
        if name not in observed.pools:
            continue
        for problem in pool(observed.pools[name]).problems:
            if not is_reported(problem, messages):
                yield _Entry(f"pool {name} {problem.about} ({problem.reason}): {problem.message}", "Failed")
                found.append(problem)
    if known.protected.status == "True" and all(problem.type == "Degraded" for problem in found):
        nothing = "Nothing else" if found else "Nothing"
        yield _Entry(f"{nothing}: everything that the first strategy needs is available.", "Healthy")


def _unprotected(known: Facts) -> str:
    """Explain why the robot is not protected, in short if an unavailable strategy above explains it already."""
    found = known.protected
    problem = next((problem for problem in known.robot.problems if problem.type == "Protected"), None)
    since = f", {age(problem.since, known.observed.now)}" if problem is not None and problem.since else ""
    first = next((one.availability for one in known.considered), None)
    is_reported = first is not None and not first.available and found.reason == first.reason
    words = "the first strategy of its policy cannot run, see above." if is_reported else found.message
    stale = (
        " The status does not report this: it is a few seconds old, or the operator is not running."
        if problem is None
        else ""
    )
    return f"not protected ({found.reason}{since}): {words}{stale}"


def _not_covered(known: Facts) -> Iterator[_Entry]:
    """List what the robot's protection does not cover as configured, and what the monitor reports about the readers of
    the outputs."""
    read = next((one for one in known.status.conditions or [] if one.type == "OutputsRead"), None)
    if known.is_watched and read is not None and read.status != "False" and read.reason != "AtGatedPorts":
        yield _Entry(read.message)
    policy, spec = known.policy, known.spec
    if spec is not None:
        yield from map(_Entry, known.gate_kind.not_covered(spec.outputs))
    if policy is None or spec is None:
        return
    try:
        watched = {topic.name for topic in load_monitoring(policy.monitoring).topics}
    except TreeError:
        return  # it is reported above
    unwatched = [output.topic for output in spec.outputs if output.topic and output.topic not in watched]
    if unwatched:
        yield _Entry(
            f"The health tree does not watch {listed(unwatched)}: if nothing arrives there, no failure is detected."
        )
    if not (policy.state.keep or policy.state.parameters or policy.state.lifecycle):
        yield _Entry(
            "The policy keeps no state: an instance that takes over starts without the state of the failed one."
        )
    if len(known.considered) + len(known.left_out) == 1:
        yield _Entry("The policy has one strategy: if it is not verified, there is no other one to try.")
    if policy.safety is None:
        yield _Entry(
            "The policy has no safe commands (spec.safety): until an instance is active again, the robot receives no commands."
        )


def _lately(events: Sequence[Object], now: float) -> Iterator[_Entry]:
    """List the newest warnings."""
    warnings = [event for event in events if event.get("type") == "Warning"]
    for event in sorted(warnings, key=_when, reverse=True)[:LATELY]:
        count = event.get("count") or 1
        times = f", {count} times" if count > 1 else ""
        when = f"{age(_when(event), now)} ago" if _when(event) else "at some time"
        yield _Entry(f"{when}  {event.get('reason', '')}{times}: {event.get('message', '')}")


def _when(event: Object) -> str:
    found: str = event.get("lastTimestamp") or event.get("eventTime") or event["metadata"].get("creationTimestamp", "")
    return found

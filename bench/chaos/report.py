"""The figures of a campaign, its table per kind of fault, and what was wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from bench.chaos.judge import Injected, Judgement, Violation
from bench.chaos.plan import BY_NAME
from bench.results import Report, columns

SHOWN = 60
"""Violations that the file of results has in words."""

GROWTH = 25.0
"""Largest growth of a process in a campaign, in MB."""


@dataclass(frozen=True)
class Aftermath:
    """What was found when the last fault had ended."""

    whole_after: float
    """Seconds until all robots were healthy and protected."""
    unwell: Sequence[str]
    leaked: Sequence[str]
    """Pods that nobody needs any more."""
    growth: Mapping[str, float]
    """By process, MB."""
    tracebacks: Mapping[str, int]
    """How often each was logged, by what it says."""


def summarize(
    seed: int,
    injected: Sequence[Injected],
    judgements: Sequence[Judgement],
    aftermath: Aftermath,
    *,
    settled_within: float,
) -> Report:
    """Return the report of a campaign. Each seed has a file of results."""
    report = Report(f"chaos-{seed}")
    violations = [violation for judgement in judgements for violation in judgement.violations]
    made = [one for one in injected if not one.refused]
    report.figure("faults that were made", [len(made)], unit="faults")
    if refused := len(injected) - len(made):
        report.figure("faults that could not be made", [refused], unit="faults")

    def counted(name: str, what: str) -> None:
        report.figure(name, [sum(v.what == what for v in violations)], unit="", must={"max": 0})

    drives = [length for judgement in judgements for length in judgement.double_drives]
    report.figure("longest double drive", [1000 * max(drives, default=0.0)], unit="ms", must={"max": 0})
    fenced = [late for judgement in judgements for late in judgement.fenced]
    report.figure("commands of fenced instances", [len(fenced)], unit="commands", must={"max": 0})
    if fenced:
        report.figure("their time after the switch", [1000 * late for late in fenced], unit="ms")
    strangers = [judgement.strangers for judgement in judgements]
    report.figure("commands of instances never in control", strangers, unit="commands", must={"max": 0})
    stale = [age for judgement in judgements for age in judgement.stale]
    report.figure("commands from before the switch", [len(stale)], unit="commands", must={"max": 0})
    if stale:
        report.figure("their age at the switch", [1000 * age for age in stale], unit="ms")
    if held := [age for judgement in judgements for age in judgement.held]:
        report.figure("age of commands that tampering had let through and the robot's reader had held", held, unit="s")
    if stalled := [age for judgement in judgements for age in judgement.stalled]:
        report.figure(
            "age at the switch of commands of processes that stalled then", [1000 * a for a in stalled], unit="ms"
        )
    if repaired := [seconds for judgement in judgements for seconds in judgement.repaired]:
        report.figure("time from tampering to the last command that it let through", repaired, unit="s")
    if caught_up := [seconds for judgement in judgements for seconds in judgement.caught_up]:
        report.figure("time from a node's return to the last command of a fenced instance on it", caught_up, unit="s")
    if unordered := [seconds for judgement in judgements for seconds in judgement.unordered]:
        report.figure("time of a fenced instance alone before the order reached the mux", unordered, unit="s")
    if unlearned := [seconds for judgement in judgements for seconds in judgement.unlearned]:
        report.figure("time of a fenced instance alone while the API server failed", unlearned, unit="s")
    if one_sided := [seconds for judgement in judgements for seconds in judgement.one_sided]:
        report.figure("time without commands on a link that loses packets, without a recovery", one_sided, unit="s")
    if judgements and (unled := judgements[0].unled):
        report.figure("time without an operator that leads", unled, unit="s")
    if restarted := [steps for judgement in judgements for steps in judgement.restarted_unwatched]:
        report.figure(
            "steps lost by an instance that restarted in place without a monitor or an API server",
            restarted,
            unit="steps",
        )
    if unkept := [steps for judgement in judgements for steps in judgement.unkept]:
        report.figure("steps lost that were made without a monitor", unkept, unit="steps")
    if astray := [seconds for judgement in judgements for seconds in judgement.astray]:
        report.figure("time in which a Service led to no discovery server", astray, unit="s")
    if unstarted := [seconds for judgement in judgements for seconds in judgement.unstarted]:
        report.figure("time until a kubelet began to start a pod", unstarted, unit="s")
    if unmuxed := [seconds for judgement in judgements for seconds in judgement.unmuxed]:
        report.figure("time until a kubelet started a killed mux again", unmuxed, unit="s")
    if unwatched := [seconds for judgement in judgements for seconds in judgement.unwatched]:
        report.figure("time without a monitor after the loss of its node", unwatched, unit="s")
    counted("gaps beyond the bound of the strategy", "gap")
    for strategy in sorted({name for judgement in judgements for name in judgement.gaps}):
        values = [gap for judgement in judgements for gap in judgement.gaps.get(strategy, ())]
        report.figure(f"gap, {strategy}", values, unit="s")
    counted("false failovers", "false failover")
    report.figure("failovers of late instances without a fault", [sum(j.unexplained for j in judgements)], unit="")
    counted("goals lost", "goal lost")
    counted("goals doubled", "goal doubled")
    counted("state lost", "state lost")
    if lost := [steps for judgement in judgements for steps in judgement.lost_steps]:
        report.figure("steps between kept and lost state", lost, unit="steps")
    report.figure("recoveries", [sum(judgement.recoveries.values()) for judgement in judgements], unit="per robot")
    report.figure("all healthy and protected after the last fault", [aftermath.whole_after], unit="s",
                  must={"max": settled_within})  # fmt: skip
    report.figure("leaked pods", [len(aftermath.leaked)], unit="pods", must={"max": 0})
    if aftermath.growth:
        report.figure("growth of a process", list(aftermath.growth.values()), unit="MB", must={"max": GROWTH})
    report.figure("tracebacks", [sum(aftermath.tracebacks.values())], unit="", must={"max": 0})
    for name, row in by_kind(injected, judgements).items():
        report.figure(f"{name}: faults made", [row.made], unit="faults")
        report.figure(f"{name}: violations near them", [sum(row.near.values())], unit="")
    total: Counter[str] = sum((judgement.recoveries for judgement in judgements), Counter())
    report.note("recoveries", ", ".join(f"{count} {name}" for name, count in total.most_common()) or "none")
    for number, violation in enumerate(violations[:SHOWN], 1):
        report.note(f"violation {number}", described(violation, injected))
    for number, (text, count) in enumerate(aftermath.tracebacks.items(), 1):
        report.note(f"traceback {number}", f"{count} times: {text}")
    if aftermath.leaked:
        report.note("leaked", ", ".join(aftermath.leaked))
    if aftermath.unwell:
        report.note("not well in the end", "; ".join(aftermath.unwell))
    return report


@dataclass(frozen=True)
class Row:
    """What one kind of fault came to."""

    made: int
    refused: int
    near: Counter[str]
    """Violations near a fault of this kind, by what they are. Several faults may be near one violation."""
    alone: int
    """Violations near which there was no other fault."""


def by_kind(injected: Sequence[Injected], judgements: Sequence[Judgement]) -> dict[str, Row]:
    """Return a row for each kind of fault of the campaign."""
    violations = [violation for judgement in judgements for violation in judgement.violations]
    found = {}
    for name in BY_NAME:
        mine = [one for one in injected if one.fault.kind == name]
        numbers = {one.fault.number for one in mine}
        near = [violation for violation in violations if numbers & set(violation.faults)]
        if mine:
            refused = sum(bool(one.refused) for one in mine)
            alone = sum(set(violation.faults) <= numbers for violation in near)
            found[name] = Row(len(mine) - refused, refused, Counter(v.what for v in near), alone)
    return found


def kinds_table(injected: Sequence[Injected], judgements: Sequence[Judgement]) -> str:
    """Return the table per kind of fault."""
    rows = [["fault", "made", "refused", "violations", "alone", "what"]]
    for name, row in by_kind(injected, judgements).items():
        what = ", ".join(f"{count} {text}" for text, count in row.near.most_common())
        rows.append([name, str(row.made), str(row.refused), str(sum(row.near.values())), str(row.alone), what])
    return columns(rows)


def described(violation: Violation, injected: Sequence[Injected]) -> str:
    """Return what happened, and which faults were near."""
    near = [f"{one.fault} ({one.told}) at {one.begun:.2f}" for one in injected if one.fault.number in violation.faults]
    moment = f" at {violation.at:.2f}" if violation.at else ""
    return f"{violation.robot}{moment}: {violation.what}: {violation.text}; near: {'; '.join(near) or 'no fault'}"

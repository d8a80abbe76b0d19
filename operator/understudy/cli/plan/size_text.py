"""Tells a pool's size in words and a table."""

from __future__ import annotations

import math

from understudy.advice.monte_carlo import Estimate
from understudy.advice.paper_model import INTERVAL
from understudy.cli.plan.pool_sizes import Size
from understudy.trees.core.leaf import duration

_LARGEST = 1000
"""Pods that a FallbackPool may have."""

_SMALLEST = 1e-6
"""Below it a risk isn't told as a figure."""

_HEAD = ("", "BY THE MODEL", "BY TRIAL")


def told(size: Size) -> str:
    """All of it, for a terminal. Lines of text may be of any length; the table, which nobody breaks, fits 80 columns."""
    question, outcome, trial = size.question, size.outcome, size.trial
    demand, count = question.demand, outcome.fallbacks
    between = duration(float(f"{1 / demand.rate:.3g}"))
    lines = [
        f"failures   {_count(question.robots, 'robot')}, {question.failures_per_robot_hour:g} per robot and hour: "
        f"one every {between}",
        f"fallbacks  {_needed(size)}; {demand.offered:.3g} of them are away on average, each for {question.refill:g} s",
        "",
        *_table(
            [
                _HEAD,
                (
                    f"window: more than {count} fail within {question.refill:g} s",
                    percent(outcome.window),
                    _estimated(trial.window),
                ),
                ("loss: a failure goes without a fallback", percent(outcome.loss), _estimated(trial.loss)),
                ("waiting: a failure has to wait for one", percent(outcome.waiting), _estimated(trial.waiting)),
                (
                    "mean wait of all failures",
                    _seconds(outcome.wait),
                    _waited(trial.wait) if math.isfinite(outcome.wait) else "without end",
                ),
            ]
        ),
        "",
        f"cost       {outcome.cpu:+.2%} CPU ({count} x {question.cpu:g} of an instance, for {_count(question.robots, 'robot')})",
        f"down-time  {outcome.down:.3g} s per failure, {question.restart:g} s by restarts alone: "
        f"{size.gained:.3g} s less per robot and hour",
        *_papers(size),
        *_pool(size),
        "",
        "The model: independent failures (Poisson); loss by Erlang's B, waiting by his C.",
        f"The trial: {trial.failures} failures, with refills that always take the same time. The C formula takes them to vary "
        "exponentially, which makes for more waiting.",
    ]
    return "\n".join(lines)


def percent(value: float) -> str:
    """With as many digits as tell something."""
    if 0 < value < _SMALLEST:
        return "< 0.0001 %"
    return f"{float(f'{value * 100:.3g}'):g} %"


def _needed(size: Size) -> str:
    count = size.outcome.fallbacks
    if size.risk is None:
        return str(count)
    others = ", ".join(f"{number} for {measure}" for measure, number in size.needed.items() if measure != size.risk_of)
    return f"{count} for a risk of {percent(size.risk)} ({size.risk_of}; {others})"


def _pool(size: Size) -> list[str]:
    """How a pool is told to keep the risk by itself."""
    if (
        size.risk is None
        or size.risk < _SMALLEST
        or size.risk_of == "window"
        or not 0 < size.outcome.fallbacks <= _LARGEST
    ):
        return []
    question, most = size.question, min(_LARGEST, 2 * size.outcome.fallbacks)
    asked = f"risk: {percent(size.risk).replace(' ', '')}, riskOf: {size.risk_of.capitalize()}"
    known = f"failuresPerRobotHour: {question.failures_per_robot_hour:g}, refill: {question.refill:g}s"
    return [f"pool       to have the size follow the failures, spec.sizing: {{{asked}, {known}, max: {most}}}"]


def _papers(size: Size) -> list[str]:
    """Its argument beside what the same failures come to when they are drawn."""
    paper, count = size.paper, size.outcome.fallbacks
    if not paper.remaining:
        why = f"{paper.expected:.2g} failures in {INTERVAL} s are covered by {count}"
        return [f"paper      its argument says nothing here: {why}"]
    return [
        f"paper      {paper.expected:.2g} failures in {INTERVAL} s, {_count(paper.remaining, 'of them', 'of them')} not covered, all in "
        f"one window in {paper.together} of {paper.ways} ways: {percent(paper.chance)}",
        f"           by trial an interval of {INTERVAL} s has a window with more than {count} in {_estimated(size.trial.interval)} of all "
        "cases (why: docs/sizing.md)",
    ]


def _estimated(value: Estimate) -> str:
    return f"{value.mean * 100:.2f} ± {value.within * 100:.2f} %"


def _seconds(value: float) -> str:
    return f"{value:.3g} s" if math.isfinite(value) else "without end"


def _waited(value: Estimate) -> str:
    return f"{value.mean:.3g} ± {value.within:.2g} s"


def _count(number: int, one: str, more: str | None = None) -> str:
    return f"{number} {one if number == 1 else more or f'{one}s'}"


def _table(rows: list[tuple[str, str, str]]) -> list[str]:
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    return [f"{row[0]:<{widths[0]}}  {row[1]:>{widths[1]}}  {row[2]:>{widths[2]}}".rstrip() for row in rows]

"""Formats the result of ``understudy size`` as text."""

from __future__ import annotations

import math

from understudy.advice.monte_carlo import Estimate
from understudy.advice.paper_model import INTERVAL
from understudy.cli.common.text.text_tables import format_texts
from understudy.cli.common.text.wording import counted
from understudy.cli.plan.pool_sizes import Size
from understudy.trees.core.leaf import duration

_LARGEST = 1000
"""Most pods of a FallbackPool."""

_SMALLEST = 1e-6
"""Risks below this value are not shown as a figure."""

_HEAD = ("", "MODEL", "SIMULATION")


def size_text(size: Size) -> str:
    """Format the result. Lines of text may have any length; the table fits 80 columns."""
    question, outcome, trial = size.question, size.outcome, size.trial
    demand, count = question.demand, outcome.fallbacks
    between = duration(float(f"{1 / demand.rate:.3g}"))
    lines = [
        f"failures   {counted(question.robots, 'robot')}, {question.failures_per_robot_hour:g} per robot and hour: "
        f"one every {between}",
        f"fallbacks  {_needed(size)}; {demand.offered:.3g} of them in use on average, each for {question.refill:g} s",
        "",
        *format_texts(
            [
                _HEAD,
                (
                    f"window: more than {count} fail within {question.refill:g} s",
                    percent(outcome.window),
                    _estimated(trial.window),
                ),
                ("loss: a failure finds no fallback", percent(outcome.loss), _estimated(trial.loss)),
                ("waiting: a failure waits for a fallback", percent(outcome.waiting), _estimated(trial.waiting)),
                (
                    "mean wait of all failures",
                    _seconds(outcome.wait),
                    _waited(trial.wait) if math.isfinite(outcome.wait) else "unbounded",
                ),
            ],
            right=(1, 2),
        ),
        "",
        f"cost       {outcome.cpu:+.2%} CPU (each of {count} fallbacks uses {question.cpu:g} of the CPU of an instance; "
        f"{counted(question.robots, 'robot')})",
        f"downtime   {outcome.down:.3g} s per failure, {question.restart:g} s with restarts only: "
        f"{size.gained:.3g} s less per robot and hour",
        *_papers(size),
        *_pool(size),
        "",
        "Model: independent failures (Poisson); loss by Erlang B, waiting by Erlang C.",
        f"Simulation: {trial.failures} failures, with a constant refill time. Erlang C assumes an exponentially distributed "
        "refill time, which leads to more waiting.",
    ]
    return "\n".join(lines)


def percent(value: float) -> str:
    """Format a probability in percent with its significant digits."""
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
    """Suggest spec.sizing, with which a pool keeps the risk automatically."""
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
    return [f"pool       to adapt the size to the failures, set spec.sizing: {{{asked}, {known}, max: {most}}}"]


def _papers(size: Size) -> list[str]:
    """Format the paper's estimate next to the simulated one."""
    paper, count = size.paper, size.outcome.fallbacks
    if not paper.remaining:
        why = f"{paper.expected:.2g} failures in {INTERVAL} s are covered by {count}"
        return [f"paper      the estimate does not apply here: {why}"]
    return [
        f"paper      {paper.expected:.2g} failures in {INTERVAL} s, of which the fallbacks do not cover {paper.remaining}; these fall into "
        f"one window in {paper.together} of {paper.ways} arrangements: {percent(paper.chance)}",
        f"           simulated: an interval of {INTERVAL} s has a window with more than {count} in {_estimated(size.trial.interval)} of "
        "all cases (why: docs/sizing.md)",
    ]


def _estimated(value: Estimate) -> str:
    return f"{value.mean * 100:.2f} ± {value.within * 100:.2f} %"


def _seconds(value: float) -> str:
    return f"{value:.3g} s" if math.isfinite(value) else "unbounded"


def _waited(value: Estimate) -> str:
    return f"{value.mean:.3g} ± {value.within:.2g} s"

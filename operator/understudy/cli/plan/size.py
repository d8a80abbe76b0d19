"""``understudy size``: how many fallbacks robots that share a pool need, what that risks and what it costs."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable

from understudy.advice.shortage_risk import MEASURES, MOST
from understudy.api.output_formats import structured
from understudy.cli.common import option_rules, plot_files, terminal
from understudy.cli.common.errors import CommandError
from understudy.cli.plan.pool_sizes import Question, sized
from understudy.cli.plan.size_text import told
from understudy.cli.plan.text_wrap import fitted

DONE, CANT = 0, 2
"""Exit statuses."""

_SUREST = 0.999999
"""The greatest risk that a size is found for."""

_LEAST, _GREATEST = 1e-9, 1e9
"""Between which rates and times lie that mean anything; beyond, numbers end."""

RISK_OF = "loss"
"""What a risk is of where --risk-of isn't given."""


def main(arguments: list[str]) -> int:
    """Run the command; what came of it goes to standard output."""
    parser = _parser()
    given = parser.parse_args(arguments)
    option_rules.only(parser, given, given.risk is not None, "--risk-of", "says what --risk is of, which isn't given")
    question = Question(
        robots=given.robots,
        failures_per_robot_hour=given.failures_per_robot_hour,
        recovery=given.recovery,
        refill=given.refill or given.recovery,
        restart=given.restart or 2 * given.recovery,
        cpu=given.fallback_cpu,
    )
    try:
        if given.plot is not None:
            plot_files.usable(given.plot)
        size = sized(question, given.fallbacks, given.risk, given.risk_of or RISK_OF)
        if given.output == "text":
            print(fitted(told(size), terminal.columns(sys.stdout)))
        else:
            print(structured(size.data(), given.output))
        if given.plot is not None:
            from understudy.cli.plan import size_plot

            size_plot.draw(given.plot, size)
    except CommandError as error:
        print(f"understudy size: {error}", file=sys.stderr)
        return CANT
    return DONE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy size",
        description="Says how likely it is that robots which share a FallbackPool find too few fallbacks, how long they then wait, what "
        "the pool costs and what down-time it saves; with --risk how many fallbacks are needed. Failures are taken to come independently "
        "of each other; each takes a fallback, and another waits in its place after the refill's time.",
        epilog="Exit status: 0, or 2 where it can't be done as asked for. The models are described in docs/sizing.md.",
    )
    parser.add_argument("--robots", type=_count(1, 10_000_000), required=True, help="how many share the pool")
    parser.add_argument(
        "--failures-per-robot-hour",
        type=_rate,
        required=True,
        metavar="RATE",
        help="as observed",
    )
    parser.add_argument(
        "--recovery-seconds",
        "--recovery",
        dest="recovery",
        type=_duration,
        required=True,
        metavar="DURATION",
        help="down-time of a robot that finds a fallback, such as 6s",
    )
    parser.add_argument(
        "--refill-seconds",
        "--refill",
        dest="refill",
        type=_duration,
        metavar="DURATION",
        help="from a failure until another fallback is ready (default: as long as the recovery, as in the paper)",
    )
    parser.add_argument(
        "--restart-seconds",
        "--restart",
        dest="restart",
        type=_duration,
        metavar="DURATION",
        help="down-time of a robot that is restarted instead (default: twice the recovery, as in the paper)",
    )
    parser.add_argument(
        "--fallback-cpu",
        type=_cpu,
        default=1.0,
        metavar="SHARE",
        help="CPU of a waiting fallback as a share of a working one's (default: 1, as the paper counts; it measured 0.6 for one that "
        "waits uninitialized)",
    )
    asked = parser.add_mutually_exclusive_group(required=True)
    asked.add_argument("--fallbacks", type=_count(0, MOST), metavar="N", help="the pool's size")
    asked.add_argument(
        "--risk",
        type=_risk,
        metavar="P",
        help="the size for this risk instead, such as 0.01 or 1%%",
    )
    parser.add_argument(
        "--risk-of",
        choices=tuple(MEASURES),
        help="what the risk is of: loss: a failure finds no fallback and goes without; waiting: it has to wait for one; window: more "
        f"failures than fallbacks fall into the time of a refill, as the paper asks (default: {RISK_OF})",
    )
    parser.add_argument("--plot", metavar="FILE.png", help="draw risk against cost (needs the extra understudy[plots])")
    parser.add_argument("-o", "--output", choices=("text", "json", "yaml"), default="text", help="how it is printed")
    return parser


def _count(least: int, most: int) -> Callable[[str], int]:
    def count(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"found {text!r:.50}; give a whole number from {least} to {most}")
        return value

    return count


def _rate(text: str) -> float:
    return _bounded(text, _number(text), "failures per hour, above 0, such as 0.2")


def _duration(text: str) -> float:
    return _bounded(text, option_rules.duration(text), "a duration, such as 500ms or 6s")


def _risk(text: str) -> float:
    return _figure(text, share(text), f"a probability, above 0 and up to {_SUREST:g}, such as 0.01 or 1%", most=_SUREST)


def _cpu(text: str) -> float:
    return _figure(text, share(text), "a share, from 0 on, such as 0.4 or 40%", zero=True)


def share(text: str) -> float:
    """A share such as ``0.4`` or ``40%``; not a number where it is none."""
    return _number(text.removesuffix("%")) / 100 if text.endswith("%") else _number(text)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _bounded(text: str, value: float, right: str) -> float:
    right += f", from {_LEAST:g} to {_GREATEST:g}" if value > 0 else ""
    return _figure(text, value if value >= _LEAST else math.nan, right, most=_GREATEST)


def _figure(text: str, value: float, right: str, *, most: float = math.inf, zero: bool = False) -> float:
    if not (math.isfinite(value) and value <= most and (value > 0 or (zero and value == 0))):
        raise argparse.ArgumentTypeError(f"found {text!r:.50}; give {right}")
    return value

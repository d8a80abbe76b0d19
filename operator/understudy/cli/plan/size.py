"""``understudy size``: calculates how many fallbacks the robots of a pool need, with the risks and the cost."""

from __future__ import annotations

import argparse
import math
import sys

from understudy.advice.shortage_risk import MEASURES, MOST
from understudy.api.output_formats import structured
from understudy.cli.common import option_rules, plot_files
from understudy.cli.common.errors import reports_errors
from understudy.cli.common.text import terminal
from understudy.cli.common.text.wording import wrap_labelled
from understudy.cli.plan.pool_sizes import Question, calculate
from understudy.cli.plan.size_text import size_text

_SUREST = 0.999999
"""The highest risk for which a size is calculated."""

_LEAST, _GREATEST = 1e-9, 1e9
"""Bounds of rates and times; beyond them, floating-point numbers fail."""

RISK_OF = "loss"
"""Default of --risk-of."""


@reports_errors("size")
def main(arguments: list[str]) -> int:
    """Run the command. The result goes to standard output."""
    parser = _parser()
    options = parser.parse_args(arguments)
    option_rules.reject_unless(
        parser, options, options.risk is not None, "--risk-of", "applies to --risk, which is not given"
    )
    question = Question(
        robots=options.robots,
        failures_per_robot_hour=options.failures_per_robot_hour,
        recovery=options.recovery,
        refill=options.refill or options.recovery,
        restart=options.restart or 2 * options.recovery,
        cpu=options.fallback_cpu,
    )
    if options.plot is not None:
        plot_files.check_plot_file(options.plot)
    size = calculate(question, options.fallbacks, options.risk, options.risk_of or RISK_OF)
    if options.output == "text":
        print(wrap_labelled(size_text(size), terminal.columns(sys.stdout)))
    else:
        print(structured(size.data(), options.output))
    if options.plot is not None:
        from understudy.cli.plan import size_plot

        size_plot.draw(options.plot, size)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy size",
        description="Calculates how likely it is that a FallbackPool has too few fallbacks (waiting pods) for its "
        "robots, how long the robots wait, what the pool costs and what downtime it saves. With --risk, it "
        "calculates how many fallbacks are needed. It assumes that failures are independent of each other, and "
        "that each uses a fallback, which is replaced after the refill time.",
        epilog="Exit status: 0, or 2 on an error. The models are described in docs/sizing.md. The defaults of --refill, "
        "--restart and --fallback-cpu follow this paper: Mirus, Pasch, Singhal, Scholl, A generic approach for "
        "reactive stateful mitigation of application failures in distributed robotics systems deployed with Kubernetes.",
    )
    option_rules.add_examples(
        parser,
        "understudy size --robots 100 --failures-per-robot-hour 0.1 --recovery 6s --fallbacks 3",
        "understudy size --robots 100 --failures-per-robot-hour 0.1 --recovery 6s --risk 1% --plot size.png",
    )
    parser.add_argument(
        "--robots", type=option_rules.whole(1, 10_000_000), required=True, help="number of robots that share the pool"
    )
    parser.add_argument(
        "--failures-per-robot-hour",
        type=_rate,
        required=True,
        metavar="RATE",
        help="observed failures per robot and hour",
    )
    parser.add_argument(
        "--recovery-seconds",
        "--recovery",
        dest="recovery",
        type=_duration,
        required=True,
        metavar="DURATION",
        help="downtime of a robot for which a fallback is ready, such as 6s",
    )
    parser.add_argument(
        "--refill-seconds",
        "--refill",
        dest="refill",
        type=_duration,
        metavar="DURATION",
        help="time from a failure until another fallback is ready (default: the recovery time)",
    )
    parser.add_argument(
        "--restart-seconds",
        "--restart",
        dest="restart",
        type=_duration,
        metavar="DURATION",
        help="downtime of a robot that is restarted instead (default: twice the recovery time)",
    )
    parser.add_argument(
        "--fallback-cpu",
        type=_cpu,
        default=1.0,
        metavar="SHARE",
        help="CPU of a waiting fallback as a share of a working instance's (default: 1; the paper measured 0.6 for an uninitialized "
        "fallback)",
    )
    asked = parser.add_mutually_exclusive_group(required=True)
    asked.add_argument("--fallbacks", type=option_rules.whole(0, MOST), metavar="N", help="size of the pool")
    asked.add_argument(
        "--risk",
        type=_risk,
        metavar="P",
        help="calculate the size for this risk, such as 0.01 or 1%%",
    )
    parser.add_argument(
        "--risk-of",
        choices=tuple(MEASURES),
        help="what the risk is. loss: no fallback is ready at a failure. waiting: the robot has to wait for one. window: within "
        f"one refill time there are more failures than fallbacks, the measure of the paper (default: {RISK_OF})",
    )
    parser.add_argument("--plot", metavar="FILE.png", help="draw risk against cost (needs the extra understudy[plots])")
    option_rules.add_output(parser, "output format (default: text)")
    return parser


def _rate(text: str) -> float:
    return _bounded(text, _number(text), "failures per hour, above 0, such as 0.2")


def _duration(text: str) -> float:
    return _bounded(text, option_rules.duration(text), "a duration, such as 500ms or 6s")


def _risk(text: str) -> float:
    return _figure(text, share(text), f"a probability, above 0 and up to {_SUREST:g}, such as 0.01 or 1%", most=_SUREST)


def _cpu(text: str) -> float:
    return _figure(text, share(text), "a share of at least 0, such as 0.4 or 40%", zero=True)


def share(text: str) -> float:
    """Parse a share such as ``0.4`` or ``40%``; NaN if it is invalid."""
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

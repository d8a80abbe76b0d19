"""``understudy learn --bag BAG [--topic NAME]``: proposes leaves for topics, with bounds from a healthy recording.

It only prints them: people must decide whether the recording was healthy and how much deviation is acceptable.
"""

from __future__ import annotations

import argparse
import sys
from array import array
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from understudy.api.plain_text import plain
from understudy.cli.common import option_rules
from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.text.wording import wall
from understudy.cli.simulate.bags import Bag
from understudy.cli.simulate.command_topics import command_topics
from understudy.cli.simulate.leaf_history import Failure
from understudy.cli.simulate.learned_bounds import FACTOR, FEWEST, MARGIN, Bounds, Measures, measured, proposed
from understudy.cli.simulate.replay import replay
from understudy.trees.core.leaf import duration
from understudy.trees.core.rate_window import hertz
from understudy.trees.languages.short.health_loader import load
from understudy.trees.source.problems import TreeError, did_you_mean

CONSISTENT, CONTRADICTED = 0, 1
"""Exit statuses besides ERROR."""


@reports_errors("learn")
def main(arguments: list[str]) -> int:
    """Run the command. The leaves go to standard output."""
    options = _parser().parse_args(arguments)
    with Bag.open(options.bag) as bag:
        topics = options.topic or _commands(bag)
        learned = [_learn(bag, name, options.factor, options.margin) for name in dict.fromkeys(topics)]
        failures = _tried([leaf for leaf, _, _ in learned], bag)
        for line in _text(bag, learned, options.factor, options.margin):
            print(plain(line))
        for failure in failures:
            print(
                f"understudy learn: these bounds would have failed in this bag, at {failure.failed - bag.start:.3f} s: "
                f"{plain(failure.reason)}; was the robot healthy then? If it was, increase --factor or --margin",
                file=sys.stderr,
            )
    return CONTRADICTED if failures else CONSISTENT


Learned = tuple[dict[str, Any], Measures, Bounds]


def _commands(bag: Bag) -> list[str]:
    """Return the topics that look like commands to a robot. Raises CommandError if there is none."""
    found = command_topics({name: topic.types[0] for name, topic in bag.topics.items() if len(topic.types) == 1})
    if not found:
        raise CommandError(
            f"{bag.path}: no topic looks like commands to a robot; name topics with --topic: {', '.join(sorted(bag.topics))}"
        )
    return found


def _learn(bag: Bag, name: str, factor: float, margin: float) -> Learned:
    """Learn the leaf of a topic. Raises CommandError."""
    topic = bag.topics.get(name)
    if topic is None:
        raise CommandError(f"{bag.path}: the bag has no topic {name!r:.80}{did_you_mean(name, bag.topics)}")
    if len(topic.types) > 1:
        raise CommandError(
            f"{bag.path}: {name} was recorded as {' and as '.join(topic.types)}; a topic must have one type"
        )
    arrivals = array("d", (taken.received for taken in bag.messages({name: topic.types[0]})))
    return learned_leaf(bag.path, name, topic.types[0], arrivals, factor, margin)


def learned_leaf(
    source: str, name: str, type_name: str, arrivals: Sequence[float], factor: float = FACTOR, margin: float = MARGIN
) -> Learned:
    """Return a leaf for a topic with these times of receipt, with what it was learned from. Raises CommandError."""
    if len(arrivals) < FEWEST or arrivals[-1] <= arrivals[0]:
        raise CommandError(
            f"{source}: there are {len(arrivals)} messages of {name}; at least {FEWEST} are required, better "
            "thousands: give a longer recording"
        )
    measures = measured(arrivals)
    bounds = proposed(arrivals, measures, factor, margin)
    leaf: dict[str, Any] = {"name": name, "type": type_name, "gap": _written(bounds.gap)}
    if bounds.band is not None:
        leaf |= {"rate": str(bounds.band), "window": _written(bounds.window)}
    return leaf, measures, bounds


def _tried(leaves: list[dict[str, Any]], bag: Bag) -> list[Failure]:
    """Return the failures of the leaves in the bag from which they were learned, after their startup."""
    try:
        tree = load({"parallel": [{"topic": leaf} for leaf in leaves]}, path="learned", grace=bag.end - bag.start)
    except TreeError as error:  # for example for an invalid ROS name
        raise CommandError(f"{bag.path}: these are not valid leaves: {error.in_short()}") from error
    return replay(tree, 0.0, bag).evaluation.failures


def _text(bag: Bag, learned: list[Learned], factor: float, margin: float) -> Iterator[str]:
    yield f"# Learned from {bag.path}: {bag.end - bag.start:.3f} s from {wall(bag.start)}. Check it before you use it."
    yield f"# gap: {factor:g} times the 99.9th percentile of the gaps, rounded up."
    yield (
        f"# rate: from the lowest to the highest rate over any window of the recording, extended by {margin * 100:g} % on both sides, "
        "rounded outwards."
    )
    yield "parallel:"
    for leaf, measures, bounds in learned:
        yield from (f"  {line}" for line in leaf_lines(leaf, measures, bounds))


def leaf_lines(leaf: Mapping[str, Any], measures: Measures, bounds: Bounds) -> Iterator[str]:
    """Yield a learned leaf as an item of a list in YAML, with comments on what it was learned from."""
    yield (
        f"# {measures.count} messages, {hertz(measures.rate)}; gaps: median {_duration_text(measures.median)}, "
        f"p99.9 {_duration_text(measures.quantile)}, longest {_duration_text(measures.longest)}"
    )
    if bounds.band is not None:
        yield f"# over {duration(bounds.window)}: {hertz(bounds.slowest)} to {hertz(bounds.fastest)}"
    else:
        yield f"# no bounds over {duration(bounds.window)}: the rate varies too much, or the recording is shorter"
    fields = ", ".join(f"{key}: {value}" for key, value in leaf.items())
    yield f"- topic: {{{fields}}}"


def _duration_text(seconds: float) -> str:
    return duration(float(f"{seconds:.3g}"))


def _written(seconds: float) -> str:
    """Format a duration for a health tree."""
    return f"{seconds * 1000:.6g}ms" if seconds < 1 else f"{seconds:.6g}s"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy learn",
        description="Proposes leaf nodes for a health tree. Their bounds (longest time between two messages, "
        "message rate) come from a recording of a healthy robot. The command prints them for review and for use in "
        "a policy; it writes no file.",
        epilog="Exit status: 0 if the proposed leaves succeed during the whole recording, 1 if they do not, 2 on "
        "an error.",
    )
    option_rules.add_examples(
        parser,
        "understudy learn --bag drive/",
        "understudy learn --bag drive/ --topic /cmd_vel --topic /scan --factor 3",
    )
    parser.add_argument("--bag", required=True, metavar="BAG", help="a rosbag2 folder, or an .mcap or .db3 file")
    parser.add_argument(
        "--topic",
        action="append",
        metavar="NAME",
        help="a topic to learn; may be given several times (default: those that look like commands to a robot)",
    )
    parser.add_argument(
        "--factor",
        type=option_rules.number(1.0, 100.0),
        default=FACTOR,
        help="longest allowed gap between two messages, as a multiple of the 99.9th percentile of the recorded "
        "gaps (default: %(default)s)",
    )
    parser.add_argument(
        "--margin",
        type=option_rules.number(0.01, 0.99),
        default=MARGIN,
        help="tolerated deviation beyond the recorded rates, as a fraction (default: %(default)s)",
    )
    return parser

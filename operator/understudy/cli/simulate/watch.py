"""``understudy watch POLICY``: evaluates a policy's health tree on a live ROS graph, read-only."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from understudy.api.base import seconds
from understudy.api.plain_text import plain
from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.option_rules import add_examples
from understudy.cli.common.text import terminal
from understudy.cli.simulate import live_graph, policy_file
from understudy.cli.simulate.leaf_history import Evaluation
from understudy.cli.simulate.live_screen import Display, Lines, Screen, describe
from understudy.cli.simulate.policy_file import Policy

if TYPE_CHECKING:
    from understudy.ros.observe.topic_watch import TopicWatch

HEALTHY, FAILED = 0, 1
"""Exit statuses besides ERROR."""

LEAST_REST = 0.001
"""Least seconds between two evaluations."""

OF_CLUSTER = "needs the cluster, which this command does not use: not evaluated"


@reports_errors("watch")
def main(arguments: list[str]) -> int:
    """Run the command. The state of the tree goes to standard output, the result to standard error."""
    options = _parser().parse_args(arguments)
    policy = policy_file.read(options.policy_file, options.policy, options.grace)
    with _joined() as watching:
        evaluation = _watch(policy, watching, options.length)
    return _end(evaluation)


def _end(evaluation: Evaluation) -> int:
    """Print the result and return the exit status."""
    for failure in evaluation.detections:
        print(f"understudy watch: failure: {describe(failure)}", file=sys.stderr)
    if evaluation.detections:
        return FAILED
    last = evaluation.spans[""][-1] if evaluation.spans else None
    if evaluation.healthy is None:
        why = f": {plain(last.reason)}" if last is not None and last.reason else ""
        print(f"understudy watch: no failure was detected, but the tree was never healthy either{why}", file=sys.stderr)
    else:
        print("understudy watch: no failure was detected", file=sys.stderr)
    return HEALTHY


@contextlib.contextmanager
def _joined() -> Iterator[TopicWatch]:
    """Join the ROS graph that the environment selects; only topics of trees are subscribed. Raises CommandError."""
    with live_graph.joined("watch") as graph:
        from understudy.ros.observe.topic_watch import TopicWatch

        watching = TopicWatch(graph)
        try:
            yield watching
        finally:
            watching.close()


def _watch(policy: Policy, watching: TopicWatch, length: float | None) -> Evaluation:
    """Evaluate the tree until the time is over or the command is interrupted. Raises CommandError."""
    from understudy.ros.runtime.interface_types import message_fields

    tree = policy.tree(message_fields)
    unseen = {leaf.name for leaf in tree.leaves if leaf.of_cluster}
    tree.leave_out(unseen)
    if tree.root is None:
        raise CommandError(
            f"no leaf of the policy's tree can be evaluated here: {', '.join(sorted(unseen))} {OF_CLUSTER}"
        )
    watching.follow(tree.topics)
    started = time.time()
    tree.begin(started)
    evaluation = Evaluation(tree, policy.debounce, started)
    end = time.monotonic() + length if length is not None else None
    display = _display(policy)
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        with contextlib.suppress(KeyboardInterrupt, BrokenPipeError):
            _evaluate(evaluation, watching, display, end, unseen)
    finally:
        signal.signal(signal.SIGTERM, before)
        with contextlib.suppress(BrokenPipeError):
            display.close()
    return evaluation


def _evaluate(
    evaluation: Evaluation, watching: TopicWatch, display: Display, end: float | None, unseen: set[str]
) -> None:
    from understudy.monitor.observe.wakeups import STALL_MOST, STALLED, TICK, WAKE_LATE

    due, trusted = time.time(), 0.0
    notes = [f"{path} {OF_CLUSTER}" for path in sorted(unseen)]
    while True:
        now = time.time()
        # As in the monitor: after a stall, messages may be missing from the queues, so silence means nothing yet.
        if (late := now - due) > STALLED:
            trusted = now + min(late, STALL_MOST)
        watching.drain()
        evaluation.tree.leave_out(watching.unwatchable | unseen)
        now = time.time()
        due = now + TICK
        if now >= trusted:
            evaluation.evaluate(watching, now)
            display.show(evaluation, watching, now, [*watching.problems, *watching.waiting, *notes])
            if (change := evaluation.next_evaluation(watching, now)) is not None:
                due = min(due, change + WAKE_LATE)
        rest = max(LEAST_REST, due - time.time())
        if end is not None:
            left = end - time.monotonic()
            if left <= 0:
                return
            rest = min(rest, left)
        time.sleep(rest)


def _display(policy: Policy) -> Display:
    if not terminal.redraws(sys.stdout):
        return Lines(sys.stdout)
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    return Screen(sys.stdout, f"{policy.name} in ROS domain {domain}")


def _interrupt(*_: Any) -> None:
    raise KeyboardInterrupt


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy watch",
        description="Evaluates a FailurePolicy's health tree live, on the ROS graph that the environment selects "
        "(ROS_DOMAIN_ID and so on). It only subscribes to the topics of the tree. In a terminal it shows the whole tree; "
        "otherwise it prints one line per change.",
        epilog="Exit status: 0 if no failure was detected, 1 if one was, 2 on an error.",
    )
    add_examples(parser, "understudy watch policy.yaml --grace 3s", "understudy watch policy.yaml --for 30s")
    policy_file.add_options(parser)
    parser.add_argument(
        "--for", dest="length", type=_duration, metavar="DURATION", help="end after this time, such as 30s"
    )
    parser.add_argument(
        "--grace",
        metavar="DURATION",
        help="how long the application may take to become healthy for the first time, instead of the policy's "
        "startupGrace; use a short time such as 3s if it is already running",
    )
    return parser


def _duration(text: str) -> float:
    try:
        return seconds(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error

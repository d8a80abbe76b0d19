"""The supported thresholds of <Parallel> and <ParallelAll>: all children must succeed or, in a health tree, one is
enough."""

from __future__ import annotations

from collections.abc import Mapping

from understudy.trees.source.value_reader import found_text


def key_of(tag: str, values: Mapping[str, str], count: int) -> str:
    """Return ``parallel`` or ``selector`` for a node with ``count`` children. Raises ValueError for thresholds in
    between.

    A threshold below zero counts from the end, so -1 means all of them (BehaviorTree.CPP 4, parallel_node.h).
    """
    if tag == "ParallelAll":
        failures = _threshold(values, "max_failures", 1, count)
        if failures == 1:
            return "parallel"
        raise ValueError(
            f"max_failures={failures} of {count}: a health tree fails at its first failure; remove max_failures if all must "
            "hold, or write <Fallback> if one is enough"
        )
    successes = _threshold(values, "success_count", -1, count)
    failures = _threshold(values, "failure_count", 1, count)
    if successes == count:
        return "parallel"
    if successes == 1 and failures == count:
        return "selector"
    raise ValueError(
        f"success_count={successes} and failure_count={failures} of {count}: remove both if all must hold, or write "
        "<Fallback> if one is enough; a health tree supports no other numbers"
    )


def all_of(tag: str, values: Mapping[str, str], count: int) -> str:
    """Return ``parallel`` for a <Parallel> of a procedure with ``count`` children. Raises ValueError if not all must
    succeed."""
    successes = _threshold(values, "success_count", -1, count)
    failures = _threshold(values, "failure_count", 1, count)
    if successes == count:
        return "parallel"
    raise ValueError(
        f"success_count={successes} and failure_count={failures} of {count}: remove both: the first failure ends it. If "
        "one is enough, write <Fallback>, which tries one after the other"
    )


def _threshold(values: Mapping[str, str], port: str, default: int, count: int) -> int:
    text = values.get(port, str(default))
    try:
        number = int(text) if len(text) <= 6 else None
    except ValueError:
        number = None
    threshold = number + count + 1 if number is not None and number < 0 else number
    if threshold is None or not 1 <= threshold <= count:
        raise ValueError(f"{port}: found {found_text(text)}; give a number from 1 to {count}, or -1 for all of them")
    return threshold

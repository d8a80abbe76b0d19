"""Formats the result of ``understudy simulate`` as text and as JSON data."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

from understudy.api.plain_text import plain
from understudy.cli.common.text.text_tables import format_texts
from understudy.cli.common.text.wording import wall
from understudy.cli.simulate.bags import Bag
from understudy.cli.simulate.fault_times import matched
from understudy.cli.simulate.leaf_history import Failure, Span
from understudy.cli.simulate.policy_file import Policy
from understudy.cli.simulate.replay import Replay
from understudy.trees.core.leaf import duration

ASSUMED = (
    "all messages came from the robot or from the active instance: a bag does not record which instance sent a message",
    "that instance took control when the recording began, and nothing was recovered",
)
"""Assumptions about what a bag does not record."""


class Report:
    """One run of ``understudy simulate``."""

    def __init__(self, policy: Policy, bag: Bag, replay: Replay, onsets: Sequence[float] = ()) -> None:
        """``onsets`` are times of real failures, in unix seconds."""
        self._policy, self._bag, self._replay = policy, bag, replay
        self._onsets = onsets

    # -- text -------------------------------------------------------------------------------------------------

    def text(self) -> str:
        """Format the result as text."""
        return "\n".join(
            plain(line.rstrip()) for part in (self._head(), self._found(), self._leaves()) for line in part
        )

    def _head(self) -> Iterator[str]:
        policy, bag, evaluation = self._policy, self._bag, self._replay.evaluation
        looked = sum(len(times) for times in self._replay.arrivals.values())
        debounce = f"debounce {duration(policy.debounce)}" if policy.debounce else "no debounce"
        yield f"policy     {policy.name}: {debounce}, grace {duration(policy.grace)} at the start"
        yield (
            f"bag        {bag.path}: {bag.end - bag.start:.3f} s from {wall(bag.start)}, {looked} messages evaluated on "
            f"{len(self._replay.arrivals)} of its {len(bag.topics)} topics"
        )
        for index, assumed in enumerate(ASSUMED):
            yield f"{'' if index else 'assumed':11}{assumed}"
        for index, left in enumerate(self._replay.left_out):
            yield f"{'' if index else 'LEFT OUT':11}{', '.join(left.leaves) or 'no leaf'}: {left.why}"
        if evaluation.healthy is None:
            yield "healthy    never"
        else:
            yield f"healthy    from {self._at(evaluation.healthy)}"
        yield ""

    def _found(self) -> Iterator[str]:
        evaluation = self._replay.evaluation
        onsets, others = matched(self._onsets, evaluation.detections)
        rows = [("DETECTED", "WALL TIME (UTC)", "LEAF", "LAST HEALTHY", "RECOVERED", "REASON")]
        rows += [
            (
                self._at(one.detected),
                wall(one.detected or 0.0, zone=False),
                one.leaf,
                self._at(one.onset),
                self._at(one.recovered, never="not in this bag"),
                one.reason,
            )
            for one in evaluation.detections
        ]
        if evaluation.detections:
            yield from format_texts(rows)
        else:
            yield "Nothing was detected."
        for one in evaluation.failures:
            if one.detected is None:
                ended = one.recovered if one.recovered is not None else self._bag.end
                why = (
                    "the policy's debounce"
                    if one.recovered is not None
                    else "the policy's debounce before the bag ended"
                )
                yield (
                    f"Not detected: failed at {self._at(one.failed)} for {_length(ended - one.failed)}, less than {why}: "
                    f"{one.leaf}: {one.reason}"
                )
        for onset in onsets:
            result = f"detected {_length(onset.delay)} later" if onset.delay is not None else "NOT DETECTED"
            yield f"Given failure at {self._at(onset.at)}: {result}"
        if onsets:
            yield from (f"Detected at {self._at(one.detected)}: matches no given failure" for one in others)
        yield ""

    def _leaves(self) -> Iterator[str]:
        rows = [("LEAF", "TOPIC", "MESSAGES", "RATE", "LONGEST GAP", "FAILED", "FINAL STATE")]
        for path, topic in self._replay.topics.items():
            times, spans = self._replay.received(path), self._replay.evaluation.spans[path]
            failed = [span for span in spans if span.state == "Failed"]
            total = sum(_ended(span) - span.started for span in failed)
            rows.append(
                (
                    path,
                    topic,
                    str(len(times)),
                    _rate(times),
                    _gap(times),
                    f"{len(failed)}x, {_length(total)}, first at {self._at(failed[0].started)}" if failed else "-",
                    spans[-1].state,
                )
            )
        yield from format_texts(rows)

    def _at(self, moment: float | None, never: str = "-") -> str:
        return f"{moment - self._bag.start:.3f} s" if moment is not None else never

    # -- data -----------------------------------------------------------------------------------------------

    def data(self) -> dict[str, Any]:
        """Return the result as JSON data. Times with ``At`` are seconds from the bag's start; wall times are named so."""
        policy, bag, replay, evaluation = self._policy, self._bag, self._replay, self._replay.evaluation
        onsets, others = matched(self._onsets, evaluation.detections)
        return {
            "policy": {"name": policy.name, "debounce": policy.debounce, "startupGrace": policy.grace},
            "bag": {
                "path": bag.path,
                "start": wall(bag.start),
                "startUnix": bag.start,
                "duration": _exact(bag.end - bag.start),
                "topics": len(bag.topics),
            },
            "assumed": list(ASSUMED),
            "leftOut": [{"leaves": list(one.leaves), "why": one.why} for one in replay.left_out],
            "healthyAt": self._seconds(evaluation.healthy),
            "detections": [self._failure(one) for one in evaluation.detections],
            "passedOver": [self._failure(one) for one in evaluation.failures if one.detected is None],
            "onsets": [
                {"at": self._seconds(one.at), "delay": _exact(one.delay) if one.delay is not None else None}
                for one in onsets
            ],
            "withoutOnset": [self._seconds(one.detected) for one in others] if onsets else [],
            "leaves": [
                {
                    "path": path,
                    "topic": topic,
                    "messages": len(replay.received(path)),
                    "longestGap": max((later - one for one, later in pairwise(replay.received(path))), default=None),
                    "states": [
                        {
                            "state": span.state,
                            "fromAt": self._seconds(span.started),
                            "toAt": self._seconds(span.ended),
                            "reason": span.reason,
                        }
                        for span in evaluation.spans[path]
                    ],
                }
                for path, topic in replay.topics.items()
            ],
        }

    def _failure(self, failure: Failure) -> dict[str, Any]:
        detected = failure.detected
        return {
            "detectedAt": self._seconds(detected),
            "detectedWall": wall(detected) if detected is not None else None,
            "failedAt": self._seconds(failure.failed),
            "lastWellAt": self._seconds(failure.onset),
            "recoveredAt": self._seconds(failure.recovered),
            "leaf": failure.leaf,
            "reason": failure.reason,
        }

    def _seconds(self, moment: float | None) -> float | None:
        return _exact(moment - self._bag.start) if moment is not None else None


def _exact(length: float) -> float:
    """Round to the precision that a float has for current unix times."""
    return round(length, 6)


def _ended(span: Span) -> float:
    return span.ended if span.ended is not None else span.started


def _rate(times: array[float]) -> str:
    if len(times) < 2 or times[-1] <= times[0]:
        return "-"
    return f"{(len(times) - 1) / (times[-1] - times[0]):.4g} Hz"


def _gap(times: array[float]) -> str:
    return _length(max(later - one for one, later in pairwise(times))) if len(times) > 1 else "-"


def _length(seconds: float) -> str:
    return duration(round(seconds, 3)) if seconds >= 0.0005 or not seconds else f"{seconds * 1000:.1g} ms"

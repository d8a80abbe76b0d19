"""Compares given times of real failures with the detections."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass

from understudy.api.base import seconds
from understudy.cli.common.text.wording import moment, wall
from understudy.cli.simulate.leaf_history import Failure


@dataclass(frozen=True)
class Onset:
    """A real failure and its detection. Times are unix seconds."""

    at: float
    detection: Failure | None
    """The first detection from then on, before the next onset; None if there is none."""

    @property
    def delay(self) -> float | None:
        """Seconds until the detection."""
        return self.detection.detected - self.at if self.detection and self.detection.detected is not None else None


def parse(text: str, start: float, end: float) -> float:
    """Parse a time into unix seconds: seconds after ``start`` (``12.5``), a duration (``1m30s``) or a wall time (ISO 8601, UTC
    without a zone). Raises ValueError.
    """
    found = _moment(text, start)
    if not start <= found <= end:
        raise ValueError(
            f"{text!r:.80} is not within the bag, which is {end - start:.3f} s long and starts at {wall(start)}"
        )
    return found


def _moment(text: str, start: float) -> float:
    with contextlib.suppress(ValueError):
        if math.isfinite(found := float(text)):
            return start + found
    with contextlib.suppress(ValueError):
        return start + seconds(text)
    try:
        return moment(text)
    except ValueError:
        raise ValueError(
            f"{text!r:.80} is not a time: give seconds from the bag's start such as 12.5, or a wall time such as 2026-03-01T10:00:12.5Z"
        ) from None


def matched(onsets: Sequence[float], detections: Sequence[Failure]) -> tuple[list[Onset], list[Failure]]:
    """Match each onset with its detection; return these pairs and the other detections."""
    times = sorted(onsets)
    found, left = [], list(detections)
    for index, at in enumerate(times):
        until = times[index + 1] if index + 1 < len(times) else math.inf
        first = next((one for one in left if one.detected is not None and at <= one.detected < until), None)
        if first is not None:
            left.remove(first)
        found.append(Onset(at, first))
    return found, left

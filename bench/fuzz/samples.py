"""One generated object for each seed, so that a finding can be repeated from its number."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from bench.fuzz import objects, values
from bench.fuzz.values import Strategy
from tests.support.nested_values import PLACE, nested

Way = Literal["create", "update", "live"]
"""Create a new object, change one that exists, or change what the monitor of a running workload reads."""

_KINDS = ("FailurePolicy",) * 8 + ("FallbackPool",) * 4 + ("RobotWorkload",) * 4 + ("ConfigMap",) * 4
_WAYS: tuple[Way, ...] = ("create",) * 14 + ("update",) * 4 + ("live",) * 2
MOST_BYTES = 1_400_000
"""Larger objects are refused by every API server, whose database takes 1.5 MiB."""

_PLACE = re.compile(f'"{PLACE}"(?!:)')  # a key cannot be nested
_DEPTHS = (20, 150, 350, 1_000, 3_000)


@dataclass(frozen=True)
class Sample:
    """A generated object."""

    seed: int
    kind: str
    way: Way
    mutated: bool
    """Whether parts of it were replaced after it was drawn from its schema."""
    text: str
    """The object as JSON, with its name."""

    @property
    def name(self) -> str:
        """The name of a new object."""
        return f"{values.OWN}-{self.seed}"

    def part(self, field: str) -> str:
        """Return a field of the object as JSON; empty if it is not the last one."""
        _, found, value = self.text.partition(f',"{field}":')
        return value[:-1] if found else ""

    def __str__(self) -> str:
        return f"seed {self.seed} ({self.way} {self.kind}, {'mutated' if self.mutated else 'by its schema'}, {len(self.text)} bytes)"


@cache
def _drawn() -> Strategy:
    def of_kind(kind: str) -> Strategy:
        valid, almost = objects.valid(kind), objects.almost_valid(kind)
        return st.tuples(
            st.just(kind),
            st.sampled_from(_WAYS),
            st.one_of(
                st.tuples(st.just(False), valid), st.tuples(st.just(False), valid), st.tuples(st.just(True), almost)
            ),
            st.sampled_from(_DEPTHS),
        )

    return st.sampled_from(_KINDS).flatmap(of_kind)


def sample(number: int) -> Sample:
    """Return the object of a seed."""
    found: list[Any] = []

    # The first example is always the simplest one. The second one depends on the seed only.
    @seed(number)
    @settings(
        max_examples=2, database=None, deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck)
    )
    @given(_drawn())
    def draw(value: Any) -> None:
        found.append(value)

    draw()
    kind, way, (mutated, item), depth = found[-1]
    item["metadata"]["name"] = f"{values.OWN}-{number}"
    text = _written(item) or _written({**item, "spec": {}, "data": {}}) or _written({"metadata": {}})
    for levels in (depth, _DEPTHS[0]):
        if text.count(PLACE) * len(nested(levels)) <= MOST_BYTES:
            text = _PLACE.sub(nested(levels), text)
            break
    return Sample(number, kind, way, mutated, text)


def _written(item: dict[str, Any]) -> str:
    """Return an object as JSON; empty if it is too large. Mutations repeat parts of it, so the whole may be larger than the memory."""
    parts, size = list[str](), 0
    for part in json.JSONEncoder(separators=(",", ":")).iterencode(item):
        parts.append(part)
        size += len(part)
        if size > MOST_BYTES:
            return ""
    return "".join(parts)

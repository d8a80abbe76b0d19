"""The figures of failovers with and without a flood, and the bounds that they must hold."""

from __future__ import annotations

import pytest

from bench.flood.report import add
from bench.flood.series import GAP, Found
from bench.results import Report


def found(*gaps: float) -> Found:
    """Results of failures with these gaps in milliseconds."""
    made = Found()
    for gap in gaps:
        made.add(GAP, gap)
    made.conditions["GateEnforced True SeenFromPackets"] = 10
    return made


def held(flood: Found, *, bounded: bool = True) -> bool:
    """Whether the bounds hold beside failures that took up to 550 ms."""
    report = Report("flood")
    add(report, found(520.0, 550.0), {"peer, none": flood}, {"peer, none"} if bounded else set())
    return report.held


def test_a_failover_may_take_a_tenth_of_a_second_longer() -> None:
    assert held(found(530.0, 650.0))
    assert not held(found(530.0, 651.0))


@pytest.mark.parametrize(
    "change",
    [
        lambda one: one.unasked.append("a -> b: gap"),
        lambda one: one.wrong.append("a was not recovered"),
        lambda one: one.restarts.update(monitor=1),
        lambda one: one.conditions.update({"GateEnforced False NotEnforced": 1}),
    ],
    ids=["a false failover", "another strategy", "a restart", "a false condition"],
)
def test_what_must_not_be(change: object) -> None:
    flood = found(530.0)
    assert callable(change)
    change(flood)
    assert not held(flood)


def test_without_a_bound_everything_is_only_reported() -> None:
    flood = found(5000.0)
    flood.unasked.append("a -> b: gap")
    assert held(flood, bounded=False)

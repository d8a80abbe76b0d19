"""A topic after a stall of the observer, which loses samples: its rate and its gap are judged over observed time only."""

from __future__ import annotations

import pytest

from tests.unit.trees.topic_world import START, World, gap, rate, steady

FROZEN, THAWED = 6.0, 20.0
"""Seconds at which the observer froze, and at which it continued."""
TOPIC = "/cmd_vel"


def robot(until: float, band: str, *, hertz: float = 10.0) -> World:
    """A robot at 10 Hz whose observer was frozen: the last ten samples of that time arrive, all at once. Its rate since
    then is given."""
    world = World(rate(TOPIC, band)).arrive(TOPIC, *steady(10, 0.0, FROZEN))
    assert world.at(FROZEN).state == "Healthy"
    since = [THAWED + i / 1000 for i in range(10)] + steady(hertz, THAWED + 0.1, THAWED + 10)
    world.arrive(TOPIC, *(time for time in since if time <= until))
    world.records[TOPIC].observed_since = START + THAWED + 0.25
    return world


@pytest.mark.parametrize("band", ["> 8 Hz", "9 to 11 Hz"])
def test_a_healthy_robot_does_not_fail_after_a_stall(band: str) -> None:
    for tenth in range(1, 50):
        moment = THAWED + tenth / 10 + 0.05
        found = robot(moment, band).at(moment)
        assert found.state == "Healthy", f"{tenth / 10} s after the stall: {found.reason}"


@pytest.mark.parametrize(("band", "hertz"), [("> 8 Hz", 5.0), ("9 to 11 Hz", 5.0), ("9 to 11 Hz", 20.0)])
def test_a_rate_that_is_wrong_after_a_stall_fails_one_window_later(band: str, hertz: float) -> None:
    before, after = THAWED + 2.2, THAWED + 2.26
    world = robot(before, band, hertz=hertz)
    assert world.at(before).state == "Healthy"
    assert world.deadline(before) == pytest.approx(THAWED + 2.25)
    assert robot(after, band, hertz=hertz).at(after).state == "Failed"


def test_an_instance_that_was_never_healthy_is_starting_after_a_stall() -> None:
    world = World(rate(TOPIC)).arrive(TOPIC, *steady(5, 0.0, 6.0))
    world.records[TOPIC].observed_since = START + 5.0
    assert world.at(6.0).state == "Starting"


def slow(until: float, *, last: float = FROZEN + 1) -> World:
    """A robot at 2 Hz whose observer was frozen: the queue gives samples up to ``last``, and the next one is late by half a period."""
    world = World(gap(TOPIC, "800ms")).arrive(TOPIC, *steady(2, 0.0, FROZEN))
    assert world.at(FROZEN).state == "Healthy"
    world.arrive(TOPIC, *(time for time in [last, *steady(2, THAWED + 0.45, THAWED + 10)] if time <= until))
    world.records[TOPIC].observed_since = START + THAWED + 0.25
    return world


def test_a_slow_topic_does_not_fail_after_a_stall() -> None:
    for tenth in range(1, 50):
        moment = THAWED + tenth / 10
        found = slow(moment).at(moment)
        assert found.state == "Healthy", f"{tenth / 10} s after the stall: {found.reason}"


def test_a_slow_topic_that_has_ended_fails_one_gap_after_a_stall() -> None:
    world = World(gap(TOPIC, "800ms")).arrive(TOPIC, *steady(2, 0.0, FROZEN))
    world.records[TOPIC].observed_since = START + THAWED + 0.25
    assert world.at(THAWED + 1.0).state == "Healthy"
    assert world.deadline(THAWED + 1.0) == pytest.approx(THAWED + 1.05)
    assert world.at(THAWED + 1.06).state == "Failed"

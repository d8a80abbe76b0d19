"""No goal of a client is lost or repeated, whatever order failures, switches and restarts of action proxies come in.

A run that fails says its seed; ``scripts/bench interleavings --seed SEED`` tells all that happened in it. What must hold is said in
task_clients.py.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from unittest import mock

import pytest

from tests.unit.interleavings import simulation, tasks
from tests.unit.interleavings.comparison import observed_alike
from tests.unit.interleavings.scenes import Outcome
from tests.unit.interleavings.tasks import SCENES, Tasked
from understudy.action_proxy import goal_journal
from understudy.action_proxy.goal_journal import GoalJournal
from understudy.action_proxy.goal_ledger import GoalLedger

FIRST, RUNS, CHUNK = 2_100_048, 48, 16
"""Seeds that scripts/bench doesn't run by itself."""


@pytest.fixture(autouse=True)
def _prepared() -> None:
    """What runs begin from is made by code without faults."""
    for scene in SCENES:
        simulation.prepared(scene, Tasked)


@pytest.mark.parametrize("first", range(FIRST, FIRST + RUNS, CHUNK))
def test_goals_are_kept_in_every_interleaving(first: int) -> None:
    counts: Counter[str] = Counter()
    for seed in range(first, first + CHUNK):
        outcome = tasks.run(seed)
        assert not outcome.faults, str(tasks.run(seed, tracing=True))
        counts += Counter(outcome.tasks)
    assert counts["ended"] > 5 * CHUNK, "it isn't about nothing"
    assert counts["resumed"]
    assert counts["cancelled"]


def test_a_seed_determines_the_run() -> None:
    assert "works on" in observed_alike("tasks", 2_100_003, range(2_000_000, 2_000_003))


# -- faults that the runs would find ----------------------------------------------------------------------------------


def found(words: str, *troubles: str, weather: float = 1.0, within: int = 300, first: int = 0) -> Outcome:
    """The first run of the first scene, with only these troubles, in which something of these words does not hold.

    ``first`` is a seed that found it when it was written, so that the test takes no longer than it has to.
    """
    only = replace(SCENES[0], troubles=troubles, weather=(weather,))
    for seed in range(first, first + within):
        outcome = tasks.run(seed, scene=only)
        if any(words in fault for fault in outcome.faults):
            return outcome
    pytest.fail(f"no {words!r} in {within} runs")


def test_a_proxy_that_stores_nothing_is_found() -> None:
    with mock.patch.object(GoalJournal, "save"):
        assert found("is lost", "action_proxy_dies", "one_fails", weather=0.0, first=1)


def test_a_proxy_that_believes_the_ends_of_an_instance_that_is_gone_is_found() -> None:
    """Applications abort their goals at the signal to end."""

    class Everybody(set[str]):
        def __contains__(self, _: object) -> bool:
            return True

    class Credulous(GoalLedger):
        def __init__(self) -> None:
            super().__init__()
            self.connected = Everybody()

    with mock.patch.object(goal_journal, "GoalLedger", Credulous), mock.patch.object(tasks, "ABORTS", 1.0):
        assert found("is aborted", "one_fails", "monitor_dies_at_a_step", first=8)

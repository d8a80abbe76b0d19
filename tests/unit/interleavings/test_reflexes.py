"""The reflex holds under whatever order failures, cuts, commits, restarts and words to agents come in.

A run that fails says its seed; ``scripts/bench interleavings --seed SEED`` tells all that happened in it. What must hold is
said in reflexinvariants.py.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any
from unittest import mock

import pytest

from tests.unit.interleavings import reflexes, simulation
from tests.unit.interleavings.comparison import observed_alike, unconditional
from tests.unit.interleavings.ownership import PERIOD, Reader, Writer
from tests.unit.interleavings.reflexes import SCENES, Reflexive
from tests.unit.interleavings.scenes import Outcome, Scene
from understudy.agent.permit import Permit
from understudy.agent.writer_strength import WriterStrengths
from understudy.api.protocol.ownership_strength import STRONGEST
from understudy.failover import reflex
from understudy.failover.interfaces import Instance
from understudy.kube.gates.kinds.network_policy import GATE
from understudy.monitor.act.gate import permits
from understudy.monitor.act.gate.reflex_guard import ReflexGuard

FIRST, RUNS, CHUNK = 1_100_000, 48, 16
"""Seeds that scripts/bench doesn't run by itself."""

ALONE, _, TWO = SCENES


@pytest.fixture(autouse=True)
def _prepared() -> None:
    """What runs begin from is made by code without faults."""
    for scene in SCENES:
        simulation.prepared(scene, Reflexive)


@pytest.mark.parametrize("first", range(FIRST, FIRST + RUNS, CHUNK))
def test_the_reflex_invariants_hold_in_every_interleaving(first: int) -> None:
    counts: Counter[str] = Counter()
    for seed in range(first, first + CHUNK):
        outcome = reflexes.run(seed)
        assert not outcome.faults, str(reflexes.run(seed, tracing=True))
        counts += Counter(outcome.reflex)
    assert counts["taken"] > CHUNK, "it isn't about nothing"
    assert counts["let through"]
    assert counts["held"]
    assert counts["fell over"]


def test_a_seed_determines_the_run() -> None:
    assert "takes" in observed_alike("reflexes", 1_100_003, range(1_000_000, 1_000_004))


# -- the reader is one with exclusive ownership ---------------------------------------------------------------------


class Clock:
    """Time that a test lets pass."""

    def __init__(self) -> None:
        self.now = 100.0
        self._later: list[tuple[float, int, Any, tuple[Any, ...]]] = []

    def later(self, seconds: float, work: Any, *args: Any) -> None:
        self._later.append((self.now + seconds, len(self._later), work, args))

    def until(self, end: float) -> None:
        while due := sorted(one[:2] for one in self._later if one[0] <= end):
            found = next(one for one in self._later if one[:2] == due[0])
            self._later[found[1]] = (float("inf"), found[1], None, ())
            self.now = max(self.now, found[0])
            found[2](*found[3])
        self.now = end


STRONG, WEAK = Writer("strong", 20, 0.0), Writer("weak", 10, 0.01)
DEADLINE = 0.3


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def reader(clock: Clock) -> Reader:
    """One that takes the stronger of two."""
    made = Reader(DEADLINE, lambda: clock.now, clock.later, lambda: None)
    made.hear("weak", WEAK)
    made.hear("strong", STRONG)
    clock.until(101.02)
    assert made.driver == "strong"
    return made


def test_a_reader_follows_the_next_writer_after_the_deadline(clock: Clock, reader: Reader) -> None:
    reader.hear("strong", None)
    clock.until(101.29)
    assert reader.driver == ""
    clock.until(101.3 + PERIOD)
    assert reader.driver == "weak"
    assert reader.last("strong") == pytest.approx(101.0)
    assert reader.arrivals("weak")[-1] == pytest.approx(101.31)
    assert reader.first("weak", 101.0) == pytest.approx(101.31)


def test_a_reader_follows_the_stronger_writer_again_at_once(clock: Clock, reader: Reader) -> None:
    reader.hear("strong", None)
    clock.until(102.02)
    reader.hear("strong", STRONG)
    clock.until(102.06)
    assert reader.driver == "strong"
    assert reader.last("weak") == pytest.approx(102.01)


def test_a_reader_does_not_change_its_writer_before_the_deadline(clock: Clock, reader: Reader) -> None:
    reader.hear("strong", None)
    clock.until(101.21)
    reader.hear("strong", STRONG)
    clock.until(102.0)
    assert reader.driver == "strong"
    assert not [at for at in reader.arrivals("weak") if at > 101.0]


def test_a_reader_does_not_wait_for_a_writer_that_announces_its_end(clock: Clock, reader: Reader) -> None:
    reader.hear("strong", None, left=True)
    clock.until(101.02 + PERIOD)
    assert reader.driver == "weak"


# -- the simulation finds faults ------------------------------------------------------------------------------------


def found(
    words: str,
    scene: Scene,
    *troubles: str,
    weather: float = 1.0,
    within: int = 100,
    first: int = 0,
    kind: type[Reflexive] = Reflexive,
) -> Outcome:
    """The first run of a scene, with only these troubles, in which something of these words doesn't hold.

    ``first`` is a seed that found it when it was written, so that the test takes no longer than it has to.
    """
    only = replace(scene, troubles=troubles, weather=(weather,))
    for seed in range(first, first + within):
        outcome = reflexes.run(seed, scene=only, kind=kind)
        if any(words in fault for fault in outcome.faults):
            return outcome
    pytest.fail(f"no {words!r} in {within} runs")


def test_a_replaced_instance_that_is_permitted_to_continue_is_detected() -> None:
    # And at once: a second later its node knows the gate of now.
    with mock.patch.object(permits, "word", return_value="Go"), mock.patch.object(permits, "CATCH_UP", 0.0):
        assert found("which its gate shut out", ALONE, "node_is_cut_off")


def test_an_isolated_instance_that_is_not_held_is_detected() -> None:
    with mock.patch.object(Permit, "evaluate"):
        assert found("which its gate shut out", ALONE, "node_is_cut_off")


def test_a_standby_that_is_stronger_than_the_active_instance_is_detected() -> None:
    def strength(self: ReflexGuard, instance: Instance) -> tuple[int, int]:
        at = STRONGEST if instance.uid == self._gate.state.active_uid else 0
        return at, at

    with mock.patch.object(ReflexGuard, "_strength", strength):
        assert found("which is no stronger", ALONE, "understudy_fails", "one_fails", "all_fail", within=200, first=13)


def test_a_standby_that_is_admitted_over_another_write_is_detected() -> None:
    with mock.patch.object(GATE, "admission", unconditional(GATE.admission)):
        assert found(
            "lets ", ALONE, "active_hangs", "standby_hangs", "second_monitor", weather=3.0, within=200, first=109
        )


class Crashing(Reflexive):
    """Nobody reaches the API server, a container of the instance in control ends, and its standby is late when it is back."""

    causes = {"crash": 1}  # noqa: RUF012

    def _crash(self) -> None:
        workload = self.choices.choice(self.workloads)
        active, standby = self._active(workload), self._standby(workload)
        self._is_away(8.0)
        self._break(active, "crashes")
        self.later(4.0, self.mine.hang, standby, 1.0)


def test_output_of_a_restarted_container_of_a_replaced_instance_is_detected() -> None:
    with mock.patch.object(WriterStrengths, "give_way"):
        assert found("after it gave way", ALONE, "crash", kind=Crashing, first=14)


def test_a_reflex_that_is_not_committed_is_detected() -> None:
    async def careless(progress: Any, context: Any) -> None:
        return

    with mock.patch.object(reflex, "commit", careless):
        assert found("took", TWO, "active_hangs", within=200)

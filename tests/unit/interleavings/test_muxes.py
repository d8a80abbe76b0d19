"""A mux forwards one instance after the other under whatever order orders, reports, switches, cuts, stalls and restarts come in.

A run that fails shows its seed; ``scripts/bench interleavings --seed SEED`` prints all that happened in it. What must hold is in
mux_invariants.py.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from unittest import mock

import pytest

from tests.unit.interleavings import muxes, simulation
from tests.unit.interleavings.comparison import observed_alike
from tests.unit.interleavings.muxes import SCENES, Muxed
from tests.unit.interleavings.scenes import Outcome, Scene
from understudy.api.protocol.mux_messages import Order, Token
from understudy.kube.gates.mux_reports import MuxReports
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.judge.reflex_takeover import ReflexTakeover
from understudy.mux import forwarder
from understudy.mux.control import Control, ordered
from understudy.mux.forwarder import Forwarder

FIRST, RUNS, CHUNK = 3_100_000, 48, 16
"""Seeds that scripts/bench does not run by itself."""

ALONE, REFLEX, _, TWO = SCENES


@pytest.fixture(autouse=True)
def _prepared() -> None:
    """What runs begin from is made by code without faults."""
    for scene in SCENES:
        simulation.prepared(scene, Muxed)


@pytest.mark.parametrize("first", range(FIRST, FIRST + RUNS, CHUNK))
def test_the_mux_invariants_hold_in_every_interleaving(first: int) -> None:
    counts: Counter[str] = Counter()
    for seed in range(first, first + CHUNK):
        outcome = muxes.run(seed)
        assert not outcome.faults, str(muxes.run(seed, tracing=True))
        counts += Counter(outcome.muxes)
    assert counts["forwarded"] > 1000 * CHUNK, "it is not about nothing"
    assert counts["ordered"] > CHUNK
    assert counts["switched"]
    assert counts["switches committed"]


def test_a_seed_determines_the_run() -> None:
    assert "forwards" in observed_alike("muxes", 3_100_001, range(3_000_000, 3_000_003))


# -- the simulation finds faults ------------------------------------------------------------------------------------


def found(words: str, scene: Scene, *troubles: str, weather: float = 0.0, within: int = 300, first: int = 0) -> Outcome:
    """The first run of a scene, with only these troubles, in which something of these words does not hold.

    ``first`` is a seed that found it when it was written, so that the test takes no longer than it has to.
    """
    only = replace(scene, troubles=troubles, weather=(weather,))
    for seed in range(first, first + within):
        outcome = muxes.run(seed, scene=only)
        if any(words in fault for fault in outcome.faults):
            return outcome
    pytest.fail(f"no {words!r} in {within} runs")


def test_an_older_epoch_that_is_accepted_is_detected() -> None:
    def careless(control: Control, order: Order) -> Control:
        return ordered(replace(control, token=Token(), revision=-1), order)

    with mock.patch.object(forwarder, "ordered", careless):
        assert found("back to", ALONE, "order_is_repeated", "driver_fails")


def test_an_order_that_undoes_a_switch_is_detected() -> None:
    def careless(control: Control, order: Order) -> Control:
        return ordered(control, replace(order, knows=Token(math.inf)))

    with mock.patch.object(forwarder, "ordered", careless):
        assert found(
            "which undoes the switch", TWO, "several_fail_in_an_outage", "monitor_and_mux_part", "driver_fails"
        )


def test_a_monitor_that_knows_a_switch_only_after_its_decision_is_detected() -> None:
    def late(self: MuxReports, epoch: int) -> Token:
        return self.latest.report.token if self.latest is not None else Token()

    with mock.patch.object(MuxReports, "known", late):
        assert found(
            "which undoes the switch", TWO, "several_fail_in_an_outage", "monitor_and_mux_part", "driver_fails"
        )


def test_a_sample_from_before_an_order_that_is_forwarded_is_detected() -> None:
    order = Forwarder.order

    def careless(self: Forwarder, text: str) -> None:
        with mock.patch.object(Forwarder, "drain"):
            order(self, text)

    with mock.patch.object(Forwarder, "order", careless):
        assert found("had sent before it was in control", ALONE, "mux_stalls", "driver_fails", "one_fails")


def test_a_decision_that_is_not_kept_before_it_has_effect_is_detected() -> None:
    with mock.patch.object(Forwarder, "_decide", Forwarder._apply):
        assert found("and had forwarded", ALONE, "mux_restarts", "driver_fails")


def test_a_fence_that_has_no_effect_while_the_disk_is_full_is_detected() -> None:
    with mock.patch.object(forwarder, "replace", lambda control, **_: control):
        assert found("names nobody", ALONE, "disk_is_full", "somebody_fences")


def test_an_instance_that_is_replaced_before_it_can_be_discovered_is_detected() -> None:
    with mock.patch.object(forwarder, "DISCOVERY", 0.0):
        assert found("which it has heard", REFLEX, "mux_restarts")


def test_a_switch_that_no_monitor_commits_is_detected() -> None:
    with mock.patch.object(ReflexTakeover, "detect", return_value=None):
        assert found("and the mux forwards", REFLEX, "driver_fails", "instance_loses_the_mux")


def test_a_switch_to_an_instance_that_is_gone_is_detected() -> None:
    with mock.patch.object(GateControl, "raise_epoch", mock.AsyncMock()):
        assert found("and the mux forwards", TWO, "instance_loses_the_mux", "understudy_fails")

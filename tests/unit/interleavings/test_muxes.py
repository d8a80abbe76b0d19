"""A mux forwards one instance after the other under whatever order orders, reports, switches, cuts, stalls and restarts come in.

A run that fails shows its seed; ``scripts/bench interleavings --seed SEED`` prints all that happened in it. What must hold is in
mux_invariants.py.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import Any
from unittest import mock

import pytest

from tests.unit.interleavings import gates, muxes, simulation
from tests.unit.interleavings.comparison import observed_alike
from tests.unit.interleavings.muxes import SCENES, Muxed
from tests.unit.interleavings.scenes import Outcome, Scene
from understudy.api.protocol.mux_messages import Order, Token
from understudy.failover.progress import Progress
from understudy.kube.gates.mux_reports import MuxReports
from understudy.monitor import outcome
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.judge.reflex_takeover import ReflexTakeover
from understudy.monitor.observe.objects import interrupted_recovery
from understudy.mux import forwarder
from understudy.mux.control import Control, ordered
from understudy.mux.forwarder import Forwarder

FIRST, RUNS, CHUNK = 3_100_000, 48, 24
"""Seeds that scripts/bench does not run by itself."""

ALONE, REFLEX, _, TWO, ON_BOARD, _ = SCENES


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
    assert counts["forwarded"] > 300 * CHUNK, "it is not about nothing"
    assert counts["ordered"] > CHUNK
    assert counts["switched"]
    assert counts["switches committed"]
    assert counts["stood in"]


def test_the_instance_on_board_of_a_robot_that_is_cut_off_stands_in_and_gives_control_back() -> None:
    only, counts = replace(ON_BOARD, troubles=("robot_is_cut_off",)), Counter[str]()
    for seed in range(16):
        outcome = muxes.run(seed, scene=only)
        assert not outcome.faults, str(muxes.run(seed, scene=only, tracing=True))
        counts += Counter(outcome.muxes)
    assert counts["stood in"] > 4
    assert counts["returned"] > 2


def test_a_seed_determines_the_run() -> None:
    assert "forwards" in observed_alike("muxes", 3_100_003, range(3_000_000, 3_000_003))


# -- the simulation finds faults ------------------------------------------------------------------------------------


def found(
    words: str, scene: Scene, *troubles: str, within: int = 300, first: int = 0, kind: type[Muxed] = Muxed
) -> Outcome:
    """The first run of a scene, with only these troubles, in which something of these words does not hold.

    ``first`` is a seed that found it when it was written, so that the test takes no longer than it has to.
    """
    only = replace(scene, troubles=troubles, weather=(0.0,))
    for seed in range(first, first + within):
        outcome = muxes.run(seed, scene=only, kind=kind)
        if any(words in fault for fault in outcome.faults):
            return outcome
    pytest.fail(f"no {words!r} in {within} runs")


class Undoing(Muxed):
    """While the monitor and the mux do not reach each other, the mux switches, and the monitor replaces the instance by another one."""

    causes = {"undo": 1}  # noqa: RUF012

    def _undo(self) -> None:
        workload = self.choices.choice(self.workloads)
        active = self._active(workload)
        for monitor in [one for one in self.monitors if one.workload == workload]:
            self._part(monitor, 6.0)
        self.mine.set_cut(active, self.mine.cut, True)
        self.later(6.0, self.mine.set_cut, active, self.mine.cut, False)
        self.later(1.0, lambda: self._break(self._driver(workload), "stops for a while"))
        self.later(1.2, lambda: self._break(active, "deleted by force"))


class Vain(Muxed):
    """The mux switches to a standby that somebody has just deleted, and the instance in control is heard again."""

    causes = {"switch": 1}  # noqa: RUF012

    def _switch(self) -> None:
        workload = self.choices.choice(self.workloads)
        gate = gates.record(self.server, workload)
        if gate is not None and gate.admitted_uid:
            self.mine.set_cut(gate.active_uid, self.mine.cut, True)
            self.later(0.45, self.mine.set_cut, gate.active_uid, self.mine.cut, False)
            self.later(0.25, self._break, gate.admitted_uid, "deleted")


def test_an_older_epoch_that_is_accepted_is_detected() -> None:
    def careless(control: Control, order: Order) -> Control:
        return ordered(replace(control, token=Token(), revision=-1), order)

    with mock.patch.object(forwarder, "ordered", careless):
        assert found("back to", ALONE, "order_is_repeated", "driver_fails", first=2)


def test_an_instance_on_board_that_keeps_control_is_detected() -> None:
    def careless(control: Control, order: Order) -> Control:
        return ordered(control, replace(order, source="") if control.on_board else order)

    with mock.patch.object(forwarder, "ordered", careless):
        assert found("the mux forwards home", ON_BOARD, "robot_is_cut_off")


def test_an_order_that_undoes_a_switch_is_detected() -> None:
    def careless(control: Control, order: Order) -> Control:
        return ordered(control, replace(order, knows=Token(math.inf)))

    with mock.patch.object(forwarder, "ordered", careless):
        assert found("which undoes the switch", TWO, "undo", kind=Undoing, first=1)


def test_a_monitor_that_knows_a_switch_only_after_its_decision_is_detected() -> None:
    def late(self: MuxReports, epoch: int) -> Token:
        return self.latest.report.token if self.latest is not None else Token()

    with mock.patch.object(MuxReports, "known", late):
        assert found("which undoes the switch", TWO, "undo", kind=Undoing, first=1)


def test_a_sample_from_before_an_order_that_is_forwarded_is_detected() -> None:
    order = Forwarder.order

    def careless(self: Forwarder, text: str) -> None:
        with mock.patch.object(Forwarder, "drain"):
            order(self, text)

    with mock.patch.object(Forwarder, "order", careless):
        assert found("had sent before it was in control", ALONE, "mux_stalls", "driver_fails", "one_fails", first=12)


def test_a_decision_that_is_not_kept_before_it_has_effect_is_detected() -> None:
    with mock.patch.object(Forwarder, "_decide", Forwarder._apply):
        assert found("and had forwarded", ALONE, "mux_restarts", "driver_fails", first=4)


def test_a_fence_that_has_no_effect_while_the_disk_is_full_is_detected() -> None:
    with mock.patch.object(forwarder, "replace", lambda control, **_: control):
        assert found("names nobody", ALONE, "disk_is_full", "somebody_fences", first=1)


def test_an_instance_that_is_replaced_before_it_can_be_discovered_is_detected() -> None:
    with mock.patch.object(forwarder, "DISCOVERY", 0.0):
        assert found("which it has heard", REFLEX, "mux_restarts", first=1)


def test_a_switch_that_no_monitor_commits_is_detected() -> None:
    with mock.patch.object(ReflexTakeover, "detect", return_value=None):
        assert found("and the mux forwards", REFLEX, "driver_fails", "instance_loses_the_mux", first=1)


def test_a_committed_switch_of_which_no_recovery_is_recorded_is_detected() -> None:
    with mock.patch.object(outcome.Outcome, "concluded", False):
        assert found("no recovery is recorded", REFLEX, "driver_fails", "somebody_fences", first=5)


def test_a_committed_switch_that_the_next_monitor_does_not_continue_is_detected() -> None:
    interrupted = interrupted_recovery.interrupted

    def forgetful(*arguments: Any, **more: Any) -> Progress | None:
        recovery = interrupted(*arguments, **more)
        return recovery if recovery is None or recovery.taken_over is None else None

    with mock.patch.object(interrupted_recovery, "interrupted", forgetful):
        assert found("no recovery is recorded", REFLEX, "driver_fails", "monitor_dies_at_a_step", first=29)


def test_a_switch_to_an_instance_that_is_gone_is_detected() -> None:
    with mock.patch.object(GateControl, "raise_epoch", mock.AsyncMock()):
        assert found("and the mux forwards", REFLEX, "switch", kind=Vain)

"""A monitor closes the gate for a recovery and is gone, while another one runs: the robot does not wait for the time of its strategies."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from tests.unit.interleavings import simulation
from tests.unit.interleavings.pods import Luck
from tests.unit.interleavings.scenes import Outcome, Scene
from tests.unit.interleavings.simulation import Simulation
from understudy.api import names
from understudy.kube.client import Object
from understudy.kube.gates.base import GateRecord
from understudy.monitor.observe.objects.other_monitors import OtherMonitors

FIRST, RUNS = 900_000, 6
SCENE = Scene("restarted", workloads=1, strategies=("Restart",), weather=(0.0,), troubles=("kubelets_write",))

BESIDE, FAILS, OVER = 1.0, 6.0, 40.0
"""When the second monitor starts, when the instance fails, and when nothing goes wrong any more, in seconds from the beginning."""

WITHIN = 10.0
"""Seconds within which the next monitor has the robot driven: it is half of what the strategy and LASTS take."""


class Bereft(Simulation):
    """A run in which the monitor that closes the gate is gone at once."""

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.closed_at: float | None = None
        self.driven_after: float | None = None
        """Seconds from when the gate was closed until the robot was driven."""

    def _plan_trouble(self) -> float:
        super()._plan_trouble()
        self.robots.luck = Luck()
        (robot,) = self.workloads
        self.later(BESIDE, self.start_monitor, robot, "other")
        self.later(FAILS, lambda: self._break(self._active(robot), "deleted"))
        return OVER

    def _written(self, plural: str, old: Object | None, new: Object | None, by: str) -> None:
        super()._written(plural, old, new, by)
        (robot,) = self.workloads
        if new is None or new["metadata"]["name"] != names.gate(robot) or not GateRecord.of(new).recovery:
            return
        writer = next((monitor.process for monitor in self.monitors if monitor.process.name == by), None)
        if self.closed_at is None and writer is not None and not GateRecord.of(new).active:
            self.closed_at = self.loop.time()
            self.later(0.0, self.kill, writer)

    def _output_received(self, robot: str) -> None:
        super()._output_received(robot)
        driven = any(found.through for found in self.robots.running.values())
        if driven and self.closed_at is not None and self.driven_after is None:
            self.driven_after = self.loop.time() - self.closed_at


def run(seed: int, *, tracing: bool = False) -> tuple[Outcome, float]:
    """Return the run of a seed, and after how long the robot was driven."""
    base = simulation.prepared(SCENE)
    with tempfile.TemporaryDirectory() as folder:
        made = Bereft(SCENE, seed, base, Path(folder), tracing=tracing)
        try:
            outcome = made.run()
            assert made.driven_after is not None, str(outcome)
            return outcome, made.driven_after
        finally:
            made.dispose()


@pytest.mark.parametrize("seed", range(FIRST, FIRST + RUNS))
def test_the_next_monitor_continues_the_recovery_of_one_that_is_gone_at_once(seed: int) -> None:
    outcome, driven_after = run(seed)
    assert not outcome.faults, str(run(seed, tracing=True)[0])
    assert driven_after < WITHIN


def test_a_monitor_that_waits_although_the_other_one_is_gone_is_detected() -> None:
    simulation.prepared(SCENE)
    with mock.patch.object(OtherMonitors, "may_continue", return_value=True):
        assert run(FIRST)[1] > 2 * WITHIN

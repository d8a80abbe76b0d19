"""The clock of a process goes on when the system's clock is set, and its times are converted where they enter or leave the process."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from tests.support.clock import set_clock
from understudy.agent.agent_memory import NAME, AgentMemory
from understudy.clock import CLOCK, LEAST_STEP
from understudy.failover.pool_queue import Waiter
from understudy.failover.progress import Progress

STEPS = pytest.mark.parametrize("step", [-60.0, 60.0])


@STEPS
def test_it_goes_on_when_the_systems_clock_is_set(monkeypatch: pytest.MonkeyPatch, step: float) -> None:
    before = CLOCK.now()
    set_clock(monkeypatch, step)
    assert 0 <= CLOCK.now() - before < 1
    assert CLOCK.step() == pytest.approx(step, abs=LEAST_STEP)
    assert CLOCK.to_system(CLOCK.now()) == pytest.approx(time.time(), abs=LEAST_STEP)
    assert CLOCK.of_system(CLOCK.to_system(before)) == pytest.approx(before, abs=1e-6)


def test_times_are_exactly_the_same_unless_the_systems_clock_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    set_clock(monkeypatch, 60.0)
    assert CLOCK.step()
    monkeypatch.undo()  # somebody sets it back
    now = CLOCK.now()
    assert CLOCK.to_system(now) == CLOCK.of_system(now) == now
    assert now == pytest.approx(time.time(), abs=LEAST_STEP)


@STEPS
def test_a_recovery_is_recorded_by_the_systems_clock_as_it_is_set(monkeypatch: pytest.MonkeyPatch, step: float) -> None:
    now = CLOCK.now()
    progress = Progress.begin("no /cmd_vel", last_healthy=now - 1, detected=now)
    progress.waiting = Waiter(workload="w", pool="spare", since=now, until=now + 10)
    set_clock(monkeypatch, step)
    recorded = Progress.model_validate_json(progress.record())
    assert recorded.moments["detected"] - now == pytest.approx(step, abs=LEAST_STEP)
    assert recorded.waiting is not None
    assert recorded.waiting.until - now - 10 == pytest.approx(step, abs=LEAST_STEP)
    assert Progress.of_record(progress.record()).moments == pytest.approx(progress.moments, abs=1e-6)
    assert progress.moments["detected"] == now


@STEPS
def test_an_agent_stores_times_by_the_systems_clock_as_it_is_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: float
) -> None:
    memory = AgentMemory(process_up_at=CLOCK.now())
    set_clock(monkeypatch, step)
    memory.save(tmp_path)
    assert json.loads((tmp_path / NAME).read_text())["process_up_at"] == pytest.approx(time.time(), abs=1)
    assert AgentMemory.load(tmp_path).process_up_at == pytest.approx(memory.process_up_at, abs=1e-6)

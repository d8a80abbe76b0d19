"""The monitor looks at its deadline, sooner if a message arrives, and never too often."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import Iterator
from itertools import pairwise

import pytest

from tests.support.clock import Clock, set_clock
from understudy.monitor.observe import wakeups
from understudy.monitor.observe.wakeups import APART, STALL_MOST, STALLED, EvaluationSchedule, Wakeups

FAR = 60.0


class ScriptedArrivals:
    """Arrivals as they are on a robot, told by the test."""

    def __init__(self, asked: bool = True) -> None:
        self.descriptor = os.eventfd(0, os.EFD_NONBLOCK)
        self.asked = asked

    def come(self) -> None:
        os.eventfd_write(self.descriptor, 1)

    def clear(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.descriptor)


@pytest.fixture
def arrivals() -> Iterator[ScriptedArrivals]:
    scripted = ScriptedArrivals()
    yield scripted
    os.close(scripted.descriptor)


async def ends(waiting: asyncio.Task[None]) -> None:
    await asyncio.wait_for(waiting, 20)


async def test_the_monitor_waits_until_the_deadline(arrivals) -> None:
    schedule = EvaluationSchedule(Wakeups(), arrivals)
    moment = schedule.begin() + 0.05
    await schedule.until(moment)
    assert time.time() >= moment


async def test_a_message_ends_the_wait_before_the_deadline(arrivals) -> None:
    schedule = EvaluationSchedule(Wakeups(), arrivals)
    waiting = asyncio.create_task(schedule.until(schedule.begin() + FAR))
    await asyncio.sleep(0.02)
    assert not waiting.done()
    arrivals.come()
    await ends(waiting)


async def test_frequent_messages_leave_a_minimum_time_between_evaluations(arrivals) -> None:
    schedule = EvaluationSchedule(Wakeups(), arrivals)
    starts = [schedule.begin()]
    for _ in range(10):
        arrivals.come()
        await asyncio.wait_for(schedule.until(starts[-1] + FAR), 20)
        starts.append(schedule.begin())
    assert min(later - earlier for earlier, later in pairwise(starts)) >= APART - 0.001


async def test_a_message_that_was_already_evaluated_causes_no_evaluation(arrivals) -> None:
    schedule = EvaluationSchedule(Wakeups(), arrivals)
    arrivals.come()
    waiting = asyncio.create_task(schedule.until(schedule.begin() + FAR))
    await asyncio.sleep(5 * APART)
    assert not waiting.done()
    waiting.cancel()


async def test_a_wait_that_ended_by_its_deadline_leaves_no_wakeup_behind(arrivals) -> None:
    schedule = EvaluationSchedule(Wakeups(), arrivals)
    started_at = schedule.begin()
    arrivals.come()
    await schedule.until(started_at)  # the moment comes before the pause after the last look is over
    waiting = asyncio.create_task(schedule.until(schedule.begin() + FAR))
    await asyncio.sleep(5 * APART)
    assert not waiting.done()
    waiting.cancel()


@pytest.mark.parametrize("arrivals", [None, ScriptedArrivals(asked=False)])
async def test_without_topics_that_need_wakeups_messages_do_not_end_the_wait(arrivals) -> None:
    wakeups = Wakeups()
    schedule = EvaluationSchedule(wakeups, arrivals)
    waiting = asyncio.create_task(schedule.until(schedule.begin() + FAR))
    if arrivals is not None:
        arrivals.come()
    await asyncio.sleep(5 * APART)
    assert not waiting.done()
    wakeups.evaluation.set()
    await ends(waiting)


async def test_silence_is_not_trusted_after_a_stall(monkeypatch) -> None:
    clock = Clock()
    monkeypatch.setattr(wakeups, "time", clock)
    schedule = EvaluationSchedule(Wakeups(), None)
    for late, trusted in ((0.0, 0.0), (STALLED, 0.0), (0.1, 0.1), (3.0, STALL_MOST)):
        schedule.trusted_from = 0.0
        clock.now = 1000.0
        schedule.begin()
        await schedule.until(clock.now)
        clock.now += late
        found = schedule.begin()
        assert schedule.late == pytest.approx(late)
        assert schedule.trusted_from == (pytest.approx(found + trusted) if trusted else 0.0)


async def test_planned_work_between_evaluations_is_no_stall() -> None:
    schedule = EvaluationSchedule(Wakeups(), None)
    schedule.begin()
    await schedule.until(time.time() - 1.0)
    schedule.restart()
    schedule.begin()
    assert (schedule.late, schedule.trusted_from) == (0.0, 0.0)


@pytest.mark.parametrize("step", [-60.0, 60.0])
async def test_a_clock_that_is_set_while_an_evaluation_runs_changes_neither_the_wait_nor_its_lateness(
    monkeypatch: pytest.MonkeyPatch, step: float
) -> None:
    schedule = EvaluationSchedule(Wakeups(), None)
    moment, began = schedule.begin() + 0.05, time.monotonic()
    set_clock(monkeypatch, step)
    async with asyncio.timeout(5):
        await schedule.until(moment)
    assert time.monotonic() - began >= 0.05
    schedule.begin()
    assert schedule.late < 5


async def test_a_clock_that_is_set_back_does_not_delay_verdicts(monkeypatch: pytest.MonkeyPatch) -> None:
    schedule, clock = EvaluationSchedule(Wakeups(), None), [1_000_000.0]
    monkeypatch.setattr(time, "time", lambda: clock[0])
    schedule.begin()
    await schedule.until(clock[0] - 1)
    schedule.begin()
    assert schedule.trusted_from > clock[0], "it was stalled"
    clock[0] -= 3600
    schedule.restart()
    schedule.begin()
    assert schedule.trusted_from <= clock[0] + STALL_MOST

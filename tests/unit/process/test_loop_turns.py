"""Long turns of an event loop are counted, and work is distinguished from waiting for a processor."""

from __future__ import annotations

import asyncio
import gc
import logging
import time

import pytest
from prometheus_client import CollectorRegistry

from understudy.process import loop_turns
from understudy.process.loop_turns import LONG, LONG_COLLECTION, REPORTED, Turn, TurnTimer


def worked(seconds: float) -> None:
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def test_a_turn_that_works_is_reported_with_its_processor_time() -> None:
    reported: list[Turn] = []

    async def main() -> str:
        await asyncio.sleep(0)
        worked(LONG + 0.02)
        await asyncio.sleep(0)
        return "result"

    assert loop_turns.run(main(), reported.append) == "result"
    assert max(turn.used for turn in reported) >= LONG


def test_time_in_which_the_process_does_not_run_is_no_work() -> None:
    reported: list[Turn] = []

    async def main() -> None:
        await asyncio.sleep(0)
        time.sleep(LONG + 0.05)  # noqa: ASYNC251
        await asyncio.sleep(0)

    loop_turns.run(main(), reported.append)
    longest = max(reported, key=lambda turn: turn.took)
    assert longest.took >= LONG + 0.05
    assert longest.used < LONG


def test_garbage_collection_in_a_turn_is_named() -> None:
    reported: list[Turn] = []
    kept = [[number] for number in range(200_000)]

    async def main() -> None:
        await asyncio.sleep(0)
        gc.collect()
        worked(LONG)
        await asyncio.sleep(0)

    callbacks = list(gc.callbacks)
    loop_turns.run(main(), reported.append)
    assert kept
    longest = max(reported, key=lambda turn: turn.used)
    assert 0 < longest.collected <= longest.used - LONG
    assert gc.callbacks == callbacks


@pytest.mark.parametrize(
    ("generation", "took", "frozen"), [(2, LONG_COLLECTION, True), (2, LONG_COLLECTION / 2, False), (1, 1.0, False)]
)
def test_what_a_long_collection_of_all_objects_leaves_is_exempt_from_later_ones(
    generation: int, took: float, frozen: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = iter((0.0, took))
    monkeypatch.setattr(time, "thread_time", lambda: next(times))
    timer, before = TurnTimer(lambda turn: None), gc.get_freeze_count()
    timer.collection("start", {"generation": generation})
    timer.collection("stop", {"generation": generation})
    try:
        assert (gc.get_freeze_count() > before) == frozen
    finally:
        gc.unfreeze()
        timer.close()


def test_an_idle_loop_is_not_busy() -> None:
    reported: list[Turn] = []
    loop_turns.run(asyncio.sleep(4 * LONG), reported.append)
    assert all(turn.used < LONG for turn in reported)


def test_the_metric_has_both_times_and_a_long_turn_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    registry = CollectorRegistry()
    report = loop_turns.reporter(loop_turns.series(registry))
    with caplog.at_level(logging.INFO):
        report(Turn(0.3, 0.06))
        assert not caplog.records
        report(Turn(0.3, REPORTED, 0.04))
    assert len(caplog.records) == 1

    def count(time: str, le: str) -> float | None:
        return registry.get_sample_value("understudy_event_loop_busy_seconds_bucket", {"time": time, "le": le})

    assert [count("elapsed", le) for le in ("0.1", "0.2", "0.5")] == [0, 0, 2]
    assert [count("processor", le) for le in ("0.05", "0.1", "0.2")] == [0, 2, 2]

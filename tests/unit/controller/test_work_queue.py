"""One worker at a time for each key, nothing lost, nothing done twice for nothing."""

from __future__ import annotations

import asyncio

import pytest

from understudy.controller.runtime.work_queue import Queue


async def drain(queue: Queue[str], wait: float = 0.02) -> list[str]:
    found = []
    while True:
        try:
            key = await asyncio.wait_for(queue.take(), wait)
        except TimeoutError:
            return found
        found.append(key)
        queue.done(key)


async def test_repeated_requests_for_a_key_are_merged() -> None:
    queue: Queue[str] = Queue()
    for key in "aabaab":
        queue.add(key)
    assert await drain(queue) == ["a", "b"]


async def test_a_request_during_the_work_runs_once_more_after_it() -> None:
    queue: Queue[str] = Queue()
    queue.add("a")
    assert await queue.take() == "a"
    queue.add("a")
    queue.add("a")
    assert len(queue) == 0
    queue.done("a")
    assert await drain(queue) == ["a"]


async def test_the_delay_of_retries_grows_until_a_success() -> None:
    queue: Queue[str] = Queue(first_retry=0.1, last_retry=0.5)
    assert [queue.retry("a") for _ in range(5)] == pytest.approx([0.1, 0.2, 0.4, 0.5, 0.5])
    queue.succeeded("a")
    assert queue.retry("a") == pytest.approx(0.1)
    queue.close()


async def test_the_shortest_of_several_delays_counts() -> None:
    queue: Queue[str] = Queue()
    queue.add_after("a", 60)
    queue.add_after("a", 0.01)
    queue.add_after("a", 30)
    assert await drain(queue, 0.1) == ["a"]
    queue.close()


async def test_two_workers_never_process_the_same_key() -> None:
    queue: Queue[int] = Queue()
    busy: set[int] = set()
    keys: list[int] = []

    async def work() -> None:
        while True:
            key = await queue.take()
            assert key not in busy
            busy.add(key)
            await asyncio.sleep(0.001)
            keys.append(key)
            busy.discard(key)
            queue.done(key)

    workers = [asyncio.create_task(work()) for _ in range(4)]
    for _ in range(20):
        for key in range(5):
            queue.add(key)
        await asyncio.sleep(0.001)
    await asyncio.sleep(0.05)
    assert not any(worker.done() for worker in workers)
    assert set(keys) == set(range(5))
    for worker in workers:
        worker.cancel()


async def test_workers_take_keys_in_different_turns_of_the_event_loop() -> None:
    """Each begins with a plan, which computes for up to 20 ms. Eight of them in one turn would delay everything else."""
    queue: Queue[int] = Queue()
    turn, turns = 0, dict[int, int]()

    async def count() -> None:
        nonlocal turn
        while True:
            turn += 1
            await asyncio.sleep(0)

    async def work() -> None:
        while True:
            key = await queue.take()
            turns[key] = turn
            if key % 2:
                await asyncio.sleep(0.001)
            queue.done(key)

    tasks = [asyncio.create_task(one) for one in (count(), *(work() for _ in range(4)))]
    await asyncio.sleep(0.001)
    for key in range(16):
        queue.add(key)
    await asyncio.sleep(0.1)
    assert set(turns) == set(range(16))
    assert len(set(turns.values())) == 16
    for task in tasks:
        task.cancel()

"""Of many candidates one leads; one that can't renew ends before another begins."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from tests.unit.kube.memory import MemoryClient
from understudy.kube.client import ApiError
from understudy.kube.leader_election import LeadershipLost, Lease, Timing

TIMING = Timing(lasts=1.0, renew_within=0.3, every=0.02)


def candidate(client: MemoryClient, identity: str, timing: Timing = TIMING) -> Lease:
    return Lease(client, "system", "operator", identity, timing=timing)


def holder(client: MemoryClient) -> str:
    found: str = client.items["leases", "system", "operator"]["spec"]["holderIdentity"]
    return found


async def test_the_first_candidate_leads() -> None:
    client = MemoryClient()
    lease = candidate(client, "a")
    await asyncio.wait_for(lease.acquire(), 1)
    assert lease.held
    assert holder(client) == "a"


async def test_one_of_many_simultaneous_candidates_leads() -> None:
    client = MemoryClient()
    leases = [candidate(client, str(i)) for i in range(5)]
    tasks = [asyncio.create_task(lease.acquire()) for lease in leases]
    await asyncio.sleep(0.2)
    assert sum(lease.held for lease in leases) == 1
    for task in tasks:
        task.cancel()


async def test_a_renewed_lease_is_not_taken_over() -> None:
    client = MemoryClient()
    first, second = candidate(client, "a"), candidate(client, "b")
    await first.acquire()
    keeping, waiting = asyncio.create_task(first.keep()), asyncio.create_task(second.acquire())
    await asyncio.sleep(1.5)
    assert first.held
    assert not second.held
    keeping.cancel()
    waiting.cancel()


async def test_an_abandoned_lease_is_taken_over_after_it_was_unchanged_for_its_duration() -> None:
    client = MemoryClient()
    first, second = candidate(client, "a"), candidate(client, "b")
    await first.acquire()
    started_at = asyncio.get_running_loop().time()
    await asyncio.wait_for(second.acquire(), 3)
    assert asyncio.get_running_loop().time() - started_at >= TIMING.lasts
    assert holder(client) == "b"
    assert client.items["leases", "system", "operator"]["spec"]["leaseTransitions"] == 1


async def test_the_clock_of_the_holder_does_not_matter() -> None:
    client = MemoryClient()
    first, second = candidate(client, "a"), candidate(client, "b")
    await first.acquire()
    client.items["leases", "system", "operator"]["spec"]["renewTime"] = "1999-01-01T00:00:00.000000Z"
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(second.acquire(), 0.5)


async def test_a_record_in_a_late_answer_is_as_old_as_the_answer_and_not_as_the_request() -> None:
    client, now = MemoryClient(), 0.0
    first = Lease(client, "system", "operator", "a", timing=TIMING, clock=lambda: now)
    second = Lease(client, "system", "operator", "b", timing=TIMING, clock=lambda: now)
    await first.acquire()
    find = client.find

    async def find_late(*names: str) -> dict[str, Any] | None:
        nonlocal now
        now += 0.9  # the holder renews just before the answer
        return await find(*names)

    client.find = find_late  # type: ignore[method-assign,assignment]
    assert not await second._attempt()
    client.find = find  # type: ignore[method-assign]
    now += 0.2
    assert not await second._attempt(), "the record was unchanged for 0.2 s only"


async def test_a_released_lease_is_free_at_once() -> None:
    client = MemoryClient()
    first, second = candidate(client, "a"), candidate(client, "b")
    await first.acquire()
    await first.release()
    assert not first.held
    await asyncio.wait_for(second.acquire(), 0.5)


async def test_a_leader_that_cannot_renew_stops_before_another_may_start() -> None:
    client = MemoryClient()
    lease = candidate(client, "a")
    await lease.acquire()
    started_at = asyncio.get_running_loop().time()
    client.failing = lambda method, name: ApiError(503, "ServiceUnavailable", "away")
    with pytest.raises(LeadershipLost, match="was not renewed"):
        await asyncio.wait_for(lease.keep(), 2)
    assert asyncio.get_running_loop().time() - started_at < TIMING.lasts
    assert not lease.held


async def test_a_leader_whose_requests_hang_stops_too() -> None:
    client = MemoryClient()
    lease = candidate(client, "a")
    await lease.acquire()

    async def hang(*_: object) -> None:
        await asyncio.sleep(60)

    client.get = hang  # type: ignore[assignment,method-assign]
    with pytest.raises(LeadershipLost):
        await asyncio.wait_for(lease.keep(), 2)


async def test_a_short_outage_is_survived() -> None:
    client, now, refused = MemoryClient(), 0.0, 0
    lease = Lease(client, "system", "operator", "a", timing=TIMING, clock=lambda: now)
    await lease.acquire()

    def away(method: str, name: str) -> ApiError | None:
        nonlocal now, refused
        now += 0.06
        if now > 0.25:
            return None
        refused += 1
        return ApiError(503, "ServiceUnavailable", "away")

    client.failing = away
    keeping = asyncio.create_task(lease.keep())
    async with asyncio.timeout(20):
        while now < 1.0 and not keeping.done():
            await asyncio.sleep(0.01)
    assert refused == 4
    assert lease.held
    assert not keeping.done()
    keeping.cancel()


async def test_a_leader_whose_lease_was_taken_stops_at_once() -> None:
    client = MemoryClient()
    lease = candidate(client, "a")
    await lease.acquire()
    client.items["leases", "system", "operator"]["spec"]["holderIdentity"] = "b"
    with pytest.raises(LeadershipLost, match="taken over"):
        await asyncio.wait_for(lease.keep(), 0.2)

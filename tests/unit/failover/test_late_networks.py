"""After an outage of the API server the engines of the network hear of the gate later than the monitor writes it."""

from __future__ import annotations

import asyncio
import re
from dataclasses import replace

import pytest

from tests.unit.failover.recoveries import VERIFY_WITHIN, choices, failure, protected
from tests.unit.failover.world import Leak, Store, World
from understudy.failover.protocol import recover
from understudy.failover.strategies import steps
from understudy.failover.strategies.base import Choice
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.restart import Restart

OUTAGE = 4.0
"""Seconds of the outage of the API server, which has just ended."""


def after_an_outage() -> tuple[Store, World]:
    """A standby that runs in full, and that the network does not let through."""
    store = protected(pool="hot")
    store.broken.add("w-2")
    world = World(store)
    store.last_outage = (world.clock() - OUTAGE, world.clock())
    return store, world


async def test_a_network_that_follows_late_after_an_outage_fails_no_standby() -> None:
    store, world = after_an_outage()
    asyncio.get_running_loop().call_later(4 * VERIFY_WITHIN, store.broken.clear)
    done = await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), world.context())
    [attempt] = done.attempts
    assert (attempt.pod, attempt.result) == ("w-2", "Verified")
    assert re.fullmatch(
        "the network did not follow the gate for [0-9.]+ s after the API server was back", attempt.message
    )


async def test_a_standby_whose_packets_pass_has_no_more_time() -> None:
    store, world = after_an_outage()
    store.probes_through["uid-w-2"] = Leak(0.001, world.clock())
    done = await recover(failure(world), choices(ExecutingFallback("hot")), world.context())
    [attempt] = done.attempts
    assert attempt.result == "NotVerified"
    assert "the network did not follow" not in attempt.message


async def test_a_standby_that_is_no_longer_ready_has_no_more_time() -> None:
    store, world = after_an_outage()
    unready = replace(store.pods["w-2"], ready=False)
    asyncio.get_running_loop().call_later(VERIFY_WITHIN / 4, store.pods.__setitem__, "w-2", unready)
    done = await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), world.context())
    assert [attempt.result for attempt in done.attempts] == ["NotVerified", "Verified"]


@pytest.mark.parametrize("outage", [0.1, 100.0])
async def test_the_network_has_so_much_time_and_no_more(monkeypatch: pytest.MonkeyPatch, outage: float) -> None:
    monkeypatch.setattr(steps, "LATE_BY", 2 * VERIFY_WITHIN)
    monkeypatch.setattr(steps, "LATE_FACTOR", 1.0)
    monkeypatch.setattr(steps, "LATE_AT_MOST", 3 * VERIFY_WITHIN)
    store, world = after_an_outage()
    began = world.clock()
    store.last_outage = (began - outage, began)
    done = await recover(failure(world), choices(ExecutingFallback("hot")), world.context())
    assert done.result == "Failed"
    may_be_late = min(3 * VERIFY_WITHIN, 2 * VERIFY_WITHIN + outage)
    assert may_be_late <= world.clock() - began
    assert re.search("the network did not follow the gate for .* which do not count$", done.attempts[0].message)


async def test_a_gate_that_is_closed_late_after_an_outage_is_waited_for() -> None:
    store = protected(pool="hot")
    world = World(store)
    store.last_outage = (world.clock() - OUTAGE, world.clock())
    store.probes_through["uid-w-1"] = Leak(0.01, world.clock(), until=world.clock() + 0.6)
    first = Choice(ExecutingFallback("hot", breaks_first=True), 0.3)
    done = await recover(failure(world), [first, Choice(Restart(), 5.0)], world.context())
    assert [(attempt.pod, attempt.result) for attempt in done.attempts] == [("w-2", "Verified")]

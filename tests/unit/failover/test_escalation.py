"""Crash-looping applications: another strategy is tried, early, and after the last one comes a backoff."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest

from tests.unit.failover.recoveries import VERIFY_WITHIN, failure, protected
from tests.unit.failover.world import Store, World
from understudy.failover.limits.escalation import Takeover, first_strategy
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.protocol import recover
from understudy.failover.strategies.base import Choice
from understudy.failover.strategies.restart import Restart
from understudy.failover.strategies.uninitialized import UninitializedFallback

LONG = 60.0
DELAY = 2.0
"""Seconds for which an instance must be healthy to count as recovered."""


def recovered(index: int, *, uid: str = "uid-2", at: float = 100.0) -> Progress:
    progress = Progress.begin("it ended", last_healthy=at - 1, detected=at - 1)
    progress.index, progress.result = index, "Recovered"
    progress.target = PodIdentity(name="w-2", uid=uid)
    progress.moments["verified"] = at
    return progress


@pytest.mark.parametrize(
    ("index", "uid", "onset", "expected"),
    [
        (0, "uid-2", 100.0 + DELAY / 2, 1),
        (1, "uid-2", 101.0, None),
        (0, "uid-2", 100.0 + DELAY, 0),
        (0, "uid-3", 101.0, 0),
    ],
    ids=["next strategy", "none after the last one", "healthy for long enough", "another instance"],
)
def test_an_instance_that_fails_right_after_its_takeover_causes_the_next_strategy(
    index: int, uid: str, onset: float, expected: int | None
) -> None:
    latest = Takeover.of(recovered(index))
    assert first_strategy(latest, uid, onset, 2, healthy_delay=DELAY) == expected


def test_a_failed_recovery_does_not_skip_a_strategy() -> None:
    latest = Takeover.of(recovered(0).model_copy(update={"result": "Failed"}))
    assert latest is None
    assert first_strategy(latest, "uid-2", 101.0, 2, healthy_delay=DELAY) == 0


def test_a_flapping_application_causes_each_strategy_in_turn_until_it_stays_healthy() -> None:
    delay = 60.0
    latest = Takeover.of(recovered(0, uid="uid-2", at=100.0))
    assert latest is not None
    assert latest.lived("uid-2", 130.0) == 30.0
    assert latest.lived("uid-3", 130.0) is None
    assert first_strategy(latest, "uid-2", 130.0, 3, healthy_delay=delay) == 1
    latest = Takeover.of(recovered(1, uid="uid-3", at=140.0))
    assert first_strategy(latest, "uid-3", 199.9, 3, healthy_delay=delay) == 2
    latest = Takeover.of(recovered(2, uid="uid-4", at=210.0))
    assert first_strategy(latest, "uid-4", 210.0 + delay, 3, healthy_delay=delay) == 0, "that one has worked"


def crash_looping(name: str, store: Store) -> None:
    store.pods[name] = replace(store.pods[name], crashing=True, ready=False)


async def test_a_crash_looping_standby_is_abandoned_early() -> None:
    store = protected(pool="spare", held=True)
    store.broken.add("w-2")
    world = World(store)
    asyncio.get_running_loop().call_later(0.2, crash_looping, "w-2", store)
    started_at = world.clock()
    strategies = [Choice(UninitializedFallback("spare"), LONG), Choice(Restart(), VERIFY_WITHIN)]
    done = await recover(failure(world), strategies, world.context())
    assert (done.result, done.strategy) == ("Recovered", "Restart")
    assert done.attempts[0].message == "a container of pod w-2 is crash-looping"
    assert world.clock() - started_at < LONG / 3


async def test_the_last_strategy_has_its_full_timeout() -> None:
    store = protected(pool="spare", held=True)
    store.broken.add("w-2")
    world = World(store)
    asyncio.get_running_loop().call_later(0.1, crash_looping, "w-2", store)
    done = await recover(failure(world), [Choice(UninitializedFallback("spare"), 0.5)], world.context())
    assert done.result == "Failed"
    assert "not verified within 0.5 s" in done.attempts[0].message


async def test_a_restart_replaces_a_crash_looping_pod() -> None:
    store = protected()
    store.add("w-2", crashing=True, ready=False)
    store.broken.add("w-2")
    world = World(store)
    done = await recover(failure(world), [Choice(Restart(), VERIFY_WITHIN)], world.context())
    assert done.result == "Recovered"
    assert set(store.deleted) == {"w-1", "w-2"}
    assert done.target is not None
    assert done.target.name.startswith("w-new")

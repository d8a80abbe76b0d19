"""An understudy on a lost node, which Kubernetes reports only some time later, does not use up a recovery's time."""

from __future__ import annotations

import asyncio

import pytest

from tests.unit.failover.recoveries import choices, failure, protected
from tests.unit.failover.world import Store, World
from understudy.failover.protocol import recover
from understudy.failover.strategies.base import Choice
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.initialized import InitializedFallback
from understudy.failover.strategies.restart import Restart
from understudy.failover.strategies.uninitialized import UninitializedFallback

SLOW = 0.9
"""A strategy's time in seconds. An agent must answer within a third of it."""


def held(*places: str) -> Store:
    """A failed pod on node a, and held pods on these nodes."""
    store = protected()
    store.add("w-1", node="a")
    for number, place in enumerate(places, start=2):
        store.add(f"w-{number}", pool="spare", held=True, node=place)
    return store


@pytest.mark.parametrize("places", [("a", "b"), ("b", "a")])
async def test_a_held_pod_on_another_node_than_the_failed_instance_is_claimed_first(places: tuple[str, str]) -> None:
    store = held(*places)
    world = World(store)
    done = await recover(failure(world), choices(UninitializedFallback("spare")), world.context())
    assert done.target is not None
    assert store.pods[done.target.name].node == "b"


@pytest.mark.parametrize("strategy", [ExecutingFallback("hot"), InitializedFallback("hot")])
@pytest.mark.parametrize("places", [("a", "b"), ("b", "a")])
async def test_a_standby_on_another_node_than_the_failed_instance_comes_first(
    strategy: ExecutingFallback, places: tuple[str, str]
) -> None:
    store = protected()
    store.add("w-1", node="a")
    for number, place in enumerate(places, start=2):
        store.add(f"w-{number}", pool="hot", node=place)
    world = World(store)
    done = await recover(failure(world), choices(strategy), world.context())
    assert done.target is not None
    assert store.pods[done.target.name].node == "b"


@pytest.mark.parametrize("strategy", [ExecutingFallback("hot"), InitializedFallback("hot")])
async def test_a_standby_that_kubernetes_reports_as_not_ready_comes_last(strategy: ExecutingFallback) -> None:
    store = protected()
    store.add("w-2", pool="hot", ready=False)
    store.add("w-3", pool="hot")
    store.answering |= {"w-2"}
    world = World(store)
    done = await recover(failure(world), choices(strategy), world.context())
    assert done.target is not None
    assert done.target.name == "w-3"


async def test_a_claimed_pod_whose_agent_does_not_answer_is_given_up_for_one_on_another_node() -> None:
    store = held("b", "b", "c")
    store.silent |= {"w-2", "w-3"}
    world = World(store)
    began = world.clock()
    done = await recover(failure(world), [Choice(UninitializedFallback("spare"), SLOW)], world.context())
    assert (done.result, done.target and done.target.name) == ("Recovered", "w-4")
    assert world.clock() - began < SLOW / 2
    assert set(store.deleted) & {"w-2", "w-3"}, "the claimed pod is not kept"


async def test_at_most_two_pods_are_claimed_because_the_monitor_may_be_cut_off() -> None:
    store = held("b", "c", "d", "e")
    store.silent |= {"w-2", "w-3", "w-4", "w-5"}
    world = World(store)
    began = world.clock()
    slow = [Choice(UninitializedFallback("spare"), SLOW), *choices(Restart())]
    done = await recover(failure(world), slow, world.context())
    assert (done.result, done.strategy) == ("Recovered", "Restart")
    assert "agent" in done.attempts[0].message
    assert len(store.claims) == 2
    assert world.clock() - began < SLOW


async def test_the_last_held_pod_is_given_up_for_the_next_strategy() -> None:
    store = held("b")
    store.silent.add("w-2")
    world = World(store)
    slow = [Choice(UninitializedFallback("spare"), SLOW), *choices(Restart())]
    done = await recover(failure(world), slow, world.context())
    assert (done.result, done.strategy) == ("Recovered", "Restart")
    assert (done.attempts[0].result, done.attempts[0].pod) == ("NotVerified", "w-2")


async def test_time_in_which_the_api_server_does_not_answer_gives_up_no_claimed_pod() -> None:
    store = held("b", "c")
    store.silent |= {"w-2", "w-3"}
    world = World(store)
    loop = asyncio.get_running_loop()
    slow = [Choice(UninitializedFallback("spare"), SLOW)]

    def fail() -> None:
        store.away = True

    def answer() -> None:
        store.away = False
        store.silent.clear()

    loop.call_later(SLOW / 9, fail)
    loop.call_later(SLOW, answer)
    done = await recover(failure(world), slow, world.context())
    assert done.result == "Recovered"
    assert len(store.claims) == 1

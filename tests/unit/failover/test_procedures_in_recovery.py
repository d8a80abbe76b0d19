"""Recoveries with a procedure: what is done to which instance behind the closed gate, and what its failure comes to."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.support.golden import assert_golden
from tests.unit.failover.recoveries import choices, failure, protected
from tests.unit.failover.world import Killed, World
from understudy.api.kinds.procedure_spec import Procedure
from understudy.api.protocol.kept_state import KeptSample, KeptState
from understudy.failover.bring_up import BringUp
from understudy.failover.protocol import recover
from understudy.failover.strategies.base import Choice
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.initialized import InitializedFallback
from understudy.failover.strategies.restart import Restart
from understudy.failover.strategies.uninitialized import UninitializedFallback

ACTIVATE = Procedure(yaml={"set_lifecycle": {"node": "/amcl", "state": "active"}}, within="10s")
RESTORING = Procedure(yaml={"sequence": [{"restore_state": {}}, ACTIVATE.yaml]})


def bring_up(name: str = "bringUp", procedure: Procedure = ACTIVATE) -> BringUp:
    found = BringUp.of(name, procedure)
    assert found is not None
    return found


def test_a_procedure_that_restores_state_is_recognized() -> None:
    assert bring_up("recovery", RESTORING).restores_state
    assert not bring_up().restores_state
    assert BringUp.of("recovery", None) is None


def test_equal_procedures_in_two_languages_have_the_same_digest() -> None:
    text = 'import osc.understudy\nscenario up:\n    do set_lifecycle("/amcl", lifecycle_state!active)\n'
    written = bring_up(procedure=Procedure(osc=text, within="10s"))
    assert (written.tree, written.digest) == (bring_up().tree, bring_up().digest)
    assert written.places == {"set_lifecycle": "line 3, column 8: set_lifecycle()"}
    assert not written.problem
    broken = bring_up(procedure=Procedure(osc=text.replace("active", "asleep")))
    assert_golden("failover", broken.problem, "line 3, column 31", "set_lifecycle", "lifecycle_state!asleep")


async def test_an_initialized_standby_is_brought_up_behind_a_closed_gate() -> None:
    store = protected(pool="warm")
    world = World(store)
    done = await recover(failure(world), choices(InitializedFallback("warm", recovery=bring_up())), world.context())
    assert (done.result, done.strategy) == ("Recovered", "Fallback/Initialized")
    assert store.commits == ["", "w-2"]
    assert store.brought_up == [("w-2", "bringUp")]
    assert store.deleted == ["w-1"]


async def test_an_initialized_standby_has_no_startup_time() -> None:
    """The paper: t_startup ends when processes are up, and those were; what is left is re-initialization."""
    world = World(protected(pool="warm"))
    done = await recover(failure(world), choices(InitializedFallback("warm", recovery=bring_up())), world.context())
    assert done.parts.get("startup", 0.0) == 0.0
    assert done.parts["reinitialization"] > 0.0
    assert sum(done.parts.values()) == pytest.approx(done.moments["routed"] - done.moments["last_healthy"], abs=1e-6)


async def test_an_initialized_standby_can_take_over_without_a_procedure() -> None:
    store = protected(pool="warm")
    world = World(store)
    done = await recover(failure(world), choices(InitializedFallback("warm")), world.context())
    assert done.result == "Recovered"
    assert store.commits == ["", "w-2"], "a standby that was not driving is never routed straight away"
    assert store.brought_up == []


async def test_a_started_instance_is_brought_up_and_the_time_counts_as_reinitialization() -> None:
    for strategy, pod in (
        (UninitializedFallback("spare", recovery=bring_up()), "w-2"),
        (Restart(recovery=bring_up()), "w-new1"),
    ):
        store = protected(pool="spare", held=True)
        world = World(store)
        done = await recover(failure(world), choices(strategy), world.context())
        assert done.result == "Recovered"
        assert store.brought_up == [(pod, "bringUp")]
        assert done.parts["startup"] > 0.0
        assert done.parts["reinitialization"] > 0.0


async def test_an_executing_standby_runs_a_procedure_only_if_the_policy_has_one() -> None:
    store = protected(pool="hot")
    world = World(store)
    await recover(failure(world), choices(ExecutingFallback("hot")), world.context())
    assert store.commits == ["w-2"]
    store = protected(pool="hot")
    world = World(store)
    await recover(failure(world), choices(ExecutingFallback("hot", recovery=bring_up("recovery"))), world.context())
    assert store.commits == ["", "w-2"]
    assert store.brought_up == [("w-2", "recovery")]


async def test_a_failed_procedure_is_reported_with_its_leaf_and_the_next_strategy_is_tried() -> None:
    store = protected(pool="warm")
    store.unwilling.add("w-2")
    world = World(store)
    tried = choices(InitializedFallback("warm", recovery=bring_up()), Restart())
    done = await recover(failure(world), tried, world.context())
    assert (done.result, done.strategy) == ("Recovered", "Restart")
    assert done.attempts[0].result == "NotVerified"
    assert_golden("failover", done.attempts[0].message, "w-2", "bringUp.set_lifecycle", "/amcl")
    assert {"w-1", "w-2"} <= set(store.deleted)


async def test_a_procedure_that_never_ends_is_stopped_in_time_to_report_its_leaf() -> None:
    store = protected(pool="warm")
    store.endless.add("w-2")
    world = World(store)
    endless = BringUp.of("bringUp", Procedure(yaml={"wait_for": {"node": "/nobody"}}))
    assert endless is not None
    assert endless.within == 60.0, "the bound where the policy gives none"
    tried = [Choice(InitializedFallback("warm", recovery=endless), 2.0), *choices(Restart())]
    done = await recover(failure(world), tried, world.context())
    assert (done.result, done.strategy) == ("Recovered", "Restart")
    assert done.attempts[0].message == "bringUp.wait_for: node /nobody is not there"


async def test_standbys_of_another_readiness_are_not_used() -> None:
    store = protected(pool="hot")
    store.add("w-3", pool="warm")
    world = World(store)
    warm = InitializedFallback("warm", recovery=bring_up(), others=["hot"])
    done = await recover(failure(world), choices(warm), world.context())
    assert done.target is not None
    assert done.target.name == "w-3"
    store = protected(pool="hot")
    world = World(store)
    done = await recover(failure(world), choices(InitializedFallback("warm", others=["hot"])), world.context())
    assert done.attempts[0].message == "pool warm has no standby for this workload"


async def test_a_pod_of_the_workload_controller_is_a_standby_only_of_the_first_pool() -> None:
    store = protected()
    store.add("w-2")
    world = World(store)
    assert InitializedFallback("warm").available(world.context()) is None
    assert InitializedFallback("warm", with_source=False).available(world.context()) is not None


@pytest.mark.parametrize("procedure", [ACTIVATE, RESTORING])
async def test_state_is_restored_before_the_procedure_unless_the_procedure_restores_it(procedure: Procedure) -> None:
    store = protected(pool="warm")
    world = World(store)
    kept = KeptState(samples=(KeptSample("/amcl_pose", "a/msg/B", 0.0, b"x", to="/initialpose"),))
    context = replace(world.context(), kept=lambda onset: kept)
    done = await recover(
        failure(world), choices(InitializedFallback("warm", recovery=bring_up("r", procedure))), context
    )
    assert done.result == "Recovered"
    messages = [(entry.name, entry.message) for entry in done.state]
    if procedure is RESTORING:
        assert messages == [("/amcl_pose", "not tried")], "the agent's report of the tree's own leaf"
    else:
        assert messages != [("/amcl_pose", "not tried")]


@pytest.mark.parametrize("dies_after", range(14))
async def test_a_bring_up_interrupted_at_any_step_is_finished_by_the_next_monitor(dies_after: int) -> None:
    store = protected(pool="warm")
    world = World(store, dies_after=dies_after)
    # Long, since the first of them must verify however busy the machine is.
    strategies = [Choice(s, 20.0) for s in (InitializedFallback("warm", recovery=bring_up()), Restart())]
    progress = failure(world)
    try:
        await recover(progress, strategies, world.context())
    except Killed:
        again = World(store)
        committed = store.gate.recovery
        kept = store.journal or (committed.model_copy(deep=True) if committed else failure(again))
        await recover(kept, strategies, again.context())
    assert store.gate.active == "w-2"
    assert "w-1" in store.deleted
    assert {name for name, _ in store.brought_up} == {"w-2"}

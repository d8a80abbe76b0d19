"""Which instance is brought where, and when a standby counts as ready."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.unit.monitor.cluster_objects import parsed_spec, policy_of
from tests.unit.monitor.readiness import ACTIVE, CHECK, HOT, SOURCE, STANDBY, UP, WARM, XML_CHECK, settings
from understudy.api.kinds.procedure_spec import Check
from understudy.api.protocol.monitor_settings import PoolChoice
from understudy.failover.interfaces import Instance
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.initialized import InitializedFallback
from understudy.failover.strategies.registry import choices
from understudy.failover.strategies.restart import Restart
from understudy.monitor.observe.instance_roles import Role, managed, role_of


def test_without_procedures_only_the_health_tree_counts() -> None:
    for instance in (ACTIVE, SOURCE, replace(STANDBY, pool="hot")):
        assert role_of(instance, parsed_spec(), settings(HOT), active_uid="uid-1") == Role()


def test_a_standby_of_an_initialized_pool_is_initialized_and_checked() -> None:
    found = role_of(STANDBY, parsed_spec(bringUp=UP), settings(WARM), active_uid="uid-1")
    assert found.procedure is not None
    assert (found.procedure.name, found.procedure.within) == ("initialization", 7.0)
    assert found.brought.startswith("init:")
    assert found.standby == {"brought": found.brought, "tree": False, "check": CHECK.yaml, "period": 2.0}


def test_a_restarted_container_is_initialized_again() -> None:
    first, again = (
        role_of(replace(STANDBY, restarts=restarts), parsed_spec(), settings(WARM), active_uid="uid-1").brought
        for restarts in (0, 1)
    )
    assert first != again


def test_an_own_pod_that_is_not_active_has_the_role_of_the_first_pool() -> None:
    pools = settings(PoolChoice(name="spare", readiness="Uninitialized"), WARM, HOT)
    assert role_of(SOURCE, parsed_spec(bringUp=UP), pools, active_uid="uid-1").procedure.name == "initialization"


def test_the_first_instance_is_brought_up_before_it_is_ready() -> None:
    for pools in (settings(), settings(WARM)):
        found = role_of(SOURCE, parsed_spec(bringUp=UP), pools, active_uid="")
        assert found.procedure is not None
        assert found.procedure.name == "bringUp"
        assert found.brought.startswith("up:")
        assert found.standby == {"brought": found.brought}


def test_an_executing_standby_is_initialized_by_the_bring_up_and_judged_by_its_health_tree() -> None:
    standby = replace(STANDBY, pool="hot")
    found = role_of(standby, parsed_spec(bringUp=UP), settings(HOT), active_uid="uid-1")
    assert found.procedure is not None
    assert found.procedure.name == "bringUp"
    assert found.standby == {"brought": found.brought, "tree": True}


def test_an_active_instance_that_was_not_brought_up_is_brought_up() -> None:
    spec = parsed_spec(bringUp=UP)
    assert role_of(ACTIVE, spec, settings(WARM), active_uid="uid-1").procedure is not None
    assert role_of(ACTIVE, spec, settings(WARM), active_uid="uid-1", brought="up:x:0").procedure is None
    took_over = replace(STANDBY, uid="uid-1")
    assert role_of(took_over, spec, settings(WARM), active_uid="uid-1", brought="init:x:0").procedure is not None
    executing = replace(took_over, pool="hot")
    assert role_of(executing, spec, settings(HOT), active_uid="uid-1", brought="init:x:0").procedure is None
    assert role_of(ACTIVE, spec, settings(WARM), active_uid="uid-1").standby is None


def test_a_claimed_pod_has_no_role_besides_its_strategy() -> None:
    claimed = Instance("s-1", "uid-4", pool="spare", claim="u/1", running=True)
    pools = settings(PoolChoice(name="spare", readiness="Uninitialized"))
    assert role_of(claimed, parsed_spec(bringUp=UP), pools, active_uid="") == Role()


def test_a_workload_with_a_procedure_is_managed() -> None:
    assert not managed(parsed_spec(), settings(HOT), policy_of())
    assert managed(parsed_spec(bringUp=UP), settings(), policy_of())
    assert managed(parsed_spec(), settings(WARM), policy_of())
    assert managed(parsed_spec(), settings(), policy_of({"type": "Restart", "recovery": UP}))


def test_strategies_bring_up_instances_that_do_not_execute_yet() -> None:
    fallback = {"type": "Fallback", "poolRef": {"name": "warm"}}
    hot = {"type": "Fallback", "poolRef": {"name": "hot"}}
    restart = {"type": "Restart", "recovery": {"yaml": {"resend_goals": {}}}}
    found = choices(policy_of(fallback, hot, restart), settings(WARM, HOT), parsed_spec(bringUp=UP))
    warm, executing, again = (choice.strategy for choice in found)
    assert isinstance(warm, InitializedFallback)
    assert warm.recovery.name == "bringUp"
    assert type(executing) is ExecutingFallback
    assert executing.recovery is None, "it drives already"
    assert not executing.with_source, "what the controller makes waits in the first pool"
    assert isinstance(again, Restart)
    assert again.recovery.name == "strategies[2].recovery", "instead of the workload's bringUp"


def test_an_active_instance_whose_procedure_has_failed_is_brought_up() -> None:
    active, full = replace(ACTIVE, pool="hot"), settings(HOT)
    for brought, drives in (("init:1:0", True), ("begun:init:1:0", False), ("", False)):
        found = role_of(active, parsed_spec(bringUp=UP), full, active_uid="uid-1", brought=brought)
        assert (found.procedure is None) == drives


@pytest.mark.parametrize("before", ["init:other:0", ""])
def test_a_ready_standby_with_an_outdated_procedure_stays_as_it_is(before: str) -> None:
    found = role_of(STANDBY, parsed_spec(), settings(WARM), active_uid="uid-1", brought=before, ready=True)
    assert (found.brought, found.outdated) == (before, True)
    assert found.standby is not None
    assert found.standby["brought"] == before
    assert not role_of(STANDBY, parsed_spec(), settings(WARM), active_uid="uid-1", brought=before).outdated


@pytest.mark.parametrize("before", ["up:other:0", "init:other:1", "begun:init:other:0"])
def test_a_standby_brought_up_otherwise_or_restarted_is_initialized(before: str) -> None:
    found = role_of(STANDBY, parsed_spec(), settings(WARM), active_uid="uid-1", brought=before, ready=True)
    assert found.brought.startswith("init:")
    assert (found.brought == before, found.outdated) == (False, False)


def test_agents_receive_a_check_in_the_short_form_in_any_language() -> None:
    pool = WARM.model_copy(update={"readiness_check": Check(xml=XML_CHECK, period="2s")})
    found = role_of(STANDBY, parsed_spec(), settings(pool), active_uid="uid-1")
    assert found.standby == {
        "brought": found.brought,
        "tree": False,
        "check": CHECK.yaml,
        "period": 2.0,
        "places": {"lifecycle_is": "line 3, column 1: <LifecycleIs>"},
    }


def test_an_unreadable_check_is_passed_to_the_agent() -> None:
    pool = WARM.model_copy(update={"readiness_check": Check(xml="<root/>")})
    found = role_of(STANDBY, parsed_spec(), settings(pool), active_uid="uid-1")
    assert found.standby is not None
    assert found.standby["check"] == "<root/>"

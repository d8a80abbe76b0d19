"""Workloads that depend on each other: whose failure is acted on, and what is done in which order once one was recovered."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from tests.unit.failover.world import Killed, Store, World
from understudy.api.kinds.procedure_spec import Procedure
from understudy.api.kinds.robot_workload import Dependency, DependencyRecovery, Recovery, RobotWorkloadStatus
from understudy.api.protocol.monitor_settings import Upstream
from understudy.failover.bring_up import BringUp
from understudy.failover.dependency import DueReaction, HeldFailure, Outage, Recovered, UpstreamState, due, held, outage
from understudy.failover.interfaces import GateState
from understudy.failover.limits.escalation import Takeover, first_strategy
from understudy.failover.progress import PodIdentity, Progress, rfc3339
from understudy.failover.protocol import recover
from understudy.failover.strategies.base import Choice, Strategy
from understudy.failover.strategies.reinitialize import Reinitialize
from understudy.failover.strategies.restart import Restart

NOW = 1_700_000_000.0


def needs(name: str = "localization", **more: Any) -> Dependency:
    times = {"noticeWithin": "300ms", "settleWithin": "10s", "waitFor": "2m"}
    return Dependency.model_validate({"name": name, **times, **more})


def recovered(
    id: str = "r1", *, onset: float = NOW - 5, verified: float = NOW - 2, result: str = "Recovered"
) -> Recovery:
    progress = Progress.begin("it fell silent", last_healthy=onset, detected=onset + 0.5)
    progress.id, progress.result = id, result  # type: ignore[assignment]
    progress.moments["verified"] = verified
    return progress.to_recovery(1)


def committed(id: str = "r2", *, onset: float = NOW - 0.5, result: str = "Running") -> Progress:
    progress = Progress.begin("it fell silent", last_healthy=onset, detected=onset + 0.5)
    progress.id, progress.result = id, result  # type: ignore[assignment]
    return progress


class TestUpstreamState:
    def test_the_gate_shows_a_failure_before_the_status(self) -> None:
        observed = UpstreamState.of(RobotWorkloadStatus(health="Healthy", recoveries=[recovered()]), committed())
        assert observed.failing
        assert observed.failing_since == pytest.approx(NOW - 0.5)

    def test_a_recovery_in_the_status_has_ended_whatever_the_gate_records(self) -> None:
        status = RobotWorkloadStatus(health="Healthy", recoveries=[recovered("r2")])
        assert not UpstreamState.of(status, committed("r2")).failing

    def test_a_recovery_at_the_gate_that_is_older_than_those_in_the_status_has_ended(self) -> None:
        status = RobotWorkloadStatus(health="Healthy", recoveries=[recovered("r3")])
        assert not UpstreamState.of(status, committed("r1", onset=NOW - 60)).failing

    def test_a_failed_recovery_at_the_gate_of_a_healthy_workload_has_ended(self) -> None:
        assert not UpstreamState.of(RobotWorkloadStatus(health="Healthy"), committed(result="Failed")).failing

    def test_the_status_reports_when_a_failure_began_that_is_not_acted_on(self) -> None:
        observed = UpstreamState.of(RobotWorkloadStatus(health="Failed", failing_since=rfc3339(NOW - 1)), None)
        assert observed.failing
        assert observed.failing_since == pytest.approx(NOW - 1)

    @pytest.mark.parametrize(("health", "failing"), [("Degraded", False), ("Unknown", False), ("Starting", True)])
    def test_a_degraded_dependency_is_usable_and_a_starting_one_is_not(self, health: Any, failing: bool) -> None:
        assert UpstreamState.of(RobotWorkloadStatus(health=health), None).failing == failing

    def test_a_dependency_without_data_is_not_failing(self) -> None:
        assert not UpstreamState().failing


def last(id: str = "r1", onset: float = NOW - 5, end: float | None = NOW - 2) -> Recovered:
    return Recovered(id, onset, end)


class TestOutages:
    def test_an_outage_lasts_from_the_last_healthy_output_until_the_recovery_is_verified(self) -> None:
        began = outage(None, UpstreamState("Failed", NOW - 5), NOW - 4)
        assert began == Outage(NOW - 5)
        assert outage(began, UpstreamState("Healthy", last=last()), NOW) == Outage(NOW - 5, NOW - 2)

    def test_an_outage_that_ended_before_it_was_observed_is_recorded(self) -> None:
        """An executing standby takes over in milliseconds, and its monitor writes the status once."""
        assert outage(None, UpstreamState("Healthy", last=last()), NOW) == Outage(NOW - 5, NOW - 2)
        before = Outage(NOW - 50, NOW - 45)
        assert outage(before, UpstreamState("Healthy", last=last()), NOW) == Outage(NOW - 5, NOW - 2)

    def test_an_outage_without_a_recovery_ends_when_the_dependency_is_healthy(self) -> None:
        assert outage(Outage(NOW - 5), UpstreamState("Healthy"), NOW) == Outage(NOW - 5, NOW)
        older = UpstreamState("Healthy", last=last("r0", NOW - 90, NOW - 80))
        assert outage(Outage(NOW - 5), older, NOW) == Outage(NOW - 5, NOW)

    def test_an_outage_continues_through_all_recovery_attempts(self) -> None:
        assert outage(Outage(NOW - 5), UpstreamState("Starting"), NOW) == Outage(NOW - 5)
        assert outage(Outage(NOW - 5), UpstreamState("Recovering", NOW - 1), NOW) == Outage(NOW - 5)

    def test_an_outage_with_an_unknown_begin_precedes_every_failure(self) -> None:
        assert outage(None, UpstreamState("Starting"), NOW) == Outage(-math.inf)

    def test_a_healthy_dependency_without_failures_has_no_outage(self) -> None:
        assert outage(None, UpstreamState("Healthy"), NOW) is None
        assert outage(None, UpstreamState("Healthy", last=last(end=None)), NOW) is None


def held_at(now: float, *dependencies: Dependency, onset: float = NOW, **outages: Outage) -> HeldFailure | None:
    """Of a failure that was noticed half a second after its last healthy output."""
    return held(onset, onset + 0.5, now, depends_on=dependencies or (needs(),), outages=outages)


class TestHeldFailures:
    def test_a_failure_without_dependencies_is_not_held(self) -> None:
        assert held(NOW, NOW, NOW, depends_on=[], outages={}) is None

    def test_a_failure_is_held_briefly_to_notice_an_earlier_one(self) -> None:
        assert held_at(NOW + 0.5) == HeldFailure(NOW + 0.8)
        assert held_at(NOW + 0.81) is None

    def test_a_failure_that_follows_the_outage_of_a_dependency_is_held_during_the_outage(self) -> None:
        found = held_at(NOW + 30, localization=Outage(NOW - 0.05))
        assert found == HeldFailure(NOW + 120.5, "localization")

    def test_a_failure_is_held_for_a_bounded_time(self) -> None:
        assert held_at(NOW + 121, localization=Outage(NOW - 0.05)) is None

    def test_a_failure_that_precedes_the_outage_of_a_dependency_is_not_held(self) -> None:
        assert held_at(NOW + 1, localization=Outage(NOW + 0.2)) is None

    def test_small_clock_differences_between_nodes_are_tolerated(self) -> None:
        found = held_at(NOW + 1, localization=Outage(NOW + 0.08))
        assert found is not None
        assert found.name == "localization"

    def test_after_the_dependency_is_healthy_a_failure_is_held_for_the_settling_time(self) -> None:
        over = Outage(NOW - 1, NOW + 5)
        assert held_at(NOW + 6, localization=over) == HeldFailure(NOW + 15, "localization", settling=True)
        assert held_at(NOW + 15.1, localization=over) is None

    def test_a_failure_long_after_the_outage_of_a_dependency_is_not_held(self) -> None:
        over = Outage(NOW - 60, NOW - 55)
        assert held_at(NOW + 0.9, localization=over) is None

    def test_an_indirect_dependency_holds_a_failure_for_the_longest_of_its_times(self) -> None:
        dependencies = needs("planning", settleWithin="20s"), needs("maps", waitFor="5m")
        assert held_at(NOW + 1, *dependencies, localization=Outage(NOW - 1)) == HeldFailure(NOW + 300.5, "localization")
        over = Outage(NOW - 1, NOW)
        assert held_at(NOW + 1, *dependencies, localization=over) == HeldFailure(
            NOW + 20, "localization", settling=True
        )

    def test_the_dependency_with_the_longest_hold_counts(self) -> None:
        found = held_at(NOW + 1, needs("a"), needs("b"), a=Outage(NOW - 1, NOW), b=Outage(NOW - 1))
        assert found is not None
        assert found.name == "b"

    def test_a_notice_time_of_zero_holds_nothing(self) -> None:
        assert held_at(NOW + 0.5, needs(noticeWithin="0s")) is None


CHAIN = [Upstream(name="localization"), Upstream(name="planning", depends_on=["localization"])]


def healthy(id: str = "", end: float = NOW - 2, **followed: str) -> UpstreamState:
    return UpstreamState("Healthy", last=last(id, end - 3, end) if id else None, followed=followed)


def due_now(
    followed: dict[str, str], now: float = NOW, *dependencies: Dependency, **observed: UpstreamState
) -> list[str] | None:
    outages = {name: found for name, one in observed.items() if (found := outage(None, one, now)) is not None}
    wanted = dependencies or (needs("localization"), needs("planning"))
    found = due(wanted, CHAIN, observed, outages, followed=followed, now=now)
    return None if found is None else [f"{one.name}/{one.recovery}" for one in found.follows]


class TestDueReactions:
    known = {"localization": "r0", "planning": "p0"}  # noqa: RUF012

    def test_no_reaction_is_due_without_a_recovery_of_a_dependency(self) -> None:
        assert due_now(self.known, localization=healthy("r0"), planning=healthy("p0", localization="r0")) is None

    def test_a_reaction_to_a_recovery_is_due_once(self) -> None:
        observed = {"localization": healthy("r1"), "planning": healthy("p0", localization="r1")}
        assert due_now(self.known, **observed) == ["localization/r1"]
        assert due_now(self.known | {"localization": "r1"}, **observed) is None

    def test_a_reaction_waits_for_the_reactions_of_earlier_dependencies(self) -> None:
        observed = {"localization": healthy("r1"), "planning": healthy("p0", localization="r0")}
        assert due_now(self.known, **observed) is None

    def test_one_reaction_covers_all_earlier_recoveries(self) -> None:
        observed = {"localization": healthy("r1"), "planning": healthy("p1", localization="r1")}
        assert due_now(self.known, **observed) == ["localization/r1", "planning/p1"]

    def test_a_reaction_waits_until_earlier_dependencies_are_healthy(self) -> None:
        observed = {
            "localization": healthy("r1"),
            "planning": UpstreamState("Recovering", NOW - 1, followed={"localization": "r1"}),
        }
        assert due_now(self.known, **observed) is None

    def test_the_wait_for_a_dependency_has_a_time_limit(self) -> None:
        observed = {"localization": healthy("r1", NOW - 121), "planning": healthy("p0", localization="r0")}
        assert due_now(self.known, **observed) == ["localization/r1"]

    def test_a_reaction_is_not_due_while_the_recovered_dependency_fails_again(self) -> None:
        failing = replace(healthy("r1", NOW - 500), health="Failed")
        assert due_now(self.known, localization=failing, planning=healthy("p0", localization="r1")) is None

    def test_a_dependency_that_was_not_observed_before_causes_no_reaction(self) -> None:
        assert due_now({}, localization=healthy("r1"), planning=healthy()) is None

    def test_a_reaction_is_due_if_the_dependency_became_healthy_after_a_failed_recovery(self) -> None:
        observed = UpstreamState("Healthy", last=last("r1", NOW - 9, None))
        outages = {"localization": Outage(NOW - 9, NOW - 1)}
        found = due([needs()], CHAIN[:1], {"localization": observed}, outages, followed={"localization": "r0"}, now=NOW)
        assert found == DueReaction([DependencyRecovery(name="localization", recovery="r1")], NOW - 1)


GRAPHS = {
    "chain": ({"a": [], "b": ["a"], "c": ["b"]}, [["b"], ["c"]]),
    "ladder": ({"a": [], "b": ["a"], "c": ["a", "b"]}, [["b"], ["c"]]),
    "diamond": ({"a": [], "b": ["a"], "c": ["a"], "d": ["b", "c"]}, [["b", "c"], ["d"]]),
    "long way": ({"a": [], "b": ["a"], "c": ["b"], "d": ["a", "c"]}, [["b"], ["c"], ["d"]]),
}


@pytest.mark.parametrize(("graph", "expected"), GRAPHS.values(), ids=GRAPHS.keys())
def test_every_dependency_graph_is_recovered_in_parallel_waves_and_once_per_workload(
    graph: dict[str, list[str]], expected: list[list[str]]
) -> None:
    def upstream(name: str) -> list[Upstream]:
        names = {one for before in graph[name] for one in (before, *(u.name for u in upstream(before)))}
        return [Upstream(name=one, depends_on=graph[one]) for one in graph if one in names]

    observed = {name: healthy(f"{name}0", NOW - 100, **{one: f"{one}0" for one in graph[name]}) for name in graph}
    observed["a"] = healthy("a1", NOW)
    waves: list[list[str]] = []
    for step in range(1, 9):
        now = NOW + step
        wave = {}
        for name in graph:
            above = {one.name: observed[one.name] for one in upstream(name)}
            found = due(
                [needs(one) for one in graph[name]],
                upstream(name),
                above,
                {},
                followed=observed[name].followed,
                now=now,
            )
            if found is not None:
                followed = {**observed[name].followed, **{one.name: one.recovery for one in found.follows}}
                wave[name] = healthy(f"{name}1", now, **followed)
        observed |= wave
        waves += [sorted(wave)] if wave else []
    assert waves == expected


# -- on the instance in control -----------------------------------------------------------------------------------------


def procedure(name: str, node: str = "/plan") -> BringUp:
    found = BringUp.of(name, Procedure(yaml={"set_lifecycle": {"node": node, "state": "active"}}, within="10s"))
    assert found is not None
    return found


AGAIN = Reinitialize("Reinitialize", [procedure("bringUp")])
BOTH = Reinitialize("Procedure", [procedure("bringUp"), procedure("dependsOn[1].procedure", "/costmap")])


def choices(*strategies: Strategy) -> list[Choice]:
    """Each with time enough on a busy machine: none of these runs out of it."""
    return [Choice(strategy, 20.0) for strategy in strategies]


def driving() -> Store:
    store = Store()
    store.add("w-1")
    store.gate = GateState(epoch=1, active="w-1", active_uid="uid-w-1")
    return store


def following(world: World) -> Progress:
    progress = Progress.begin("localization was recovered", last_healthy=world.clock(), detected=world.clock())
    progress.follows = [DependencyRecovery(name="localization", recovery="r1")]
    progress.target = PodIdentity(name="w-1", uid="uid-w-1")
    return progress


class TestReaction:
    async def test_the_procedures_run_behind_a_closed_gate_and_the_same_instance_continues(self) -> None:
        store = driving()
        world = World(store)
        done = await recover(following(world), choices(BOTH, Restart()), world.context())
        assert (done.result, done.strategy) == ("Recovered", "Procedure")
        assert store.commits == ["", "w-1"]
        assert store.brought_up == [("w-1", "bringUp"), ("w-1", "dependsOn[1].procedure")]
        assert store.deleted == []
        recovery = done.to_recovery(1)
        assert (recovery.from_pod, recovery.to_pod) == ("", "w-1")
        assert done.parts["reinitialization"] > 0
        assert recovery.follows == [DependencyRecovery(name="localization", recovery="r1")]

    async def test_if_the_dependency_procedure_fails_the_strategies_of_the_policy_are_tried(self) -> None:
        store = driving()
        store.unwilling.add("w-1")
        world = World(store)
        done = await recover(following(world), choices(AGAIN, Restart()), world.context())
        assert (done.result, done.strategy) == ("Recovered", "Restart")
        assert store.deleted == ["w-1"], "what could not be brought up again has failed"

    async def test_a_missing_instance_is_replaced(self) -> None:
        store = driving()
        world = World(store)
        progress = following(world)
        del store.pods["w-1"]
        done = await recover(progress, choices(AGAIN, Restart()), world.context())
        assert (done.result, done.strategy) == ("Recovered", "Restart")

    async def test_a_reaction_is_finished_once_although_the_monitor_is_killed_at_any_step(self) -> None:
        for step in range(1, 30):
            store = driving()
            first = World(store, dies_after=step)
            progress = following(first)
            try:
                await recover(progress, choices(AGAIN, Restart()), first.context())
            except Killed:
                second = World(store)
                kept = store.journal or store.gate.recovery
                left = (kept or following(second)).model_copy(update={"resumed": True}, deep=True)
                done = await recover(left, choices(AGAIN, Restart()), second.context())
                assert (done.result, done.strategy) == ("Recovered", "Reinitialize")
                assert store.gate.active == "w-1"
                assert store.deleted == []
            else:
                assert step > 4
                return
        pytest.fail("it never got through")

    def test_a_failure_right_after_a_reaction_starts_with_the_first_strategy(self) -> None:
        done = Progress.begin("localization was recovered", last_healthy=NOW, detected=NOW)
        done.follows, done.result = [DependencyRecovery(name="localization", recovery="r1")], "Recovered"
        done.target, done.moments["verified"] = PodIdentity(name="w-1", uid="uid-w-1"), NOW
        assert first_strategy(Takeover.of(done), "uid-w-1", NOW + 0.5, 2, healthy_delay=2.0) == 0


def test_the_record_is_unchanged_by_encoding_and_decoding() -> None:
    progress = Progress.begin("localization was recovered", last_healthy=NOW, detected=NOW)
    progress.follows = [DependencyRecovery(name="localization", recovery="r1")]
    assert Progress.model_validate_json(progress.model_dump_json()).follows == progress.follows

"""The goal ledger over restarts, without its journal, and in any order of events."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from tests.unit.action_proxy.ledgers import status, world
from tests.unit.action_proxy.world import ABORTED, CANCELED, SUCCEEDED, World
from understudy.action_proxy.client_goals import EXECUTING, AttemptState, Phase
from understudy.action_proxy.goal_ledger import (
    MOST_BYTES,
    MOST_KEPT,
    GoalLedger,
)

__all__ = ["world"]  # fixtures


class TestRestart:
    @pytest.mark.parametrize("step", range(6))
    def test_a_restart_at_any_step_loses_no_goal_and_no_answer(self, step: int) -> None:
        world = World()
        world.switch("a")
        goal = world.ask(work=False)
        goal_id = world.ledger.goals[goal].id
        if step == 1:
            world.ledger.advance(world.now)
        if step >= 2:
            world.ledger.advance(world.now)
            world.work()
        if step == 3:
            world.ledger.advance(world.now)  # the answer is known, kept, and doesn't go out
        if step >= 4:
            world.go()
            world.want(goal)
        if step == 5:
            world.ledger.report("a", goal_id, AttemptState.ENDED, world.now, status=SUCCEEDED, result="a")
            del world.instances["a"].running[goal_id]
            world.instances["a"].ended[goal_id] = SUCCEEDED
            world.ledger.advance(world.now)
        world.restart()
        assert world.accepted == {goal: True}
        assert world.instances["a"].starts == [goal]
        if step < 5:
            world.want(goal)
            world.end("a", goal)
        assert world.results == {goal: (SUCCEEDED, "a")}

    def test_a_switch_during_the_restart_of_the_proxy_is_followed(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        kept = world.ledger.to_wire()
        world.active, world.epoch = "b", 2
        world.ledger = type(world.ledger).from_wire(kept, world.now)
        world.ledger.report("a", goal, AttemptState.ENDED, world.now, status=SUCCEEDED, result="a")
        world.tell()
        assert world.results == {}
        assert world.instances["b"].starts == [goal]


def adopted(world: World, goal: str) -> GoalLedger:
    """The ledger of a proxy that has no journal, and has adopted a goal from the active instance."""
    note, id = world.ledger.goals[goal].note(), world.id_at(goal, "a")
    ledger = GoalLedger()
    assert world.ledger.situation is not None
    ledger.place(world.ledger.situation, world.now)
    ledger.adopt("a", id, note, "goal", None, world.now)
    ledger.report("a", id, AttemptState.RUNNING, world.now)
    return ledger


class TestMissingJournal:
    """As when the monitor's pod is on another node now: what the instance in control kept is taken up."""

    def test_goals_are_adopted_from_the_active_instance(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        note = world.ledger.orders("a")[0].note
        world.ledger = GoalLedger()
        world.tell()
        world.ledger.adopt("b", goal, note, "goal", None, world.now)
        assert world.ledger.goals == {}
        world.ledger.adopt("a", goal, note, "goal", None, world.now)
        world.ledger.report("a", goal, AttemptState.RUNNING, world.now)
        world.go()
        assert status(world, goal) == EXECUTING
        world.switch("b")
        assert world.instances["b"].starts == [goal]
        world.end("b", goal)
        assert world.results == {goal: (SUCCEEDED, "b")}

    def test_a_goal_that_was_lost_before_and_after_its_adoption_is_executed_again(self, world: World) -> None:
        goal = world.ask()
        world.restart_application("a")
        world.later(1.0)
        world.ledger = adopted(world, goal)
        world.restart_application("a")
        world.later(1.0)
        assert len(world.instances["a"].starts) == 3
        assert world.instances["a"].running == {world.id_at(goal, "a"): None}

    def test_two_proxies_give_the_next_attempt_the_same_id_so_the_instance_executes_it_once(self, world: World) -> None:
        """As if one is cut off from the API server, but neither from the clients nor from the agent, and its successor runs."""
        goal = world.ask()
        world.restart_application("a")
        world.later(1.0)
        cut_off, id = world.ledger, world.id_at(goal, "a")
        successor = adopted(world, goal)
        for ledger in (cut_off, successor):
            ledger.report("a", id, AttemptState.LOST, world.now)
            ledger.advance(world.now + 1.0)
        (order,), (other) = successor.orders("a"), [order.id for order in cut_off.orders("a")]
        assert [order.id] == other
        assert order.id != id

    def test_a_goal_that_ended_during_the_restart_is_reported_and_not_sent_again(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        note = world.ledger.orders("a")[0].note
        world.ledger = GoalLedger()
        world.tell()
        world.ledger.adopt("a", goal, note, "goal", (ABORTED, "a"), world.now, ago=2.5)
        world.go()
        world.switch("b")
        assert world.results == {goal: (ABORTED, "a")}
        assert world.instances["b"].starts == []

    def test_a_goal_that_a_proxy_withdrew_is_sent_again_by_the_next_one(self, world: World) -> None:
        """A user fences the robot, and the monitor's pod is replaced after the resume."""
        goal = world.ask()
        world.want(goal)
        world.switch("", settled=False, work=False)
        (order,) = world.ledger.orders("a")
        assert order.cancel
        assert order.withdrawn
        note = order.note
        world.ledger = GoalLedger()
        world.switch("a", work=False)
        world.ledger.adopt("a", goal, note, "goal", (CANCELED, ""), world.now, ago=30.0, withdrawn=True)
        world.go()
        assert world.results == {}
        assert [one.cancel for one in world.ledger.orders("a")] == [False]

    def test_a_goal_that_has_ended_for_its_client_is_never_withdrawn(self, world: World) -> None:
        """A standby has it too. Once that is in control, a proxy without a journal would send it again (seed 2213354)."""
        world.instances["b"].executing = True
        world.tell()
        goal = world.ask()
        world.want(goal)
        world.ledger.report("a", world.id_at(goal, "a"), AttemptState.ENDED, world.now, status=SUCCEEDED, result="a")
        world.go(work=False)
        assert world.results == {goal: (SUCCEEDED, "a")}
        (order,) = world.ledger.orders("b")
        assert (order.cancel, order.withdrawn) == (True, False)

    def test_a_goal_that_an_instance_was_to_cancel_is_sent_to_no_other_one_by_the_next_proxy(
        self, world: World
    ) -> None:
        """The application of a standby stood still when the goal ended for its client (seed 2450289)."""
        goal = world.ask()
        (order,) = world.ledger.orders("a")
        world.ledger, world.instances["b"].executing = GoalLedger(), True
        world.switch("a", work=False)
        world.ledger.adopt("a", goal, order.note, "goal", None, world.now, cancelled=True)
        world.go(work=False)
        (order,) = world.ledger.orders("a")
        assert (order.cancel, order.withdrawn) == (True, False)
        world.switch("b")
        assert world.instances["b"].starts == []

    def test_an_instance_learns_that_a_goal_that_was_withdrawn_from_it_has_ended(self, world: World) -> None:
        """The client cancels the goal while nobody is in control. A proxy without a journal would send it again (seed 2253006)."""
        goal = world.ask()
        world.want(goal)
        world.switch("")
        assert world.instances["a"].withdrawn == {goal}
        world.cancel(goal)
        assert world.results == {goal: (CANCELED, "")}
        assert world.instances["a"].withdrawn == set()
        world.switch("b")
        assert world.ledger.orders("b") == []

    def test_nothing_is_withdrawn_while_the_api_server_does_not_answer(self, world: World) -> None:
        """Another monitor may have let the instance through, and its proxy may have given it the goal again (seed 2252022)."""
        goal = world.ask()
        world.want(goal)
        world.is_confirmed = False
        world.switch("")
        assert world.instances["a"].running == {goal: None}
        (order,) = world.ledger.orders("a")
        assert (order.cancel, order.held) == (True, True)
        world.is_confirmed = True
        world.tell()
        assert world.instances["a"].withdrawn == {goal}

    def test_a_goal_goes_to_no_other_instance_before_the_proxys_pod_is_confirmed(self, world: World) -> None:
        """The pod may have been replaced during an outage, and its successor may have answered the client (seed 2301580)."""
        goal = world.ask()
        world.want(goal)
        world.is_confirmed = False
        world.switch("b")
        assert world.instances["b"].starts == []
        asked = world.ask()
        assert world.instances["b"].starts == [asked], "no other proxy has this one"
        world.is_confirmed = True
        world.tell()
        assert set(world.instances["b"].starts) == {asked, goal}

    def test_an_instance_learns_that_a_goal_that_it_aborted_has_ended_for_its_client(self, world: World) -> None:
        """A proxy without a journal would send it to the next instance (seed 2301399)."""
        goal = world.ask()
        world.want(goal)
        world.end("a", goal, ABORTED)
        assert world.ledger.orders("a") == [], "its instance may be about to be replaced"
        world.now += 60
        world.go()
        assert world.results == {goal: (ABORTED, "a")}
        (order,) = world.ledger.orders("a")
        assert (order.cancel, order.withdrawn) == (True, False)

    def test_a_goal_that_was_aborted_shortly_before_its_instance_is_replaced_continues(self, world: World) -> None:
        """The application of an instance that is being deleted aborts its goals, before the next proxy connects."""
        first, second = world.ask(), world.ask()
        world.want(second)
        notes = {order.id: order.note for order in world.ledger.orders("a")}
        world.ledger = GoalLedger()
        world.tell()
        world.ledger.adopt("a", first, notes[first], "goal", (ABORTED, "a"), world.now, ago=1.1)
        world.ledger.adopt("a", second, notes[second], "goal", (ABORTED, "a"), world.now, ago=0.6)
        world.go()
        world.switch("b")
        assert world.instances["b"].starts == [second], "it had replaced the first one"
        world.end("b", second)
        assert world.results == {second: (SUCCEEDED, "b")}


def test_results_are_kept_within_bounds(world: World) -> None:
    for _ in range(MOST_KEPT + 10):
        world.end("a", world.ask())
    assert len(world.ledger.goals) == MOST_KEPT
    for _ in range(3):
        goal = world.ask()
        world.ledger.report("a", goal, AttemptState.ENDED, world.now, status=SUCCEEDED, result="x" * (MOST_BYTES // 2))
        world.now += 1
        world.go()
    assert sum(len(g.end.result) for g in world.ledger.goals.values() if g.end) <= MOST_BYTES


class Machine(RuleBasedStateMachine):
    """Anything in any order; at the end every goal that was accepted has ended, once."""

    @initialize(policy=st.sampled_from(["Resend", "Abort", "Tree"]), mirrored=st.booleans())
    def begin(self, policy: str, mirrored: bool) -> None:
        self.world = World(policy, "a", "b", "c")
        self.world.instances["b"].executing = mirrored
        self.world.switch("a")
        self.cancelled: set[str] = set()
        self.ended: dict[str, object] = {}

    @rule(work=st.booleans())
    def ask(self, work: bool) -> None:
        goal = self.world.ask(work=work)
        if work and self.world.accepted.get(goal):
            self.world.want(goal)

    @rule(work=st.booleans(), index=st.integers(0, 20))
    def cancel(self, work: bool, index: int) -> None:
        goals = [g for g in self.world.ledger.goals.values() if g.phase is not Phase.PENDING]
        if goals:
            self.world.cancel(goals[index % len(goals)].id, work=work)

    @rule(uid=st.sampled_from(["", "a", "b", "c"]), settled=st.booleans())
    def switch(self, uid: str, settled: bool) -> None:
        self.world.switch(uid, settled=settled)

    @rule(status=st.sampled_from([SUCCEEDED, ABORTED, CANCELED]), uid=st.sampled_from("abc"), index=st.integers(0, 20))
    def end(self, status: int, uid: str, index: int) -> None:
        running = list(self.world.instances[uid].running)
        if running:
            id = running[index % len(running)]
            del self.world.instances[uid].running[id]
            self.world.instances[uid].ended[id] = status
            self.world.ledger.report(uid, id, AttemptState.ENDED, self.world.now, status=status, result=uid)
            self.world.go()

    @rule(uid=st.sampled_from("abc"))
    def restart_application(self, uid: str) -> None:
        self.world.restart_application(uid)

    @rule(uid=st.sampled_from("abc"), rejects=st.booleans())
    def reject(self, uid: str, rejects: bool) -> None:
        self.world.instances[uid].rejects = rejects

    @rule()
    def restart(self) -> None:
        self.world.restart()

    @rule(uid=st.sampled_from("abc"))
    def invite(self, uid: str) -> None:
        self.world.ledger.invite(uid)
        self.world.go()

    @rule(seconds=st.sampled_from([0.1, 1.0, 5.0]))
    def wait(self, seconds: float) -> None:
        self.world.later(seconds)

    @invariant()
    def what_has_ended_stays_so(self) -> None:
        if hasattr(self, "world"):
            for goal in self.world.ledger.goals.values():
                if goal.end is not None:
                    assert self.ended.setdefault(goal.id, goal.end) == goal.end

    @invariant()
    def nothing_is_ordered_that_has_ended_or_is_cancelled(self) -> None:
        if hasattr(self, "world"):
            ledger = self.world.ledger
            for uid in "abc":
                live = {order.id for order in ledger.orders(uid) if not order.cancel}
                for goal in ledger.goals.values():
                    if not goal.open or goal.phase is Phase.CANCELING:
                        assert goal.id not in live

    def teardown(self) -> None:
        if not hasattr(self, "world"):
            return
        world = self.world
        for instance in world.instances.values():
            instance.rejects = False
        world.switch("c")
        world.later(5)
        for goal in list(world.ledger.goals.values()):
            if goal.open:
                assert goal.charge == "c"
                world.end("c", goal.id)
            if world.accepted.get(goal.id):
                world.want(goal.id)
        world.later(5)
        open_ones = [goal for goal in world.ledger.goals.values() if goal.open]
        assert open_ones == []
        for goal, accepted in world.accepted.items():
            assert not accepted or goal in world.results, "an accepted goal has a result"


TestAnything = Machine.TestCase
TestAnything.settings = settings(
    max_examples=100, stateful_step_count=30, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True
)

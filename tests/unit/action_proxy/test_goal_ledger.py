"""The rules of the task proxy: no goal is lost, no goal is executed after it ended, and a cancelled goal stays cancelled."""

from __future__ import annotations

import uuid

import pytest

from tests.unit.action_proxy.ledgers import status, world
from tests.unit.action_proxy.world import ABORTED, ACTION, CANCELED, SUCCEEDED, World
from understudy.action_proxy.client_goals import ACCEPTED, CANCELING, EXECUTING, Goal
from understudy.action_proxy.goal_ledger import (
    CANCEL_ENDED,
    CANCEL_OK,
    CANCEL_REJECTED,
    CANCEL_UNKNOWN,
    EARLY,
    MOST_EARLY,
    REFUSED,
    UNDECIDED,
    GoalAnswer,
)

__all__ = ["world"]  # fixtures


class TestOneInstance:
    def test_a_goal_keeps_its_id(self, world: World) -> None:
        goal = world.ask()
        assert world.accepted == {goal: True}
        assert world.instances["a"].starts == [goal]
        assert status(world, goal) == EXECUTING
        world.want(goal)
        assert world.results == {}
        world.end("a", goal)
        assert world.results == {goal: (SUCCEEDED, "a")}
        assert status(world, goal) == SUCCEEDED

    def test_a_result_can_be_requested_later(self, world: World) -> None:
        goal = world.ask()
        world.end("a", goal)
        world.later(800)
        world.want(goal)
        assert world.results == {goal: (SUCCEEDED, "a")}
        world.later(200)
        assert goal not in world.ledger.goals

    def test_the_instance_decides_what_is_rejected(self, world: World) -> None:
        world.instances["a"].rejects = True
        goal = world.ask()
        assert world.accepted == {goal: False}
        world.want(goal)
        world.later(EARLY + 1)
        assert world.results == {goal: (0, "")}

    def test_a_result_can_be_requested_before_the_goal_is_decided(self, world: World) -> None:
        """After another proxy has accepted it, which the client also hears."""
        world.switch("", settled=False)
        goal = world.ask()
        world.want(goal)
        assert world.results == {}
        world.switch("b")
        world.end("b", goal)
        assert world.results == {goal: (SUCCEEDED, "b")}

    @pytest.mark.parametrize("restarts", [False, True])
    def test_a_result_can_be_requested_before_the_goal_is_known(self, world: World, restarts: bool) -> None:
        goal = uuid.uuid4().hex
        world.want(goal)
        if restarts:
            world.restart()
        world.later(EARLY - 1)
        assert world.results == {}
        world.ledger.ask(ACTION, goal, "goal", world.request(goal), world.now)
        world.go()
        world.end("a", goal)
        assert world.results == {goal: (SUCCEEDED, "a")}

    @pytest.mark.parametrize("how", ["nobody is in control", "no connection", "no answer of the API server"])
    def test_a_goal_is_not_unknown_before_the_instance_in_control_was_asked(self, world: World, how: str) -> None:
        goal = uuid.uuid4().hex
        if how == "nobody is in control":
            world.switch("", settled=False)
        elif how == "no connection":
            world.ledger.connected.discard("a")
        else:
            world.is_confirmed = False
            world.tell()
        world.want(goal)
        world.later(10 * EARLY)
        assert world.results == {}
        world.is_confirmed = True
        world.switch("a")
        world.later(EARLY - 1)
        assert world.results == {}
        world.later(2)
        assert world.results == {goal: (0, "")}

    def test_so_many_requests_for_results_of_unknown_goals_are_held(self, world: World) -> None:
        world.switch("")
        goals = [uuid.uuid4().hex for _ in range(MOST_EARLY + 1)]
        for goal in goals:
            world.want(goal)
        assert world.results == {goals[0]: (0, "")}

    def test_a_goal_of_a_request_that_another_proxy_has_answered_is_not_rejected(self, world: World) -> None:
        goal, request = uuid.uuid4().hex, world.request("")
        note = Goal(goal, ACTION, "goal", 1, 0.0, request, accepted=7).note()
        world.ledger.adopt("a", goal, note, "goal", None, world.now)
        world.ledger.advance(world.now)
        world.ledger.ask(ACTION, goal, "goal", request, world.now)
        assert world.ledger.advance(world.now) == [GoalAnswer(ACTION, request, True, 7)]
        world.ledger.ask(ACTION, goal, "goal", ("another", 1), world.now)
        assert world.ledger.advance(world.now) == [GoalAnswer(ACTION, ("another", 1), False, 0)]

    def test_an_abort_is_reported_after_a_delay(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.end("a", goal, ABORTED)
        assert (world.results, status(world, goal)) == ({}, ACCEPTED)
        world.later(1.9)
        assert world.results == {}
        world.later(0.2)
        assert world.results == {goal: (ABORTED, "a")}

    def test_an_abort_during_a_failure_is_not_reported(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.end("a", goal, ABORTED)
        world.settle(False)
        world.later(60)
        assert world.results == {}
        world.settle()
        assert world.results == {goal: (ABORTED, "a")}

    def test_an_abort_of_an_instance_that_could_not_reach_the_robot_is_no_end(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.settle(False)
        world.end("a", goal, ABORTED)
        world.later(600)
        world.stand_in()
        world.later(1)
        again = world.id_at(goal, "a")
        assert world.instances["a"].starts == [goal, again], "it is sent again, so that the instance drives"
        world.end("a", goal, ABORTED)
        world.later(1)
        third = world.id_at(goal, "a")
        assert third != again
        world.stand_in(False)
        world.settle()
        world.later(60)
        assert world.results == {}
        world.end("a", goal)
        assert world.results == {goal: (SUCCEEDED, "a")}

    def test_a_goal_that_was_reached_or_cancelled_while_an_instance_on_board_drives_has_ended(
        self, world: World
    ) -> None:
        reached, cancelled = world.ask(), world.ask()
        world.want(reached)
        world.want(cancelled)
        world.stand_in()
        world.end("a", reached)
        world.cancel(cancelled)
        assert {goal: found[0] for goal, found in world.results.items()} == {reached: SUCCEEDED, cancelled: CANCELED}

    def test_the_instance_decides_whether_a_cancellation_is_accepted(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.instances["a"].refuses_cancel = True
        world.cancel(goal)
        assert [(c.code, c.goals) for c in world.cancelled] == [(CANCEL_REJECTED, ())]
        assert status(world, goal) == EXECUTING
        world.instances["a"].refuses_cancel = False
        world.cancel(goal)
        assert world.cancelled[-1].code == CANCEL_OK
        assert world.cancelled[-1].goals == ((goal, world.ledger.goals[goal].accepted),)
        assert world.results[goal][0] == CANCELED

    def test_cancellations_without_a_running_goal_return_the_reason_as_a_code(self, world: World) -> None:
        goal = world.ask()
        world.end("a", goal)
        for id in (goal, "00" * 15 + "01", ""):
            world.cancel(id)
        assert [c.code for c in world.cancelled] == [CANCEL_ENDED, CANCEL_UNKNOWN, CANCEL_OK]

    def test_all_goals_are_cancelled_at_once(self, world: World) -> None:
        goals = [world.ask() for _ in range(3)]
        world.cancel()
        assert len(world.cancelled) == 1
        assert {goal for goal, _ in world.cancelled[0].goals} == set(goals)

    def test_an_application_that_restarts_in_its_pod_gets_its_goals_again(self, world: World) -> None:
        goal = world.ask()
        world.restart_application("a")
        assert status(world, goal) == ACCEPTED
        world.later(1)
        assert status(world, goal) == EXECUTING
        assert len(world.instances["a"].starts) == 2

    def test_a_goal_without_a_decision_is_rejected_after_a_timeout(self) -> None:
        world = World()
        world.switch("")
        goal = world.ask()
        world.later(UNDECIDED - 1)
        assert world.accepted == {}
        world.later(2)
        assert world.accepted == {goal: False}
        world.switch("a")
        assert world.instances["a"].starts == []

    def test_a_task_that_is_dropped_ends_its_goals(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.rule = type(world.rule)("/other", world.rule.type)
        world.tell()
        assert world.results[goal][0] == ABORTED
        assert world.instances["a"].running == {}


class TestSwitch:
    def test_an_unfinished_goal_is_sent_to_the_new_instance(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.switch("", settled=False)
        assert (world.results, status(world, goal)) == ({}, ACCEPTED)
        world.switch("b", settled=False)
        assert world.instances["b"].starts == [goal]
        assert status(world, goal) == EXECUTING
        assert world.ledger.resent == {"/goto": 1}
        world.end("b", goal)
        assert world.results == {goal: (SUCCEEDED, "b")}
        assert world.accepted == {goal: True}

    def test_the_old_instances_result_does_not_count_and_its_goals_are_cancelled(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.epoch += 1
        world.active = "b"
        old = world.id_at(goal, "a")
        del world.instances["a"].running[old]
        world.instances["a"].ended[old] = SUCCEEDED
        world.tell()
        assert world.results == {}
        other = world.ask()
        world.switch("a")
        world.switch("b")
        assert other in world.instances["b"].running or len(world.instances["b"].starts) > 2
        assert world.instances["a"].running == {}

    def test_a_goal_that_a_failing_application_aborts_continues(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.end("a", goal, ABORTED)
        world.switch("b")
        assert world.instances["b"].starts == [goal]
        world.end("b", goal)
        assert world.results == {goal: (SUCCEEDED, "b")}

    def test_a_goal_that_is_being_cancelled_when_its_application_ends_is_cancelled_at_the_switch(
        self, world: World
    ) -> None:
        goal = world.ask()
        world.want(goal)
        world.cancel(goal, work=False)
        world.end("a", goal, ABORTED)
        assert world.results == {}
        world.switch("b")
        assert world.results == {goal: (CANCELED, "")}
        assert world.instances["b"].starts == []

    def test_an_abort_of_a_goal_that_is_being_cancelled_is_reported_after_a_delay(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.cancel(goal, work=False)
        world.end("a", goal, ABORTED)
        world.later(2.1)
        assert world.results == {goal: (ABORTED, "a")}

    def test_a_replaced_goal_is_not_sent_again_although_the_newer_one_was_aborted_later(self, world: World) -> None:
        first, second = world.ask(), world.ask()
        world.want(first)
        world.end("a", first, ABORTED)
        world.later(0.5)
        world.end("a", second, ABORTED)
        world.switch("b")
        assert world.results == {first: (ABORTED, "a")}
        assert world.instances["b"].starts == [second]

    def test_a_replaced_goal_is_not_sent_again(self, world: World) -> None:
        first, second = world.ask(), world.ask()
        world.want(first)
        world.end("a", first, ABORTED)
        world.switch("b")
        assert world.results == {first: (ABORTED, "a")}
        assert world.instances["b"].starts == [second]

    def test_a_goal_continues_although_its_client_cancelled_a_newer_one_that_was_aborted_with_it(
        self, world: World
    ) -> None:
        first, second = world.ask(), world.ask()
        world.want(first)
        world.end("a", first, ABORTED)
        world.end("a", second, ABORTED)
        world.cancel(second)
        world.switch("b")
        assert world.instances["b"].starts == [first]
        assert world.results == {}

    def test_a_goal_is_sent_again_to_the_instance_that_was_told_to_cancel_it(self, world: World) -> None:
        """If the gate closes and soon opens for the same instance, which has not answered yet. No client has asked for that end."""
        goal = world.ask()
        world.want(goal)
        world.switch("", settled=False, work=False)
        assert world.ledger.orders("a")[0].cancel
        world.switch("a", work=False)
        world.go()
        assert world.instances["a"].starts == [goal, world.id_at(goal, "a")]
        world.later(10)
        assert world.results == {}
        world.end("a", goal)
        assert world.results == {goal: (SUCCEEDED, "a")}

    def test_a_goal_ends_that_an_instance_has_reached_although_it_was_told_to_cancel_it(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.switch("", settled=False, work=False)
        world.switch("a", work=False)
        world.end("a", goal)
        assert world.results == {goal: (SUCCEEDED, "a")}

    def test_an_end_that_no_client_requested_is_withheld_while_the_agent_is_gone(self, world: World) -> None:
        """The monitor may be away, or may learn late that the pod was deleted."""
        goal = world.ask()
        world.want(goal)
        world.end("a", goal, ABORTED)
        world.ledger.connected.discard("a")
        world.later(60)
        assert world.results == {}
        world.switch("b")
        assert world.instances["b"].starts == [goal]

    def test_an_end_that_no_client_requested_counts_once_the_agent_is_back(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.end("a", goal, ABORTED)
        world.ledger.connected.discard("a")
        world.later(60)
        world.ledger.connected.add("a")
        world.go()
        assert world.results == {goal: (ABORTED, "a")}

    def test_goals_that_a_failing_application_aborts_continue_in_order(self, world: World) -> None:
        goals = [world.ask() for _ in range(3)]
        for goal in goals:
            world.end("a", goal, ABORTED)
        world.switch("b")
        assert world.instances["b"].starts == goals

    def test_ended_goals_are_not_sent_again(self, world: World) -> None:
        ended, cancelled = world.ask(), world.ask()
        world.end("a", ended)
        world.cancel(cancelled)
        world.switch("b")
        assert world.instances["b"].starts == []

    def test_a_pending_cancellation_survives_the_switch(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.cancel(goal, work=False)
        world.go(work=False)
        world.epoch += 1
        world.active = "b"
        world.lose("a")
        assert [c.code for c in world.cancelled] == [CANCEL_OK]
        assert world.results[goal][0] == CANCELED
        assert world.instances["b"].starts == []

    def test_a_goal_in_cancellation_at_the_switch_is_cancelled(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.cancel(goal, work=False)
        world.go(work=False)
        world.ledger.cancel_answered("a", goal, True, world.now)
        world.go(work=False)
        assert status(world, goal) == CANCELING
        world.epoch += 1
        world.active = "b"
        world.lose("a")
        assert world.results[goal][0] == CANCELED
        assert world.instances["b"].starts == []

    def test_a_cancellation_without_an_active_instance_is_accepted_at_once(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.switch("", settled=False)
        world.cancel(goal)
        assert world.cancelled[0].code == CANCEL_OK
        assert world.results[goal][0] == CANCELED

    def test_a_goal_is_sent_again_with_another_id_after_two_switches(self, world: World) -> None:
        goal = world.ask()
        world.switch("b")
        world.switch("a")
        assert status(world, goal) == EXECUTING
        first, again = world.instances["a"].starts
        assert (first, again != goal) == (goal, True)
        world.end("a", goal)
        world.want(goal)
        assert world.results == {goal: (SUCCEEDED, "a")}

    def test_a_goal_received_without_an_active_instance_goes_to_the_next_one(self, world: World) -> None:
        world.switch("", settled=False)
        goal = world.ask()
        assert world.accepted == {}
        world.switch("b")
        assert world.accepted == {goal: True}

    def test_a_goal_that_the_old_instance_had_not_decided_goes_to_the_next_one(self, world: World) -> None:
        goal = world.ask(work=False)
        world.answer()
        world.epoch += 1
        world.active = "b"
        world.lose("a")
        assert world.accepted == {goal: True}
        assert world.instances["b"].starts == [goal]

    def test_a_new_instance_that_rejects_a_goal_is_asked_again(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.instances["b"].rejects = True
        world.switch("b")
        world.later(5)
        assert world.results == {}
        world.instances["b"].rejects = False
        world.later(1)
        (started,) = world.instances["b"].starts
        assert started == world.id_at(goal, "b")
        assert started != goal, "the instance takes a repeated order for the one that it has rejected"

    def test_a_new_instance_that_rejects_a_goal_is_not_asked_forever(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.instances["b"].rejects = True
        world.switch("b")
        world.later(REFUSED + 2)
        assert world.results == {goal: (ABORTED, "")}

    def test_a_first_goal_is_offered_again_while_the_instance_is_not_settled(self, world: World) -> None:
        world.instances["a"].rejects = True
        world.settle(False)
        goal = world.ask()
        world.later(3)
        assert world.accepted == {}
        world.settle()
        world.later(1)
        assert world.accepted == {goal: False}

    def test_an_older_epoch_changes_nothing(self, world: World) -> None:
        goal = world.ask()
        world.switch("b")
        world.epoch, world.active = 1, "a"
        world.tell()
        assert world.ledger.goals[goal].charge == "b"


class TestPolicies:
    def test_on_failover_abort_aborts_the_goals_at_a_switch(self) -> None:
        world = World("Abort")
        world.switch("a")
        goal = world.ask()
        world.want(goal)
        world.switch("b")
        assert world.results == {goal: (ABORTED, "")}
        assert world.instances["b"].starts == []

    def test_on_failover_tree_sends_the_goals_when_the_procedure_requests_it(self) -> None:
        world = World("Tree")
        world.switch("a")
        goal = world.ask()
        world.switch("", settled=False)
        assert world.instances["b"].starts == []
        assert world.ledger.invite("b") == 1
        world.go()
        assert world.instances["b"].starts == [goal]
        assert status(world, goal) == ACCEPTED
        world.switch("b", settled=False)
        assert status(world, goal) == EXECUTING
        assert world.instances["b"].starts == [goal]

    def test_on_failover_tree_without_the_leaf_sends_the_goals_after_the_recovery(self) -> None:
        world = World("Tree")
        world.switch("a")
        goal = world.ask()
        world.switch("b", settled=False)
        assert world.instances["b"].starts == []
        world.settle()
        assert world.instances["b"].starts == [goal]


class TestMirrors:
    @pytest.fixture
    def world(self) -> World:
        made = World()
        made.instances["b"].executing = True
        made.switch("a")
        return made

    def test_an_executing_standby_receives_the_goal_and_keeps_it_at_the_switch(self, world: World) -> None:
        goal = world.ask()
        assert world.instances["b"].starts == [goal]
        world.switch("b")
        assert world.instances["b"].starts == [goal]
        assert status(world, goal) == EXECUTING
        world.want(goal)
        world.end("b", goal)
        assert world.results == {goal: (SUCCEEDED, "b")}

    def test_results_of_a_standby_are_ignored(self, world: World) -> None:
        goal = world.ask()
        world.want(goal)
        world.end("b", goal)
        assert world.results == {}
        assert world.ledger.feedback_of("b", goal) is None
        assert world.ledger.feedback_of("a", goal) is world.ledger.goals[goal]

    def test_a_goal_that_ended_at_the_standby_is_sent_to_it_again(self, world: World) -> None:
        goal = world.ask()
        world.end("b", goal)
        world.later(10)
        assert world.instances["b"].starts == [goal], "a standby that is done stays so"
        world.switch("b")
        assert len(world.instances["b"].starts) == 2
        assert status(world, goal) == EXECUTING

    def test_a_standby_that_aborted_the_goal_receives_it_again(self, world: World) -> None:
        goal = world.ask()
        world.end("b", goal, ABORTED)
        world.later(3)
        assert len(world.instances["b"].running) == 1

    def test_a_mirrored_goal_is_cancelled_when_the_real_one_ends(self, world: World) -> None:
        first, second = world.ask(), world.ask()
        world.end("a", first)
        assert list(world.instances["b"].running) == [second]
        world.cancel(second)
        assert world.instances["b"].running == {}

    def test_a_goal_that_was_withdrawn_from_a_standby_is_sent_again_if_that_is_put_in_control(
        self, world: World
    ) -> None:
        goal = world.ask()
        world.want(goal)
        world.instances["b"].executing = False
        world.tell(work=False)
        (order,) = world.ledger.orders("b")
        assert order.cancel
        world.switch("b", work=False)  # the cancel is on its way
        world.end("b", goal, CANCELED)
        world.later(10)
        assert world.results == {}
        assert status(world, goal) == EXECUTING
        assert len(world.instances["b"].starts) == 2

    def test_a_later_standby_receives_the_goal_too(self, world: World) -> None:
        goal = world.ask()
        world.instances["c"] = type(world.instances["a"])("c", executing=True)
        world.tell()
        assert world.instances["c"].starts == [goal]

    def test_a_goal_that_is_rejected_is_never_mirrored(self, world: World) -> None:
        world.instances["a"].rejects = True
        world.ask()
        assert world.instances["b"].starts == []

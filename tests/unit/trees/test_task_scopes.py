"""What a tree says while a task is active, and that its deadline is the exact moment at which it says worse."""

from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.trees.topic_world import START, World, gap, rate, steady
from understudy.trees.core.health_tree import SEVERITY, Verdict
from understudy.trees.core.observations import RecordedObservations
from understudy.trees.languages.short.health_loader import load


def during(node: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"while": {"task_active": {"action": "/go"}}, "do": node, **more}


class TaskWorld(World):
    """A world in which a task is active since a time, or isn't."""

    task: float | None = None

    def observed(self) -> RecordedObservations:
        tasks = {"/go/_action/status": START + self.task} if self.task is not None else {}
        return RecordedObservations(self.records, tasks)

    def at(self, now: float) -> Verdict:
        return self.tree.evaluate(self.observed(), now=START + now, since=self.since)

    def deadline(self, now: float) -> float | None:
        moment = self.tree.deadline(self.observed(), now=START + now, since=self.since)
        return None if moment is None else round(moment - START, 6)


def test_a_leaf_of_a_task_is_not_judged_without_the_task():
    world = TaskWorld({"parallel": [gap("/scan"), during(gap("/cmd_vel"))]}).arrive("/scan", 100.0)
    assert world.at(100.1) == Verdict("Healthy", "", "", None)
    assert world.deadline(100.1) == 100.5, "only the scan has an end"


def test_an_active_task_grants_time_to_settle():
    world = TaskWorld(during(gap("/cmd_vel"), settle="2s"), grace=5)
    world.task = 100.0
    assert world.at(101.999).state == "Healthy"
    assert world.deadline(100.0) == 102
    assert world.at(102) == Verdict("Failed", "no /cmd_vel while a goal of /go is active", "cmd_vel", START + 100.0)


def test_messages_of_an_earlier_goal_do_not_fail_a_new_one():
    world = TaskWorld(during(gap("/cmd_vel"), settle="1s"), grace=5).arrive("/cmd_vel", 50.0)
    world.task = 100.0
    assert world.at(100.9).state == "Healthy"
    world.arrive("/cmd_vel", 100.95)
    assert world.deadline(101.0) == 101.45
    assert world.at(101.449).state == "Healthy"
    failed = world.at(101.45)
    assert_golden("health_tree", failed.reason, "/cmd_vel", "500 ms", "/go")
    assert failed.onset == START + 100.95


def test_a_gap_longer_than_the_settling_time_counts_from_the_start_of_the_task():
    world = TaskWorld(during(gap("/cmd_vel", "5s"), settle="1s"), grace=2)
    world.task = 100.0
    assert world.deadline(100.0) == 105


def test_the_end_of_the_task_clears_its_failures():
    world = TaskWorld(during(gap("/cmd_vel")), grace=5)
    world.task = 100.0
    assert world.at(110).state == "Failed"
    world.task = None
    assert world.at(110.1).state == "Healthy"
    assert world.deadline(110.1) is None


def test_an_instance_that_takes_over_an_active_task_has_the_grace_of_a_start():
    world = TaskWorld(during(gap("/cmd_vel"), settle="1s"), grace=10, since=200).arrive("/cmd_vel", 199.9)
    world.task = 100.0
    assert world.at(205).state == "Starting"
    assert world.deadline(205) == 210
    assert world.at(210).state == "Failed"
    assert world.arrive("/cmd_vel", 206).at(206.4).state == "Healthy"
    assert world.deadline(206.4) == 206.5


def test_a_rate_for_a_task_is_counted_from_its_start():
    world = TaskWorld(during(rate("/cmd_vel"), settle="1s"), grace=5).arrive("/cmd_vel", *steady(10, 0, 50))
    world.task = 100.0
    assert world.deadline(100) == 103, "a whole window after it has settled"
    world.arrive("/cmd_vel", *steady(10, 100.9, 103.5))
    assert world.at(103.5).state == "Healthy"
    assert_golden("health_tree", world.at(110).reason, "/cmd_vel", "0 Hz", "8 Hz", "2 s", "/go")


@pytest.mark.parametrize("inner", [gap("/a"), {"inverter": gap("/a")}])
def test_an_inverter_around_a_task_fails_without_the_task(inner):
    world = TaskWorld({"inverter": during(inner)}, grace=0).arrive("/a", 100.0)
    assert world.at(100.1) == Verdict(
        "Failed", "no goal of /go is active, but the tree requires the opposite", "a", None
    )


def test_an_inverter_inside_a_task_counts_only_while_the_task_is_active():
    world = TaskWorld(during({"inverter": gap("/stop")})).arrive("/stop", 100.0)
    assert world.at(100.1).state == "Healthy"
    world.task = 99.0
    assert world.at(100.1).state == "Failed"


def test_a_task_whose_status_cannot_be_watched_causes_no_failure():
    world = TaskWorld({"parallel": [gap("/scan"), during(gap("/cmd_vel"))]}).arrive("/scan", 100.0)
    world.task = 50.0
    assert world.at(100.1).state == "Failed"
    world.tree.leave_out({"/go/_action/status"})
    assert world.at(100.1).state == "Healthy"


def test_the_status_of_the_action_is_watched():
    topics = {topic.name: topic for topic in load(during(gap("/cmd_vel"))).topics}
    assert topics["/go/_action/status"].task
    assert topics["/go/_action/status"].type == "action_msgs/msg/GoalStatusArray"
    assert not topics["/cmd_vel"].task


@settings(max_examples=120, deadline=None)
@given(
    arrivals=st.lists(st.integers(0, 1200), max_size=30),
    task=st.none() | st.integers(0, 1200),
    since=st.integers(0, 600),
    now=st.integers(0, 1200),
    settle=st.sampled_from(["100ms", "1s", "3s"]),
    inner=st.sampled_from(
        [gap("/a"), rate("/a", "> 2 Hz", "1s"), {"selector": [gap("/a"), gap("/b", "2s")]}, {"inverter": gap("/a")}]
    ),
)
def test_the_deadline_of_a_task_is_the_first_worse_moment(arrivals, task, since, now, settle, inner):
    """Times in hundredths of a second."""
    assume(now >= since)
    world = TaskWorld(during(inner, settle=settle), grace=2.0, since=since / 100)
    for index, time in enumerate(sorted(time for time in arrivals if time <= now)):
        world.arrive("/b" if index % 3 == 0 and "/b" in world.records else "/a", time / 100)
    world.task = task / 100 if task is not None and task <= now else None
    present = SEVERITY[world.at(now / 100).state]
    deadline = world.deadline(now / 100)
    assert SEVERITY[world.at(now / 100).state] == present
    later = [now / 100 + step / 100 for step in range(1, 800)]
    worse = next((time for time in later if SEVERITY[world.at(time).state] > present), None)
    if deadline is None:
        assert worse is None
    else:
        assert SEVERITY[world.at(deadline).state] > present
        assert worse is None or worse - 0.0101 <= deadline <= worse + 1e-6


def test_the_topics_of_a_task_count_only_while_the_task_is_active():
    world = TaskWorld({"parallel": [gap("/scan"), during(gap("/cmd_vel"))]})

    def counting() -> set[str]:
        return world.tree.counting(world.observed(), now=START + 100, since=START)

    assert counting() == {"/scan"}
    world.task = 99.0
    assert counting() == {"/scan", "/cmd_vel"}

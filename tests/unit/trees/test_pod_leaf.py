"""The leaf `pod`: what Kubernetes says of the pod in control."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.trees.btcpp_texts import load_xml
from tests.unit.trees.world import (
    START,
    TASK,
    World,
    assert_deadline_is_the_first_worse_moment,
    mistakes,
    states_in_both_forms,
    written,
)
from understudy.trees.core.health_tree import Verdict
from understudy.trees.core.observations import PodUsage
from understudy.trees.languages.short.health_loader import TreeError, load
from understudy.trees.languages.short.procedure_loader import CONDITIONS


def leaf(**more: Any) -> dict[str, Any]:
    return {"pod": more or {"condition": "Ready"}}


# -- conditions -----------------------------------------------------------------------------------------------------


def test_the_leaf_fails_when_the_condition_has_another_status():
    world = World(leaf()).pod_says(1.0, Ready="True")
    assert world.at(1.0) == Verdict("Healthy", "", "", None)
    assert world.deadline(1.0) is None
    verdict = world.pod_says(2.0, Ready="False ContainersNotReady").at(2.0)
    assert verdict == Verdict("Failed", verdict.reason, "pod.Ready", START + 1.0)
    assert_golden("health_tree", verdict.reason, "Ready", "False (ContainersNotReady)")
    assert world.pod_says(3.0, Ready="True").at(3.0).state == "Healthy"
    assert world.pod_says(4.0).at(4.0).reason.startswith("the pod has no condition Ready, but True is required")


def test_with_for_the_leaf_fails_exactly_after_that_time_with_another_status():
    world = World(leaf(condition="Ready", **{"for": "2s"})).pod_says(1.0, Ready="True")
    world.at(1.0)
    for time in (1.1, 1.2, 2.5, 3.0):
        assert world.pod_says(time, Ready="Unknown").at(time).state == "Healthy"
        assert world.deadline(time) == 3.1
    assert_golden("health_tree", world.at(3.1).reason, "2 s", "Unknown")


def test_other_conditions_and_restarts_have_no_influence():
    world = World(leaf()).pod_says(1.0, Ready="True", PodScheduled="True")
    world.at(1.0)
    assert (
        world.pod_says(2.0, 5, Ready="True", PodScheduled="False", DisruptionTarget="True").at(2.0).state == "Healthy"
    )


def test_an_inverted_condition_must_not_be_true():
    world = World({"inverter": leaf(condition="DisruptionTarget")}, grace=1.0).pod_says(2.0, Ready="True")
    assert world.at(2.0).state == "Healthy"
    assert world.pod_says(3.0, DisruptionTarget="True").at(3.0).state == "Failed"


def test_a_missing_condition_is_unknown():
    world = World(leaf(condition="example.com/calibrated", status="Unknown")).pod_says(1.0)
    assert world.at(1.0).state == "Healthy"
    world.pod_says(2.0, **{"example.com/calibrated": "False"})
    assert world.at(2.0).leaf == "pod.example.com.calibrated"


def test_a_pod_that_was_not_observed_is_starting_until_the_grace_ends():
    world = World(leaf(), grace=10)
    assert_golden("health_tree", world.at(1.0).reason, "10 s")
    assert world.pod_says(2.0, Ready="False").at(9.9).state == "Starting"
    assert world.deadline(9.9) == 10
    assert_golden("health_tree", world.at(10.0).reason, "10 s", "False")


def test_the_next_instance_is_judged_only_by_observations_after_its_activation():
    world = World(leaf(), grace=10).pod_says(1.0, Ready="True")
    world.at(1.0)
    world.since = START + 3.0
    assert world.at(3.1).state == "Starting"
    assert world.pod_says(3.2, Ready="True").at(3.2).state == "Healthy"


def test_a_leaf_of_a_task_is_judged_only_while_the_task_is_active():
    world = World({**TASK, "do": leaf()}, grace=5).pod_says(100.0, Ready="False")
    assert world.at(100.0).state == "Healthy"
    world.task = 100.0
    assert world.deadline(100.1) == 101
    assert world.at(101.0).reason.endswith(" is False, but True is required while a goal of /go is active")


# -- restarts -------------------------------------------------------------------------------------------------------


def test_the_leaf_fails_after_too_many_restarts_until_they_leave_the_window():
    world = World(leaf(restarts=1, window="10s")).pod_says(1.0, 7)
    assert world.at(1.0).state == "Healthy", "what was before isn't held against it"
    assert world.pod_says(2.0, 8).at(2.0).state == "Healthy"
    verdict = world.pod_says(5.0, 9).at(5.0)
    assert verdict == Verdict("Failed", verdict.reason, "pod.restarts", START + 5.0)
    assert_golden("health_tree", verdict.reason, "2 times", "10 s")
    assert world.at(11.9).state == "Failed"
    assert world.at(12.0).state == "Healthy"


def test_rare_restarts_and_conditions_have_no_influence():
    world = World(leaf(restarts=1, window="10s")).pod_says(1.0, 0, Ready="True")
    for step in range(1, 6):
        assert world.pod_says(10.0 * step, step, Ready="False").at(10.0 * step).state == "Healthy"


def test_several_restarts_at_once_count_and_a_limit_of_zero_allows_none():
    world = World(leaf(restarts=2, window="10s")).pod_says(1.0, 0)
    world.at(1.0)
    assert_golden("health_tree", world.pod_says(2.0, 40).at(2.0).reason, "3 times", "10 s")
    world = World(leaf(restarts=0, window="1h")).pod_says(1.0, 3)
    world.at(1.0)
    assert_golden("health_tree", world.pod_says(2.0, 4).at(2.0).reason, "once", "3600 s")


def test_the_next_instance_starts_without_restarts():
    world = World(leaf(restarts=0, window="1h")).pod_says(1.0, 0)
    world.at(1.0)
    assert world.pod_says(2.0, 1).at(2.0).state == "Failed"
    world.since = START + 3.0
    assert world.at(3.0).state == "Healthy"
    assert world.pod_says(3.1, 5).at(3.1).state == "Healthy"
    assert world.pod_says(4.0, 0).at(4.0).state == "Healthy", "another pod of that name"
    assert world.pod_says(5.0, 1).at(5.0).state == "Failed"


def test_for_a_task_only_restarts_during_the_task_count():
    world = World({**TASK, "do": leaf(restarts=0, window="1h")}).pod_says(1.0, 0)
    world.at(1.0)
    world.pod_says(2.0, 1).at(2.0)
    world.task = 3.0
    assert world.at(10.0).state == "Healthy"
    world.pod_says(11.0, 2)
    assert world.at(11.0).reason.endswith("once within 3600 s while a goal of /go is active")
    world.task = None
    assert world.at(12.0).state == "Healthy"


def test_a_clock_step_moves_remembered_times():
    world = World(leaf(restarts=0, window="10s")).pod_says(1.0, 0)
    world.at(1.0)
    world.pod_says(2.0, 1).at(2.0)
    world.pod.received += 3600.0
    assert world.at(3611.9).state == "Failed"
    assert world.at(3612.0).state == "Healthy"


@settings(max_examples=80, deadline=None)
@given(
    steps=st.lists(st.tuples(st.integers(1, 40), st.integers(0, 3)), max_size=10),
    most=st.integers(0, 4),
    window=st.integers(1, 60),
)
def test_the_leaf_fails_exactly_while_the_window_has_too_many_restarts(steps, most, window):
    """Times in tenths of a second."""
    world = World(leaf(restarts=most, window=f"{window / 10:g}s")).pod_says(0.0, 0)
    world.at(0.0)
    now = total = 0
    times: list[int] = []
    for step, new in steps:
        for between in range(now + 1, now + step):
            expected = sum(between - time < window for time in times) > most
            assert (world.at(between / 10 + 0.01).state == "Failed") is expected
        now, total = now + step, total + new
        times += [now] * new
        state = world.pod_says(now / 10, total).at(now / 10 + 0.01).state
        assert (state == "Failed") is (sum(now - time < window for time in times) > most)


# -- CPU and memory -------------------------------------------------------------------------------------------------


def test_the_leaf_fails_after_the_usage_exceeded_the_bound_for_that_time():
    world = World(leaf(cpu="< 1.5", **{"for": "10s"})).pod_says(1.0, usage=PodUsage(0.2, 0.0))
    assert world.at(1.0).state == "Healthy"
    assert world.pod_says(2.0, usage=PodUsage(1.5, 0.0)).at(2.0).state == "Healthy"
    assert world.deadline(2.0) == 12
    verdict = world.pod_says(11.0, usage=PodUsage(1.9, 0.0)).at(12.0)
    assert verdict == Verdict("Failed", verdict.reason, "pod.cpu", START + 1.0)
    assert_golden("health_tree", verdict.reason, "1.5", "10 s")
    assert world.pod_says(13.0, usage=PodUsage(1.49, 0.0)).at(13.0).state == "Healthy"


def test_a_peak_and_other_resources_have_no_influence():
    world = World(leaf(memory="< 200Mi", **{"for": "10s"})).pod_says(1.0, usage=PodUsage(0.1, 100 * 2**20))
    world.at(1.0)
    assert world.pod_says(2.0, usage=PodUsage(0.1, 300 * 2**20)).at(2.0).state == "Healthy"
    assert world.pod_says(8.0, usage=PodUsage(9.0, 190 * 2**20)).at(8.0).state == "Healthy"
    assert world.at(30.0).state == "Healthy"
    assert world.pod_says(31.0, usage=PodUsage(9.0, 212.4 * 2**20)).at(31.0).state == "Healthy"
    assert_golden("health_tree", world.at(41.0).reason, "memory < 200Mi", "10 s", "212.4Mi")


def test_missing_usage_is_no_failure():
    world = World(leaf(cpu="> 0.1", **{"for": "5s"}), grace=1.0).pod_says(2.0)
    assert world.at(20.0).state == "Healthy"
    assert world.pod_says(21.0, usage=PodUsage(0.0, 0.0)).at(21.0).state == "Healthy", (
        "the first ones too have their time"
    )
    assert world.at(26.0).state == "Failed"
    assert world.pod_says(27.0).at(27.0).state == "Healthy", "what was is of long ago"


@pytest.mark.parametrize(
    ("bound", "holding", "others"),
    [
        ("< 1.5", [0.0, 1.499], [1.5, 2.0]),
        ("<= 1500m", [0.0, 1.5], [1.501]),
        (">200Mi", [201.0 * 2**20], [200.0 * 2**20]),
        (">= 1e3", [1000.0], [999.9]),
    ],
)
def test_bounds_are_strict_or_inclusive_as_written(bound, holding, others):
    for what in ("cpu", "memory"):
        for value in (*holding, *others):
            world = World(leaf(**{what: bound})).pod_says(1.0, usage=PodUsage(value, value))
            assert (world.at(1.0).state == "Healthy") is (value in holding)


def test_usage_is_requested_only_if_a_leaf_needs_it():
    assert not load(leaf()).topics[0].usage
    for nodes in ([leaf(), leaf(cpu="< 1")], [leaf(cpu="< 1"), leaf()]):
        (topic,) = load({"parallel": nodes}).topics
        assert topic.usage


# -- both -----------------------------------------------------------------------------------------------------------


def test_a_standby_is_not_judged_by_the_leaf():
    world = World({"parallel": [leaf(), leaf(restarts=0, window="1h")]}, grace=1.0)
    world.in_control = False
    assert world.at(20.0).state == "Healthy"
    assert world.deadline(20.0) is None
    assert world.pod_says(21.0, 0, Ready="False").at(21.0).state == "Healthy"
    assert world.pod_says(22.0, 3, Ready="False").at(22.0).state == "Healthy"


def test_the_leaf_subscribes_to_no_topic_and_a_procedure_cannot_contain_it():
    (topic,) = load({"parallel": [leaf(), leaf(restarts=0, window="1h")]}).topics
    assert (topic.pod, topic.subscribed) == (True, False)
    assert "pod" not in CONDITIONS


@pytest.mark.parametrize(
    ("found", "place", "expected"),
    [
        ("Ready", "", "found 'Ready'; 'pod' must be a mapping such as {condition: Ready, for: 10s}"),
        ({}, "", "found none of condition, restarts, cpu and memory; give one of them, such as condition: Ready"),
        (
            {"condition": "Ready", "restarts": 1},
            "",
            "found condition and restarts; give one of them, such as condition: Ready",
        ),
        (
            {"condition": "not ready"},
            ".condition",
            "found 'not ready'; give the type of a condition, such as Ready or ContainersReady",
        ),
        ({"condition": "Ready", "status": "yes"}, ".status", "found 'yes'; known are True, False, Unknown"),
        ({"condition": "Ready", "status": 1}, ".status", "found 1; known are True, False, Unknown"),
        ({"condition": "Ready", "window": "1s"}, ".window", "window is only for restarts; remove it"),
        (
            {"restarts": 1, "window": "1m", "for": "1s"},
            ".for",
            "for is only for condition, cpu or memory; remove it",
        ),
        ({"restarts": 1, "window": "1m", "status": "True"}, ".status", "status is only for condition; remove it"),
        ({"restarts": 1}, ".window", "missing; give the time within which there may be so many restarts, such as 10m"),
        ({"restarts": -1, "window": "1m"}, ".restarts", "found -1; give a whole number from 0 to 1000"),
        ({"restarts": True, "window": "1m"}, ".restarts", "found True; give a whole number from 0 to 1000"),
        (
            {"cpu": "1.5"},
            ".cpu",
            "found '1.5'; write <, <=, > or >= and a quantity, such as '< 1.5', in cores",
        ),
        (
            {"memory": "< 200 MB"},
            ".memory",
            "found '< 200 MB'; write <, <=, > or >= and a quantity, such as '< 200Mi'",
        ),
        ({"memory": 200}, ".memory", "found 200; write <, <=, > or >= and a quantity, such as '< 200Mi'"),
        ({"cpu": "< 1", "window": "1m"}, ".window", "window is only for restarts; remove it"),
    ],
)
def test_a_mistake_is_reported_with_its_place_and_the_valid_values(found, place, expected):
    assert mistakes("pod", found) == [f"{place}: {expected}"]


@pytest.mark.parametrize("status", [False, "False", "false"])
def test_a_status_may_be_a_yaml_boolean(status):
    assert World(leaf(condition="Paused", status=status)).pod_says(1.0, Paused="False").at(1.0).state == "Healthy"


def test_the_leaf_is_the_same_in_all_languages():
    short = {
        "parallel": [
            leaf(condition="Ready", **{"for": "1s"}),
            {**leaf(condition="Paused", status="False"), "name": "going"},
            leaf(restarts=1, window="2s"),
            leaf(cpu="< 800m", **{"for": "3s"}),
            leaf(memory=">= 1Ki"),
        ]
    }
    text = written(
        '<Pod condition="Ready" for="1s"/><Pod name="going" condition="Paused" status="False"/>'
        '<Pod restarts="1" window="2s"/>'
        '<Pod cpu="&lt; 800m" for="3s"/><Pod memory=">= 1Ki"/>'
    )

    def drive(world):
        for time, restarts, ready, paused in (
            (1, 0, "True", "False"),
            (2, 1, "False", "False"),
            (4, 1, "True", "True"),
            (5, 2, "True", "False"),
            (5.5, 3, "True", "False"),
        ):
            world.pod_says(time, restarts, usage=PodUsage(time / 5, 2048.0), Ready=ready, Paused=paused)
            yield from (world.at(time), world.deadline(time))
        yield from (world.at(3.5 + time), world.deadline(3.5 + time))

    states = states_in_both_forms(text, short, drive)
    assert states == ["Starting", "Healthy", "Healthy", "Failed", "Healthy", "Failed", "Failed"], (
        "at last it took too much for too long"
    )
    with pytest.raises(TreeError) as caught:
        load_xml(written('\n<Pod condition="Ready" status="maybe"/>'))
    assert_golden(
        "tree_problems",
        [str(problem) for problem in caught.value.problems],
        "spec.monitoring.xml",
        "line 2, column 1",
        "'maybe'",
    )


@settings(max_examples=100, deadline=None)
@given(
    node=st.sampled_from(
        [
            leaf(),
            leaf(condition="Ready", **{"for": "1s"}),
            leaf(restarts=0, window="700ms"),
            leaf(cpu="< 1", **{"for": "500ms"}),
            leaf(restarts=1, window="2s"),
            {"inverter": leaf(restarts=0, window="1s")},
        ]
    ),
    changes=st.lists(
        st.tuples(st.integers(0, 600), st.integers(0, 1), st.sampled_from(["True", "False"])), max_size=12
    ),
    tasked=st.booleans(),
    task=st.none() | st.integers(0, 600),
    since=st.integers(0, 300),
    now=st.integers(0, 600),
)
def test_the_deadline_is_the_first_moment_with_a_worse_verdict(node, changes, tasked, task, since, now):
    """Times in hundredths of a second."""
    assume(now >= since)
    world = World({**TASK, "do": node} if tasked else node, grace=2.0, since=since / 100)
    world.task = task / 100 if task is not None and task <= now else None
    restarts = 0
    for time, new, ready in sorted(changes):
        restarts += new
        if time <= now:
            usage = PodUsage(2.0 * (ready == "False"), 0.0) if time % 3 else None
            world.pod_says(time / 100, restarts, usage=usage, Ready=ready).at(time / 100)
    assert_deadline_is_the_first_worse_moment(world, now / 100)

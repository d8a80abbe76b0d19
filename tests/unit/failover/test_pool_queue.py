"""The order of workloads that wait for a shared pool, over all times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.unit.failover.pool_courses import POOL, place
from understudy.failover.pool_queue import YIELD, YIELD_MOST, Waiter, before, due, in_order, left_by

# -- the rule itself, over all times --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Robot:
    """One that fails at a time, waits for so long, and whose monitor may have died as soon as it had said so."""

    priority: int
    fails: float
    patience: float
    dead: bool = False


@dataclass
class Course:
    """The result of a run: which workload was served when, and how."""

    served: dict[int, tuple[float, int]] = field(default_factory=dict)
    """Time and pod by robot."""
    tried: list[tuple[float, int, int]] = field(default_factory=list)
    """Every attempt to claim: time, robot and pod."""
    overtaken: list[float] = field(default_factory=list)
    """For each that was alive, waited and ranked before the one that was served: how long that one had left the pod to others."""
    idle: list[tuple[float, float]] = field(default_factory=list)
    """Spans in which a pod was free and the same living robot waited."""


def play(robots: Sequence[Robot], pods: Sequence[float]) -> Course:
    """Let robots wait for pods that become free at times. Everybody sees everything at once; the dead do nothing."""
    course, free = Course(), dict[int, float]()
    places = [
        Waiter(workload=f"w{i}", pool=POOL, priority=r.priority, since=r.fails, until=r.fails + r.patience)
        for i, r in enumerate(robots)
    ]
    coming = sorted(pods)
    now = 0.0
    while True:
        while coming and coming[0] <= now:
            since = coming.pop(0)
            free[len(pods) - len(coming)] = since
        at_it = {i for i, p in enumerate(places) if p.since <= now < p.until and i not in course.served}
        living = sorted((i for i in at_it if not robots[i].dead), key=lambda i: places[i].rank)
        looks: dict[int, float] = {}
        for i in living:
            if i in course.served:
                continue
            others = [places[j] for j in at_it if j != i and j not in course.served]
            ahead = before(places[i], others, now)
            available = {pod: max(since, places[i].since) for pod, since in free.items()}
            at = due(ahead, available.values())
            if at is None:
                continue
            if at > now:
                looks[i] = at
                continue
            pod = left_by(ahead, list(free))[0]
            course.tried.append((now, i, pod))
            course.served[i] = (now, pod)
            passed = [j for j in living if j not in course.served and places[j].rank < places[i].rank]
            course.overtaken += [now - min(available.values()) for _ in passed]
            del free[pod]
        left = [i for i in living if i not in course.served]
        course.idle += [(max(since, places[i].since), now) for since in free.values() for i in left]
        moments = [p.since for i, p in enumerate(places) if i not in course.served]
        moments += [p.until for p in places] + coming + list(looks.values())
        later = [moment for moment in moments if moment > now]
        if not later:
            return course
        now = min(later)


TIMES = st.integers(0, 400).map(lambda tenths: tenths / 10)
ROBOTS = st.builds(
    Robot, st.sampled_from([-1, 0, 0, 5, 100]), TIMES, st.integers(1, 200).map(lambda tenths: tenths / 10)
)
MORTALS = st.builds(
    Robot, st.sampled_from([-1, 0, 5]), TIMES, st.integers(1, 200).map(lambda tenths: tenths / 10), st.booleans()
)
PODS = st.lists(TIMES, max_size=8)


@given(st.lists(ROBOTS, max_size=7), PODS)
def test_among_running_workloads_none_is_served_before_a_higher_ranked_one(
    robots: list[Robot], pods: list[float]
) -> None:
    assert play(robots, pods).overtaken == []


@given(st.lists(MORTALS, max_size=7), PODS)
def test_a_pod_serves_one_workload_and_a_vanished_one_delays_it_only_briefly(
    robots: list[Robot], pods: list[float]
) -> None:
    course = play(robots, pods)
    taken = [pod for _, pod in course.served.values()]
    assert len(taken) == len(set(taken))
    assert len(course.tried) == len(taken), "nobody goes for a pod that another takes"
    assert all(end - begin <= YIELD_MOST + 1e-9 for begin, end in course.idle)


@given(st.lists(MORTALS, max_size=7), PODS)
def test_a_running_workload_is_overtaken_only_after_the_longest_yield_time(
    robots: list[Robot], pods: list[float]
) -> None:
    assert all(left >= YIELD_MOST - 1e-9 for left in play(robots, pods).overtaken)


def test_workloads_are_ordered_by_priority_then_waiting_time_then_name() -> None:
    waiters = [place("b", since=2), place("a", since=2), place("c", since=1), place("d", priority=1, since=3)]
    assert [w.workload for w in in_order(waiters, POOL, now=4)] == ["d", "c", "a", "b"]


def test_an_expired_waiter_and_one_of_another_pool_are_not_ahead() -> None:
    late = place("late", priority=9, until=5)
    elsewhere = place("elsewhere", priority=9).model_copy(update={"pool": "other"})
    assert before(place("me"), [late, elsewhere], now=5) == 0


@pytest.mark.parametrize(
    ("ahead", "free", "at"),
    [
        (0, [], None),
        (0, [3.0], 3.0),
        (1, [3.0], 3.0 + YIELD),
        (1, [3.0, 3.2], 3.0),
        (2, [3.0, 3.2], 3.0 + YIELD),
        (50, [3.0], 3.0 + YIELD_MOST),
    ],
)
def test_a_free_pod_is_left_for_a_moment_to_each_workload_that_is_ahead(
    ahead: int, free: list[float], at: float | None
) -> None:
    assert due(ahead, free) == at


def test_two_waiting_workloads_claim_different_pods() -> None:
    assert [left_by(ahead, ["p1", "p2"])[0] for ahead in (0, 1)] == ["p1", "p2"]
    assert left_by(2, ["p1", "p2"]) == ["p1", "p2"], "left long enough by those ahead, whichever it is"

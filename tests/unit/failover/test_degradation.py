"""The level between healthy and failed: it comes after the debounce, goes after the clear time, and doesn't flap."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from understudy.failover.degradation import Level, TreeState

TOLD: st.SearchStrategy[TreeState] = st.sampled_from(["Starting", "Healthy", "Failed"])
COURSE = st.lists(st.tuples(st.integers(1, 40), TOLD), min_size=1, max_size=60)
"""What the tree says, each so many tenths of a second after the one before."""


def run(course: list[tuple[int, TreeState]], *, debounce: int, clear_after: int) -> list[tuple[int, TreeState, bool]]:
    """When (in tenths of a second) the tree said what, and what the level was then."""
    level, now, found = Level(), 0, []
    for step, state in course:
        now += step
        found.append((now, state, level.note(state, now, debounce=debounce, clear_after=clear_after)))
    return found


def lasting(course: list[tuple[int, TreeState, bool]], last_state: TreeState) -> int:
    """For how long the tree has said the same at the end, as far as was looked; -1 where it says something else."""
    since = None
    for now, state, _ in reversed(course):
        if state != last_state:
            break
        since = now
    return -1 if since is None else course[-1][0] - since


@given(COURSE, st.integers(0, 50), st.integers(0, 50))
def test_degradation_begins_after_the_debounce_and_ends_after_the_clear_time(
    course: list[tuple[int, TreeState]], debounce: int, clear_after: int
) -> None:
    states = run(course, debounce=debounce, clear_after=clear_after)
    before = False
    for end in range(1, len(states) + 1):
        now = states[end - 1][2]
        if before:
            assert now is not (0 <= clear_after <= lasting(states[:end], "Healthy"))
        else:
            assert now is (debounce <= lasting(states[:end], "Failed"))
        before = now


@given(COURSE, st.integers(1, 50), st.integers(1, 50))
def test_two_changes_are_at_least_the_waiting_time_apart(
    course: list[tuple[int, TreeState]], debounce: int, clear_after: int
) -> None:
    changed, before = [], False
    for now, _, degraded in run(course, debounce=debounce, clear_after=clear_after):
        if degraded != before:
            changed.append((now, degraded))
        before = degraded
    for (earlier, _), (later, degraded) in pairwise(changed):
        assert later - earlier >= (debounce if degraded else clear_after)


def test_degradation_counts_from_the_moment_when_the_tree_began_to_fail() -> None:
    level = Level()
    assert not level.note("Failed", 10.0, debounce=2.0, clear_after=5.0)
    assert level.note("Failed", 12.0, debounce=2.0, clear_after=5.0)
    assert level.since == 10.0


def test_a_workload_that_recovers_only_briefly_stays_degraded() -> None:
    level = Level()
    assert level.note("Failed", 0.0, debounce=0.0, clear_after=10.0)
    for second in range(1, 100):
        assert level.note("Healthy" if second % 8 else "Failed", float(second), debounce=0.0, clear_after=10.0)


def test_degradation_known_to_an_earlier_monitor_ends_only_after_the_clear_time() -> None:
    level = Level(since=-100.0)
    assert level.note("Starting", 0.0, debounce=2.0, clear_after=10.0)
    assert level.note("Healthy", 1.0, debounce=2.0, clear_after=10.0)
    assert level.note("Healthy", 10.9, debounce=2.0, clear_after=10.0)
    assert not level.note("Healthy", 11.0, debounce=2.0, clear_after=10.0)

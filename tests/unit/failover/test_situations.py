"""Which situation is in force: the first that counts, which comes and goes with hysteresis."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from understudy.failover.situation import Rule, Situations

CARRYING, DOCKING = Rule("carrying", 0.0, 10.0), Rule("docking", 2.0, 0.0)
BOTH = (CARRYING, DOCKING)


def test_a_situation_is_in_force_at_once_and_for_the_clear_time_after_its_end() -> None:
    found = Situations()
    assert found.note(BOTH, {"carrying": False, "docking": False}, 0.0) is None
    assert found.note(BOTH, {"carrying": True, "docking": False}, 1.0) == "carrying"
    assert found.note(BOTH, {"carrying": False, "docking": False}, 2.0) == "carrying"
    assert found.note(BOTH, {"carrying": False, "docking": False}, 11.9) == "carrying"
    assert found.note(BOTH, {"carrying": False, "docking": False}, 12.0) is None


def test_a_situation_that_returns_within_the_clear_time_does_not_end() -> None:
    found = Situations()
    for second in range(60):
        assert found.note(BOTH, {"carrying": second % 6 == 0}, float(second)) == "carrying"


def test_a_situation_that_is_shorter_than_its_debounce_is_never_in_force() -> None:
    found = Situations()
    for second in range(60):
        assert found.note(BOTH, {"docking": second % 2 == 0}, float(second)) is None


def test_an_earlier_situation_of_the_list_takes_precedence() -> None:
    found = Situations()
    assert found.note(BOTH, {"docking": True}, 0.0) is None
    assert found.note(BOTH, {"docking": True, "carrying": False}, 2.0) == "docking"
    assert found.note(BOTH, {"docking": True, "carrying": True}, 3.0) == "carrying"
    assert found.note(BOTH, {"docking": True, "carrying": False}, 4.0) == "carrying"
    assert found.note(BOTH, {"docking": True, "carrying": False}, 14.0) == "docking"


def test_an_undecided_situation_changes_nothing() -> None:
    found = Situations()
    assert found.note(BOTH, {"carrying": True}, 0.0) == "carrying"
    assert found.note(BOTH, {"carrying": False}, 1.0) == "carrying"
    for second in range(2, 100):
        assert found.note(BOTH, {}, float(second)) == "carrying"
    assert found.note(BOTH, {"carrying": False}, 100.0) == "carrying"
    assert found.note(BOTH, {"carrying": False}, 110.0) is None


def test_a_situation_of_an_earlier_monitor_stays_in_force() -> None:
    found = Situations()
    found.adopt("carrying", 5.0)
    assert found.note(BOTH, {}, 5.0) == "carrying"
    assert found.note((DOCKING,), {}, 6.0) is None, "the policy has it no longer"
    assert found.note(BOTH, {}, 7.0) is None


SEEN = st.fixed_dictionaries({rule.name: st.sampled_from([True, False, None]) for rule in BOTH})


@given(st.lists(st.tuples(st.integers(1, 30), SEEN), min_size=1, max_size=50))
def test_a_situation_is_in_force_for_at_least_its_clear_time(
    course: list[tuple[int, dict[str, bool | None]]],
) -> None:
    found, now, entered = Situations(), 0.0, None
    for step, observed in course:
        now += step / 10
        noted = found.note((CARRYING,), observed, now)
        if noted is not None and entered is None:
            assert observed["carrying"]
            entered = now
        elif noted is None and entered is not None:
            assert now - entered >= CARRYING.clear_after
            entered = None

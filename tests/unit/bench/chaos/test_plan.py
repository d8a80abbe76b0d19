"""A campaign is repeatable, and no fault undoes another one."""

from __future__ import annotations

from itertools import combinations, pairwise

import pytest

from bench.chaos.plan import BY_NAME, KINDS, plan


def test_a_seed_decides_all() -> None:
    assert plan(7, 50, 6, 3.0) == plan(7, 50, 6, 3.0)
    assert plan(7, 50, 6, 3.0) != plan(8, 50, 6, 3.0)
    assert plan(7, 20, 6, 3.0) == plan(7, 50, 6, 3.0)[:20], "a shorter campaign begins in the same way"


def test_faults_come_in_order_as_often_as_asked_and_reach_every_robot_and_kind() -> None:
    found = plan(1, 600, 6, 3.0, muxed=[1, 3, 5])
    times = [fault.at for fault in found]
    assert times == sorted(times)
    assert times[-1] / len(times) == pytest.approx(3.0, rel=0.25)
    assert {fault.kind for fault in found} == set(BY_NAME)
    assert {fault.robot for fault in found if BY_NAME[fault.kind].muxed} == {1, 3, 5}
    assert not any(BY_NAME[fault.kind].muxed for fault in plan(1, 100, 6, 3.0))
    assert {fault.robot for fault in found} == set(range(6))
    assert [fault.number for fault in found] == list(range(1, 601))


@pytest.mark.parametrize("seed", range(5))
def test_what_is_shared_has_one_fault_at_a_time(seed: int) -> None:
    found = plan(seed, 300, 6, 2.0)
    for shared in {kind.shared for kind in KINDS} - {""}:
        theirs = [fault for fault in found if BY_NAME[fault.kind].shared == shared]
        assert len(theirs) >= 5
        for one, other in combinations(theirs, 2):
            assert one.ends < other.at


def test_a_robot_has_one_fault_of_a_kind_at_a_time_and_several_kinds_at_once() -> None:
    found = plan(3, 400, 3, 1.0)
    pairs = [(one, other) for one, other in combinations(found, 2) if one.robot == other.robot and one.ends > other.at]
    alone = [pair for pair in pairs if not any(BY_NAME[fault.kind].shared for fault in pair)]
    assert alone
    assert all(one.kind != other.kind for one, other in alone)


def test_lengths_victims_and_strengths_are_those_of_the_kind() -> None:
    for fault in plan(5, 500, 6, 3.0):
        kind = BY_NAME[fault.kind]
        assert kind.seconds[0] <= fault.seconds <= kind.seconds[1]
        assert fault.victim in kind.victims
        assert fault.strength in kind.strengths


def test_one_kind_alone_can_be_chosen_and_unknown_ones_are_refused() -> None:
    found = plan(1, 20, 2, 3.0, ["api-stop"])
    assert {fault.kind for fault in found} == {"api-stop"}
    assert all(one.ends < other.at for one, other in pairwise(found))
    with pytest.raises(ValueError, match="there are: kill, "):
        plan(1, 20, 2, 3.0, ["kil"])

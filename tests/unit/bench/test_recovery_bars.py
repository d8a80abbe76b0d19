"""The bars of ``scripts/bench recovery``: the robot's gap, and the time that the cluster takes to switch. In milliseconds."""

from __future__ import annotations

import pytest

from bench import recovery


def test_a_standby_that_runs_takes_over_within_these_times() -> None:
    found = recovery.bars("executing")
    assert found["robot: gap without commands"] == {"p95": pytest.approx(560.0)}
    assert found["t_cluster"] == {"p95": 10.0}
    assert found["decision to gate enforced"] == {"p95": 15.0}


@pytest.mark.parametrize("strategy", recovery.EXPECTED)
def test_every_strategy_detects_in_time_and_lets_no_command_through_early(strategy: str) -> None:
    found = recovery.bars(strategy)
    assert found["detection past the timeout"] == {"p95": 15.0}
    assert found["robot: early commands"] == {"max": 0.0}


def test_strategies_that_start_an_instance_have_no_bar_for_their_gap() -> None:
    assert not recovery.bars("restart").keys() & {"robot: gap without commands", "t_cluster"}

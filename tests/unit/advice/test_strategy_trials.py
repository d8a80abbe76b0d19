"""The trial agrees with the formulas where both hold, and with what can be counted by hand."""

import tracemalloc
from random import Random

import pytest

from understudy.advice import shortage_risk
from understudy.advice.demand import Demand
from understudy.advice.monte_carlo import _arrivals, _estimate, _share, losses, simulate, wait_times

FLEET = Demand(1000, 1.0, 6.0)


def test_a_failure_without_a_free_fallback_is_a_loss():
    assert losses([0, 1, 2, 6, 6.5], 2, lambda: 6.0) == [0, 0, 1, 0, 1]


def test_failures_are_served_in_order():
    assert wait_times([0, 1, 2, 3], 1, lambda: 6.0) == [0, 5, 10, 15]
    assert wait_times([0, 1, 2, 9], 2, lambda: 6.0) == [0, 0, 4, 0]


@pytest.mark.parametrize("fallbacks", [1, 4, 7])
def test_simulated_losses_and_windows_match_the_formulas(fallbacks):
    trial = simulate(FLEET, fallbacks, 30.0, failures=60_000)
    for estimate, expected in (
        (trial.loss, shortage_risk.loss_risk(FLEET.offered, fallbacks)),
        (trial.window, shortage_risk.window_risk(FLEET.offered, fallbacks)),
    ):
        assert estimate.mean == pytest.approx(expected, abs=3 * estimate.within)
        assert estimate.within < 0.01


@pytest.mark.parametrize("fallbacks", [3, 4])
def test_simulated_waits_match_the_formulas_for_exponential_refills(fallbacks):
    draw = Random(7)
    times = list(_arrivals(FLEET.rate, 60_000, draw))
    waited = wait_times(times, fallbacks, lambda: draw.expovariate(1 / FLEET.refill))
    for values, expected in (
        ([float(wait > 0) for wait in waited], shortage_risk.waiting_risk(FLEET.offered, fallbacks)),
        (waited, shortage_risk.mean_wait(FLEET.offered, fallbacks, FLEET.refill)),
    ):
        estimate = _estimate(values)
        assert estimate.mean == pytest.approx(expected, abs=3 * estimate.within)


def test_refills_of_constant_time_cause_less_waiting():
    assert simulate(FLEET, 4, 30.0, failures=60_000).wait.mean < 0.7 * shortage_risk.mean_wait(
        FLEET.offered, 4, FLEET.refill
    )


def test_an_interval_is_crowded_at_least_as_often_as_a_window():
    trial = simulate(FLEET, 4, 30.0, failures=60_000)
    assert trial.interval.mean > trial.window.mean


def test_equal_trials_give_equal_results():
    assert simulate(FLEET, 4, 30.0, failures=2_000) == simulate(FLEET, 4, 30.0, failures=2_000)


@pytest.mark.parametrize("number", [1, 19, 20, 21, 997])
def test_the_estimate_of_a_share_equals_that_of_the_written_out_values(number):
    found = [index for index in range(number) if index % 7 in (0, 3)]
    written = _estimate([float(index in found) for index in range(number)])
    assert _share(found, number) == written


def test_trials_with_rare_failures_use_little_memory():
    """Of windows as long as a refill there are millions then, and failures in few."""
    tracemalloc.start()
    try:
        trial = simulate(Demand(1, 1.0, 7.0), 1, 30.0, failures=20_000)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert trial.window.mean == pytest.approx(shortage_risk.window_risk(7 / 3600, 1), abs=1e-6)
    assert most < 20e6

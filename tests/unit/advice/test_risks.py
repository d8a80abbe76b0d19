"""Risks by Erlang's formulas: their known values, and what has to be so of them."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.advice.shortage_risk import MEASURES, fewest_fallbacks, loss_risk, mean_wait, waiting_risk, window_risk

OFFERED = st.floats(0.01, 200.0)
COUNTS = st.integers(0, 300)


def test_a_fleet_that_never_fails_has_no_risk():
    assert (window_risk(0, 0), loss_risk(0, 0), waiting_risk(0, 0), mean_wait(0, 0, 6)) == (0, 0, 0, 0)


@pytest.mark.parametrize(
    ("offered", "fallbacks", "expected"),
    [(1.0, 1, 1 / 2), (1.0, 2, 1 / 5), (2.0, 2, 2 / 5), (10.0, 10, 0.2146), (20.0, 30, 0.00846), (100.0, 117, 0.0098)],
)
def test_losses_equal_those_of_erlang_b_tables(offered, fallbacks, expected):
    assert loss_risk(offered, fallbacks) == pytest.approx(expected, rel=5e-3)


def test_one_fallback_waits_like_a_queue_with_one_server():
    """M/M/1: a failure waits with the chance that the server is busy, and for that over what is left."""
    assert waiting_risk(0.5, 1) == pytest.approx(0.5)
    assert mean_wait(0.5, 1, refill=6.0) == pytest.approx(6.0)


def test_waiting_is_unbounded_if_failures_are_as_frequent_as_refills():
    assert waiting_risk(4.0, 4) == 1
    assert mean_wait(4.0, 4, 6.0) == math.inf


@settings(deadline=None)
@given(OFFERED, COUNTS)
def test_the_window_risk_is_the_tail_of_the_poisson_distribution(offered, fallbacks):
    terms = (math.exp(n * math.log(offered) - offered - math.lgamma(n + 1)) for n in range(fallbacks + 1))
    assert window_risk(offered, fallbacks) == pytest.approx(1 - math.fsum(terms), abs=1e-9)


@settings(deadline=None)
@given(OFFERED, COUNTS)
def test_each_further_fallback_lowers_each_risk(offered, fallbacks):
    for measure in MEASURES.values():
        here, after = measure(offered, fallbacks), measure(offered, fallbacks + 1)
        assert 0 <= after <= here <= 1


@settings(deadline=None)
@given(OFFERED, COUNTS)
def test_waiting_for_a_fallback_is_at_least_as_likely_as_a_loss(offered, fallbacks):
    assert waiting_risk(offered, fallbacks) >= loss_risk(offered, fallbacks) * (1 - 1e-9)


@settings(deadline=None)
@given(OFFERED, st.floats(1e-9, 0.999), st.sampled_from(sorted(MEASURES)))
def test_the_sufficient_size_is_the_smallest_one(offered, risk, measure):
    count = fewest_fallbacks(measure, offered, risk)
    assert MEASURES[measure](offered, count) <= risk
    assert count == 0 or MEASURES[measure](offered, count - 1) > risk


@pytest.mark.parametrize("risk", [0.0, 1.0, -0.1, math.nan])
def test_a_risk_must_be_between_zero_and_one(risk):
    with pytest.raises(ValueError, match="above 0 and below 1"):
        fewest_fallbacks("loss", 1.0, risk)


def test_a_size_beyond_the_limit_is_reported():
    with pytest.raises(ValueError, match="a pool of 1000000 is not enough"):
        fewest_fallbacks("loss", 3e6, 0.01)

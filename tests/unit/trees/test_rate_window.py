"""The window's arithmetic: counts, bounds, and the moments at which they change."""

import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from understudy.trees.core.rate_window import Band, Window


@pytest.mark.parametrize(
    ("text", "window", "least", "most"),
    [
        ("> 8 Hz", 2.0, 17, None),
        (">= 8 Hz", 2.0, 16, None),
        ("< 20 Hz", 1.0, 0, 19),
        ("<= 20 Hz", 1.0, 0, 20),
        ("9 to 11 Hz", 1.0, 9, 11),
        ("9.5 Hz to 10.5 Hz", 2.0, 19, 21),
        (">=10Hz", 0.3, 3, None),  # 0.3 is not exact in binary
        ("> 10 Hz", 0.3, 4, None),
    ],
)
def test_bounds_are_converted_to_numbers_of_samples(text, window, least, most):
    counted = Window(Band.parse(text), window)
    assert (counted.least, counted.most) == (least, most)


@pytest.mark.parametrize("text", ["> 8 Hz", ">= 8 Hz", "< 20 Hz", "<= 20.5 Hz", "9 to 11 Hz"])
def test_a_band_is_unchanged_by_parsing_and_printing(text):
    assert str(Band.parse(text)) == text


@pytest.mark.parametrize(
    ("text", "window"),
    [("> 8 Hz", 2.0), ("> 1 Hz", 10.0), ("9 to 11 Hz", 2.0), ("9.9 to 10.1 Hz", 10.0), ("< 0.5 Hz", 20.0)],
)
def test_the_default_window_holds_enough_samples(text, window):
    assert Band.parse(text).default_window() == pytest.approx(window)


@given(low=st.integers(1, 100), width=st.integers(1, 100), phase=st.floats(0, 1), periods=st.integers(0, 50))
def test_a_steady_rate_inside_the_band_holds_in_the_shortest_window(low, width, phase, periods):
    band = Band(Fraction(low), Fraction(low + width))
    window = Window(band, band.shortest_window())
    period = 1 / (low + width / 2)
    end = 1000 + window.length + periods * period + phase * period
    arrivals = [1000 + i * period for i in range(math.floor((end - 1000) / period) + 1)]
    assert window.holds(arrivals, end)


@given(
    gaps=st.lists(st.floats(0.001, 1.0), min_size=1, max_size=60),
    text=st.sampled_from(["> 8 Hz", "< 5 Hz", "3 to 9 Hz", ">= 2 Hz"]),
)
def test_the_count_enters_and_leaves_the_band_exactly_at_the_predicted_moments(gaps, text):
    arrivals = [1.7e9]
    for gap in gaps:
        arrivals.append(arrivals[-1] + gap)
    window = Window(Band.parse(text), 2.0)
    now = arrivals[-1]
    moments = sorted({m for m in window.changes(arrivals) if m > now})
    state = window.holds(arrivals, now)
    for moment in moments:
        before = math.nextafter(moment, 0)
        assert window.holds(arrivals, before) == state
        state = window.holds(arrivals, moment)
    assert window.holds(arrivals, now + 10) == state

"""Times and sentences."""

from __future__ import annotations

import pytest

from tests.support.fleet import NOW, ago
from understudy.cli.common.text.wording import age, clock, wrapped


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0s"),
        (12.4, "12s"),
        (60, "1m"),
        (252, "4m12s"),
        (3600, "1h"),
        (3660, "1h1m"),
        (3605, "1h"),
        (183600, "2d3h"),
    ],
)
def test_ages_are_formatted_in_their_two_largest_units(seconds: float, text: str) -> None:
    assert age(ago(seconds), NOW) == text


def test_a_clock_ahead_of_ours_gives_no_negative_age() -> None:
    assert age(ago(-5), NOW) == "0s"


def test_times_are_in_utc() -> None:
    assert clock("2026-11-22T15:02:11.5+01:00") == "2026-11-22 14:02:11Z"


def test_a_command_that_is_too_long_stays_in_one_piece() -> None:
    text = "See why it ends: kubectl-logs-of-a-container-whose-name-is-longer-than-the-line"
    assert wrapped(text, 40, indent=2, hanging=4) == [
        "  See why it ends:",
        "    kubectl-logs-of-a-container-whose-name-is-longer-than-the-line",
    ]
    assert wrapped(text, None, indent=2) == [f"  {text}"]

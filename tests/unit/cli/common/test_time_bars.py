"""Bars to scale, and figures."""

from __future__ import annotations

import pytest

from understudy.cli.common.text.time_bars import NAMES, bar, length, short, stacked

OLD, NEW = "robot-17-navigation-7k2xq", "robot-17-navigation-x8v2m"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0"),
        (0.00002, "0"),
        (0.0004, "0.4 ms"),
        (0.006, "6 ms"),
        (0.0061, "6.1 ms"),
        (0.503, "503 ms"),
        (0.9996, "1.00 s"),
        (2.905, "2.90 s"),
    ],
)
def test_durations_are_formatted_with_a_suitable_unit(seconds: float, text: str) -> None:
    assert length(seconds) == text


def drawn(text: str) -> tuple[int, float]:
    """Where a bar begins and how long it is, in characters."""
    body = text.lstrip(" ")
    parts = {c: n / 8 for n, c in enumerate(" ▏▎▍▌▋▊▉█")}
    return len(text) - len(body), sum(parts[c] for c in body)


@pytest.mark.parametrize(
    ("start", "seconds"), [(0.0, 0.5), (0.0, 0.51), (0.5, 0.02), (0.49, 0.003), (0.5, 3.0), (0.27, 1.111)]
)
def test_bars_are_to_scale(start: float, seconds: float) -> None:
    scale = 0.05
    lead, cells = drawn(bar(start, seconds, scale))
    assert lead * scale == pytest.approx(start, abs=scale / 2)
    assert cells * scale == pytest.approx(seconds, abs=scale / 8)


def test_zero_has_no_bar_and_the_shortest_time_has_one() -> None:
    assert bar(1.0, 0.0, 0.05) == ""
    assert bar(1.0, 0.0001, 0.05).strip() == "▏"


def test_names_are_shortened_if_they_stay_distinct() -> None:
    assert short([OLD, NEW]) == {OLD: "…-7k2xq", NEW: "…-x8v2m"}
    assert short(["drive-0", "drive-1"]) == {"drive-0": "drive-0", "drive-1": "drive-1"}
    assert short(["a-7k2xq", "b-7k2xq"]) == {"a-7k2xq": "a-7k2xq", "b-7k2xq": "b-7k2xq"}


def test_the_parts_of_a_bar_add_up_to_its_length() -> None:
    parts = {"detection": 0.5, "cluster": 1.04, "startup": 0.5, "reinitialization": 0.26}
    assert list(parts) == list(NAMES)
    assert stacked(parts, 0.1) == "░" * 5 + "█" * 10 + "▓" * 5 + "▒" * 3
    assert stacked({}, 0.1) == ""

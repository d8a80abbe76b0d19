"""Which texts state a whole number."""

from __future__ import annotations

import pytest

from understudy.api.whole_numbers import whole_number


@pytest.mark.parametrize(("text", "number"), [("0", 0), ("007", 7), ("9" * 18, 10**18 - 1)])
def test_digits_are_a_number(text: str, number: int) -> None:
    assert whole_number(text) == number


@pytest.mark.parametrize(
    "text", ["", "-1", "+1", "1.0", " 1", "1\n", "1_0", "0x1", "²", "١", "①", "9" * 19, "9" * 5000, "soon"]
)
def test_every_other_text_is_none(text: str) -> None:
    assert whole_number(text) is None

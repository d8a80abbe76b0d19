"""Quantities are compared as Kubernetes means them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from understudy.api.quantities import amount, binary_quantity


@pytest.mark.parametrize(
    ("one", "same"),
    [
        ("1500m", "1.5"),
        ("1", "1000m"),
        ("0.1", "100m"),
        (".5", "500m"),
        ("2.", "2"),
        ("1Gi", "1024Mi"),
        ("1Ki", "1024"),
        ("1G", "1000M"),
        ("1e3", "1k"),
        ("5E-1", "500m"),
        ("1E", "1000P"),
        ("1Ei", "1024Pi"),
        ("1000000n", "1m"),
    ],
)
def test_equal_quantities_compare_equal(one: str, same: str) -> None:
    assert amount(one) == amount(same)


@pytest.mark.parametrize(("less", "more"), [("999m", "1"), ("1G", "1Gi"), ("128Mi", "0.2Gi"), ("50m", "0.051")])
def test_quantities_are_ordered_by_their_amount(less: str, more: str) -> None:
    assert amount(less) < amount(more)


@pytest.mark.parametrize("text", ["", "m", "1 Gi", "1GiB", "one", "1e9999", "1.2.3", "0x10", "1K"])
def test_an_invalid_quantity_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not a quantity: write a number"):
        amount(text)


@given(st.integers(0, 10**9))
def test_thousandths_are_exact(thousandths: int) -> None:
    assert amount(f"{thousandths}m") * 1000 == thousandths


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (1, "1Ki"),
        (1 << 20, "1Mi"),
        ((1 << 20) + 1, "1025Ki"),
        (3 << 30, "3Gi"),
        (2080 << 20, "2080Mi"),
        (1 << 44, "16384Gi"),
    ],
)
def test_bytes_are_written_with_the_largest_suffix_that_fits(number: int, text: str) -> None:
    assert binary_quantity(number) == text


@given(st.integers(min_value=1, max_value=2**60))
def test_a_written_number_of_bytes_is_rounded_up_by_less_than_a_kibibyte(number: int) -> None:
    assert 0 <= amount(binary_quantity(number)) - number < 1024

"""How many entries rules take in an engine that divides ranges of ports into blocks."""

from __future__ import annotations

import pytest

from understudy.kube.gates.policy_entries import blocks


@pytest.mark.parametrize(
    ("first", "last", "found"),
    [(1, 65535, 16), (0, 65535, 1), (53, 53, 1), (1, 7949, 19), (8150, 65535, 6), (7936, 8191, 1), (3, 2, 0)],
)
def test_a_range_is_divided_into_the_fewest_blocks(first: int, last: int, found: int) -> None:
    """As measured with Cilium 1.18.4: 16, 19 and 6 for the ranges of all ports and of those beside the gate."""
    assert blocks(first, last) == found

"""Orders and reports are read as they were written, by those who know the token of the workload, and by nobody else."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from understudy.api.protocol.agent_messages import ProtocolError
from understudy.api.protocol.mux_messages import (
    OnBoard,
    Order,
    Report,
    SafeCommand,
    StandingOrder,
    Token,
    derive,
    order_text,
    read_order,
    read_report,
    report_text,
    sealed,
)
from understudy.api.protocol.session_keys import NotAuthentic

KEYS = derive(b"token", "fleet", "robot-17")
TOKENS = st.builds(Token, st.floats(0, 2e9), st.integers(0, 2**31), st.integers(0, 100))
LENGTHS = st.floats(0, 1e6)
NAMES = st.text(max_size=10)
OUTPUTS = st.dictionaries(st.text(max_size=10), LENGTHS, max_size=3)
ORDERS = st.builds(
    Order,
    LENGTHS,
    st.integers(0, 2**31),
    st.text(max_size=20),
    TOKENS,
    st.builds(
        StandingOrder,
        st.lists(NAMES, max_size=3).map(tuple),
        OUTPUTS,
        st.none() | st.builds(OnBoard, NAMES, OUTPUTS),
        st.lists(st.builds(SafeCommand, NAMES, st.just({"a": [1.5, {"b": "now"}]}), LENGTHS), max_size=2).map(tuple),
        st.just(0.25),
    ),
    st.integers(0, 100),
    NAMES,
)
REPORTS = st.builds(
    Report,
    TOKENS,
    st.text(max_size=20),
    st.text(max_size=20),
    st.text(max_size=20),
    st.integers(0, 2**40),
    LENGTHS | st.just(math.inf),
    st.dictionaries(st.text(max_size=10), OUTPUTS, max_size=3),
    st.lists(st.text(max_size=20), max_size=3).map(tuple),
)


@given(ORDERS, NAMES)
def test_an_order_is_read_as_it_was_written(order: Order, nonce: str) -> None:
    standing = order.standing if order.standing.safe else replace(order.standing, safe_after=0.0)
    assert read_order(order_text(order, nonce, KEYS), KEYS) == (replace(order, standing=standing), nonce)


@given(REPORTS)
def test_a_report_is_read_as_it_was_written(report: Report) -> None:
    assert read_report(report_text(report, KEYS), KEYS) == report


@pytest.mark.parametrize("message", [{}, {"token": 5}, {"token": [1.0, 2, 3, 4]}])
def test_a_text_of_another_version_is_refused(message: dict[str, object]) -> None:
    with pytest.raises(ProtocolError, match="the order is of another version"):
        read_order(sealed(message, KEYS.orders), KEYS)
    with pytest.raises(ProtocolError, match="the report is of another version"):
        read_report(sealed(message, KEYS.reports), KEYS)


ORDER = order_text(Order(1.0, 2, "w-1"), "n", KEYS)


@pytest.mark.parametrize(
    "text",
    ["", " ", "{}", ORDER.replace("w-1", "w-2"), ORDER[1:], ORDER + " ", report_text(Report(Token(), "", ""), KEYS)],
)
def test_a_text_that_was_changed_or_is_of_the_other_direction_is_refused(text: str) -> None:
    with pytest.raises(NotAuthentic):
        read_order(text, KEYS)


@pytest.mark.parametrize(
    "other", [(b"other", "fleet", "robot-17"), (b"token", "fleet", "robot-1"), (b"token", "flee", "trobot-17")]
)
def test_a_text_for_another_workload_or_with_another_token_is_refused(other: tuple[bytes, str, str]) -> None:
    with pytest.raises(NotAuthentic):
        read_order(ORDER, derive(*other))

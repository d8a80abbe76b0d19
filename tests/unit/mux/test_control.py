"""Whom a mux forwards: orders only move it forward, and its own switches are never undone by who does not know them."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from understudy.api.protocol.mux_messages import Order, StandingOrder, Token
from understudy.mux.control import Control, Heard, Refused, due_at, ordered, switched

SILENCES = {"/cmd_vel": 0.1, "/fork": 0.5}
STANDING = StandingOrder(successors=("w-2", "w-3", "onboard"), silences=SILENCES)
ORDER = Order(workload_created=1000.0, epoch=5, source="w-1", standing=STANDING)
CONTROL = ordered(Control(), ORDER)


def heard(now: float, *, since: float = 0.0, **ages: float) -> Heard:
    """Instances that were last heard on all outputs so many seconds ago; an underscore stands for a hyphen."""
    last = {name.replace("_", "-"): dict.fromkeys(SILENCES, now - age) for name, age in ages.items()}
    return Heard(since, last)


def test_nobody_is_forwarded_without_an_order() -> None:
    assert Control().source == ""
    assert switched(Control(standing=STANDING), heard(10.0, w_2=0.0), 10.0) is None


def test_an_order_names_who_is_forwarded() -> None:
    assert (CONTROL.source, CONTROL.token) == ("w-1", Token(1000.0, 5, 0))
    closed = ordered(CONTROL, replace(ORDER, epoch=6, source=""))
    assert closed.source == ""


def test_an_order_that_arrives_twice_changes_nothing() -> None:
    assert ordered(CONTROL, ORDER) is CONTROL


def test_an_older_order_is_refused() -> None:
    with pytest.raises(Refused, match="of epoch 4, and the mux has carried out one of epoch 5"):
        ordered(CONTROL, replace(ORDER, epoch=4, source="w-2"))


def test_a_second_order_of_one_epoch_names_nobody_else() -> None:
    with pytest.raises(Refused, match="names w-2, and an earlier one w-1"):
        ordered(CONTROL, replace(ORDER, source="w-2", revision=1))


def test_the_epochs_of_a_workload_that_is_created_again_begin_again() -> None:
    again = ordered(CONTROL, replace(ORDER, workload_created=2000.0, epoch=1, source="w-9"))
    assert again.source == "w-9"
    with pytest.raises(Refused, match="replaced by another one"):
        ordered(again, replace(ORDER, epoch=7))


def test_a_standing_order_is_replaced_within_an_epoch_by_a_newer_one_only() -> None:
    filled = ordered(CONTROL, replace(ORDER, revision=1, standing=StandingOrder(("w-4",), SILENCES)))
    assert filled.standing.successors == ("w-4",)
    assert ordered(filled, replace(ORDER, revision=0)) is filled


@pytest.mark.parametrize("output", SILENCES)
def test_silence_on_one_output_switches_all_of_them(output: str) -> None:
    now = 10.0
    found = heard(now, w_1=0.0, w_2=0.01, w_3=0.0)
    silent = Heard(0.0, {**found.last, "w-1": {**found.last["w-1"], output: now - SILENCES[output]}})
    assert switched(CONTROL, found, now) is None
    switch = switched(CONTROL, silent, now)
    assert switch is not None
    assert (switch.source, switch.token) == ("w-2", Token(1000.0, 5, 1))


def test_a_switch_is_due_when_the_silence_is_long_enough() -> None:
    assert due_at(CONTROL, heard(10.0, w_1=0.0)) == pytest.approx(10.0 + min(SILENCES.values()))
    assert due_at(CONTROL, Heard(since=20.0)) == pytest.approx(20.1), "who was put in control has its time"
    assert due_at(replace(CONTROL, standing=StandingOrder()), Heard(0.0)) == float("inf")


def test_a_successor_that_is_silent_itself_is_passed_over() -> None:
    switch = switched(CONTROL, heard(10.0, w_1=5.0, w_2=0.3, w_3=0.05), 10.0)
    assert switch is not None
    assert switch.source == "w-3"
    assert switched(CONTROL, heard(10.0, w_1=5.0), 10.0) is None


def test_several_failures_without_any_order_are_handled_in_turn() -> None:
    control, found = CONTROL, []
    for now in (10.0, 20.0, 30.0, 40.0):
        others = {
            name: dict.fromkeys(SILENCES, now) for name in ("w-1", "w-2", "w-3", "onboard") if name != control.source
        }
        switch = switched(control, Heard(now - 1.0, others), now)
        if switch is not None:
            control = switch
            found.append((switch.source, switch.token.count))
    assert found == [("w-2", 1), ("w-3", 2), ("onboard", 3)], (
        "and who failed in this epoch does not drive again without an order"
    )


@pytest.mark.parametrize("source", ["", "w-2"])
def test_an_order_that_puts_nobody_else_in_control_needs_no_knowledge_of_a_switch(source: str) -> None:
    local = switched(CONTROL, heard(10.0, w_1=5.0, w_2=0.0), 10.0)
    assert local is not None
    after = ordered(local, replace(ORDER, epoch=6, source=source, knows=Token()))
    assert (after.source, after.token) == (source, Token(1000.0, 6))


def test_a_monitor_that_was_cut_off_does_not_undo_a_switch() -> None:
    local = switched(CONTROL, heard(10.0, w_1=5.0, w_2=0.0), 10.0)
    assert local is not None
    unaware = replace(ORDER, epoch=6, source="w-3", knows=Token(1000.0, 5, 0))
    with pytest.raises(Refused, match=r"switched to w-2 by itself \(switch 1 of epoch 5\)"):
        ordered(local, unaware)
    assert ordered(local, ORDER).source == "w-2", "the old order again neither"
    aware = ordered(local, replace(unaware, knows=local.token))
    assert (aware.source, aware.token) == ("w-3", Token(1000.0, 6, 0))


def test_orders_that_were_lost_do_not_prevent_later_ones() -> None:
    assert ordered(CONTROL, replace(ORDER, epoch=9, source="w-3")).source == "w-3"


names = st.sampled_from(["w-1", "w-2", "w-3", "onboard"])
orders = st.builds(
    Order,
    workload_created=st.sampled_from([1000.0, 2000.0]),
    epoch=st.integers(0, 5),
    source=names | st.just(""),
    knows=st.builds(Token, st.sampled_from([1000.0, 2000.0]), st.integers(0, 5), st.integers(0, 3)),
    standing=st.builds(StandingOrder, st.lists(names, max_size=3).map(tuple), st.just(SILENCES)),
    revision=st.integers(0, 2),
)


@given(steps=st.lists(orders | st.dictionaries(names, st.floats(0, 1), max_size=4), max_size=20))
def test_control_only_moves_forward_and_changes_hands_with_a_new_token_only(
    steps: list[Order | dict[str, float]],
) -> None:
    control, now = Control(), 0.0
    for step in steps:
        before, now = control, now + 1.0
        if isinstance(step, Order):
            try:
                control = ordered(control, step)
            except Refused:
                continue
        else:
            last = {name: dict.fromkeys(SILENCES, now - age) for name, age in step.items()}
            control = switched(control, Heard(now - 1.0, last), now) or control
        assert control.token >= before.token
        if control.source != before.source:
            assert control.token > before.token
        if (
            isinstance(step, Order)
            and before.token.count
            and control.token.workload_created == before.token.workload_created
        ):
            assert control.source == before.source or step.knows >= before.token

"""Whom a mux forwards: orders only move it forward, and its own switches are never undone by who does not know them."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from understudy.api.protocol.mux_messages import OnBoard, Order, SafeCommand, StandingOrder, Token
from understudy.mux.control import Control, Heard, Refused, due_at, ordered, switched, undriven_at

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


HOME = OnBoard("home", {"/cmd_vel": 1.0, "/fork": 1.0})
HOMEWARD = replace(ORDER, standing=StandingOrder(on_board=HOME))


def on_board(order: Order = HOMEWARD) -> Control:
    """The control after the instance of an order has been silent, and the one on board was not."""
    found = switched(ordered(Control(), order), heard(10.0, home=0.0), 10.0)
    assert found is not None
    assert found.source == "home"
    return found


def test_the_instance_on_board_is_forwarded_after_everybody_else() -> None:
    standing = replace(STANDING, on_board=HOME)
    control = ordered(Control(), replace(ORDER, standing=standing))
    assert switched(control, heard(10.0, w_1=0.5, home=0.0), 10.0) is None, "its own silence is longer"
    assert due_at(control, heard(10.0, w_1=0.0)) == pytest.approx(10.1)
    both = switched(control, heard(10.0, w_1=2.0, w_2=0.0, home=0.0), 10.0)
    assert both is not None
    assert both.source == "w-2"
    alone = switched(control, heard(10.0, w_1=2.0, home=0.0), 10.0)
    assert alone is not None
    assert (alone.source, alone.token, alone.on_board) == ("home", Token(1000.0, 5, 1), True)


def test_the_instance_on_board_is_forwarded_without_a_reflex_too() -> None:
    assert on_board().on_board


def test_the_instance_on_board_drives_if_the_gate_was_closed_for_a_recovery_and_nobody_follows() -> None:
    closed = ordered(Control(), replace(HOMEWARD, source=""))
    assert switched(closed, heard(10.5, since=10.0, home=0.0), 10.5) is None
    found = switched(closed, heard(11.0, since=10.0, home=0.0), 11.0)
    assert found is not None
    assert found.source == "home"


def test_nobody_drives_after_a_fence() -> None:
    fenced = ordered(on_board(), replace(ORDER, epoch=6, source="", standing=StandingOrder()))
    assert (fenced.source, fenced.on_board) == ("", False)
    assert switched(fenced, heard(100.0, home=0.0, w_1=0.0), 100.0) is None


def test_successors_do_not_end_that_nobody_is_in_control() -> None:
    closed = ordered(Control(), replace(ORDER, source=""))
    assert switched(closed, heard(100.0, w_2=0.0), 100.0) is None


def test_control_returns_from_on_board_by_an_order_of_the_same_epoch_that_knows_the_switch() -> None:
    control = on_board()
    assert ordered(control, HOMEWARD) is control, "the order that it had"
    assert ordered(control, replace(HOMEWARD, revision=1)).source == "home"
    returned = ordered(control, replace(HOMEWARD, knows=control.token))
    assert (returned.source, returned.token, returned.on_board) == ("w-1", Token(1000.0, 5, 2), False)
    again = switched(returned, heard(20.0, home=0.0), 20.0)
    assert again is not None
    assert (again.source, again.token.count) == ("home", 3)


def test_a_newer_order_replaces_the_instance_on_board_also_without_knowing_of_it() -> None:
    after = ordered(on_board(), replace(HOMEWARD, epoch=6, source="w-3"))
    assert (after.source, after.token, after.on_board) == ("w-3", Token(1000.0, 6), False)


def test_the_instance_on_board_stays_while_a_recovery_has_closed_the_gate() -> None:
    after = ordered(on_board(), replace(HOMEWARD, epoch=6, source=""))
    assert (after.source, after.token, after.on_board) == ("home", Token(1000.0, 6, 1), True)


def test_who_was_cut_off_does_not_take_over_from_the_instance_on_board_by_itself() -> None:
    standing = replace(STANDING, on_board=HOME)
    control = on_board(replace(ORDER, standing=standing))
    assert switched(control, heard(11.0, w_1=0.0, w_2=0.0, home=0.0), 11.0) is None
    silent = switched(control, heard(13.0, w_1=0.0, w_2=0.0, home=2.0), 13.0)
    assert silent is not None
    assert (silent.source, silent.on_board) == ("w-2", False), (
        "but it does if that one is silent, and it was not replaced"
    )


SAFE = StandingOrder(safe=(SafeCommand("/cmd_vel", {}, 0.1),), safe_after=0.2)


def test_safe_commands_begin_when_nobody_is_in_control_for_long_enough() -> None:
    closed = ordered(Control(), replace(ORDER, source="", standing=SAFE))
    assert undriven_at(closed, heard(10.0, since=9.9, w_1=0.0)) == pytest.approx(10.1)
    assert undriven_at(replace(closed, standing=StandingOrder()), heard(10.0)) == float("inf")


def test_safe_commands_begin_during_control_only_if_a_silence_counts_and_on_no_output_is_anybody_heard() -> None:
    idle = ordered(Control(), replace(ORDER, standing=SAFE))
    assert undriven_at(idle, heard(10.0, w_1=9.0)) == float("inf")
    counted = ordered(Control(), replace(ORDER, standing=replace(SAFE, on_board=HOME)))
    last = Heard(0.0, {"w-1": {"/cmd_vel": 5.0, "/fork": 8.0}})
    assert undriven_at(counted, last) == pytest.approx(9.2)


names = st.sampled_from(["w-1", "w-2", "w-3", "onboard"])
orders = st.builds(
    Order,
    workload_created=st.sampled_from([1000.0, 2000.0]),
    epoch=st.integers(0, 5),
    source=names | st.just(""),
    knows=st.builds(Token, st.sampled_from([1000.0, 2000.0]), st.integers(0, 5), st.integers(0, 3)),
    standing=st.builds(
        StandingOrder, st.lists(names, max_size=3).map(tuple), st.just(SILENCES), st.none() | st.just(HOME)
    ),
    revision=st.integers(0, 2),
)


@given(steps=st.lists(orders | st.dictionaries(names | st.just("home"), st.floats(0, 1), max_size=4), max_size=20))
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
            assert control.source in (before.source, "") or step.knows >= before.token or before.on_board

"""The permit's state machine: every event in every state, and how long silence may last."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from understudy.agent import permit
from understudy.agent.permit import FROZEN, Permit, State

NOW = 1000.0


def permit_in(state: State) -> Permit:
    """In a state, with somebody's last answer just now."""
    return Permit(state=state, answered_at=NOW, evaluated_at=NOW)


def pass_time(
    found: Permit, seconds: float, *, since: float = NOW, answer: Callable[[float], bool] | None = None
) -> float:
    """Look and ask as often as is due for so many seconds; when it ended."""
    now = since
    while now < since + seconds:
        now += found.wait
        found.evaluate(now)
        if found.ask(now) != "Nobody" and answer is not None and answer(now):
            found.answered(now)
    return now


def silence(found: Permit) -> None:
    pass_time(found, 3.0)


def answer(found: Permit) -> None:
    found.answered(NOW + 1)


def go(found: Permit) -> None:
    found.instruct("Go", NOW + 1)


def stay(found: Permit) -> None:
    found.instruct("Stay", NOW + 1)


def apiserver_alone(found: Permit) -> None:
    """The API server answers for longer than is waited for a monitor; nobody else does."""

    def reached(now: float) -> bool:
        found.apiserver(now, True)
        return True

    pass_time(found, permit.WITHOUT_MONITOR + 2, answer=reached)


TABLE: dict[State, tuple[State, State, State, State, State]] = {
    #           silence     answer     go         stay        API server alone
    "Idle": ("Idle", "Running", "Idle", "Idle", "Running"),
    "Running": ("Isolated", "Running", "Running", "Running", "Running"),
    "Isolated": ("Isolated", "Reconnected", "Running", "Replaced", "Running"),
    "Reconnected": ("Isolated", "Reconnected", "Running", "Replaced", "Running"),
    "Replaced": ("Replaced", "Replaced", "Running", "Replaced", "Replaced"),
}
EVENTS = [silence, answer, go, stay, apiserver_alone]


@pytest.mark.parametrize("state", TABLE)
@pytest.mark.parametrize("event", EVENTS, ids=lambda event: event.__name__)
def test_every_event_in_every_state_leads_to_the_state_in_the_table(
    state: State, event: Callable[[Permit], None]
) -> None:
    found = permit_in(state)
    event(found)
    assert found.state == TABLE[state][EVENTS.index(event)]
    assert found.frozen is (found.state in FROZEN)


def test_the_table_has_every_state() -> None:
    assert set(TABLE) == set(State.__args__)  # type: ignore[attr-defined]


@pytest.mark.parametrize("phase", [step / 100 for step in range(13)])
def test_silence_is_detected_within_half_a_second_whenever_it_begins(phase: float) -> None:
    found, cut = permit_in("Running"), NOW + 5 + phase
    now = NOW
    while not found.frozen:
        now += found.wait
        found.evaluate(now)
        if found.ask(now) != "Nobody" and now < cut:
            found.answered(now)
        assert now < cut + 2
    assert permit.PATIENCE - permit.RENEW_PERIOD <= now - cut <= 0.5


def test_a_shorter_silence_has_no_effect() -> None:
    found = permit_in("Running")
    pass_time(found, 60, answer=lambda now: now % 1.0 > 0.2)
    assert found.state == "Running"


def test_one_witness_is_asked_while_it_answers_and_otherwise_all() -> None:
    found = permit_in("Running")
    assert found.ask(NOW) == "One"
    assert found.ask(NOW + 0.1) == "Everybody"
    assert found.ask(NOW + 0.2) == "Everybody"
    found.answered(NOW + 0.25)
    assert found.ask(NOW + 0.3) == "One"


def test_a_stalled_process_asks_again_before_it_judges() -> None:
    found = permit_in("Running")
    found.ask(NOW)
    found.ask(NOW + 0.1)
    found.ask(NOW + 0.2)
    found.evaluate(NOW + 8)
    assert found.state == "Running"
    assert found.ask(NOW + 8) == "One"
    pass_time(found, 0.2, since=NOW + 8)
    assert found.state == "Running"
    pass_time(found, 0.5, since=NOW + 8.3)
    assert found.state == "Isolated"


def test_a_replaced_instance_asks_nobody() -> None:
    assert permit_in("Replaced").ask(NOW) == "Nobody"


def test_the_api_server_must_be_reached_all_the_time() -> None:
    found = permit_in("Reconnected")

    def now_and_then(now: float) -> bool:
        found.apiserver(now, (now - NOW) % 20 > 1)
        return True

    pass_time(found, 10 * permit.WITHOUT_MONITOR, answer=now_and_then)
    assert found.state == "Reconnected"


def test_an_instance_that_is_cut_off_again_waits_for_a_new_permit() -> None:
    found = permit_in("Running")
    silence(found)
    found.answered(NOW + 4)
    found.instruct("Go", NOW + 4)
    assert not found.frozen
    pass_time(found, 2, since=NOW + 4)
    assert found.state == "Isolated"


def test_the_last_answer_of_the_monitor_counts() -> None:
    found = permit_in("Reconnected")
    found.instruct("Stay", NOW)
    assert found.state == "Replaced"
    found.instruct("Go", NOW)
    assert found.state == "Running"

"""The system's clock is set, as NTP does after a boot, while the action proxy has goals: none is lost, and none waits for the step."""

from __future__ import annotations

import time
import uuid
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from tests.support.clock import set_clock
from tests.unit.action_proxy.conftest import ACTION, TYPE, eventually
from understudy.action_proxy import goal_ledger
from understudy.action_proxy.client_goals import AttemptState, Phase
from understudy.action_proxy.control_state import ControlState, Peer, TaskRule
from understudy.action_proxy.goal_journal import GoalJournal
from understudy.action_proxy.goal_ledger import GoalAnswer, GoalLedger
from understudy.action_proxy.proxy import Proxy
from understudy.clock import CLOCK
from understudy.ros.runtime.served_node import ServedNode

STEPS = pytest.mark.parametrize("step", [3600.0, -3600.0], ids=["forward", "back"])
RULE = TaskRule(ACTION, TYPE)
PEER = Peer("a", "robot-1", "127.0.0.1", 9, "", "")


def control(active: str = "a") -> ControlState:
    return ControlState("robot", 1, active, True, (RULE,), (PEER,))


def ledger_with_goal(*, accepted: bool) -> tuple[GoalLedger, str]:
    ledger, goal, now = GoalLedger(), uuid.uuid4().hex, CLOCK.now()
    ledger.place(control(), now)
    ledger.ask(ACTION, goal, "", ("client", 1), now)
    ledger.advance(now)
    if accepted:
        ledger.report("a", goal, AttemptState.RUNNING, now)
    return ledger, goal


@pytest.fixture
async def node(dds: None) -> AsyncIterator[ServedNode]:
    served = ServedNode("understudy_tasks_robot")
    yield served
    await served.close()


@pytest.fixture
def journal(tmp_path: Path) -> GoalJournal:
    return GoalJournal(tmp_path / "goals.json")


def goals_in(journal: GoalJournal) -> list[str]:
    return list(journal.load()[0].goals)


@pytest.mark.ros
async def test_a_goal_that_no_instance_decided_on_is_kept(
    node: ServedNode, journal: GoalJournal, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger, goal = ledger_with_goal(accepted=False)
    journal.save(ledger, ())
    proxy = Proxy(node, journal)
    proxy.place(control(active=""))
    set_clock(monkeypatch, 3600.0)
    proxy.place(control(active=""))
    assert goals_in(journal) == [goal]
    await proxy.close()


@STEPS
@pytest.mark.ros
async def test_a_goal_that_an_instance_rejects_is_neither_aborted_nor_left_lying(
    node: ServedNode, journal: GoalJournal, monkeypatch: pytest.MonkeyPatch, step: float
) -> None:
    monkeypatch.setattr(goal_ledger, "AGAIN", 0.05)
    ledger, goal = ledger_with_goal(accepted=True)
    journal.save(ledger, ())
    proxy = Proxy(node, journal)
    proxy.place(control())
    proxy.goal_reported("a", goal, AttemptState.REJECTED, 0, "")
    assert list(proxy.orders("a")) == []
    set_clock(monkeypatch, step)
    (again,) = await eventually(lambda: proxy.orders("a"), 5)
    proxy.goal_reported("a", again.id, AttemptState.REJECTED, 0, "")
    assert proxy.report()["tasks"][0]["active"] == 1
    await proxy.close()


@STEPS
def test_a_message_carries_the_time_of_the_system(monkeypatch: pytest.MonkeyPatch, step: float) -> None:
    ledger, goal = ledger_with_goal(accepted=False)
    set_clock(monkeypatch, step)
    ledger.report("a", goal, AttemptState.RUNNING, CLOCK.now())
    (answer,) = ledger.advance(CLOCK.now())
    assert isinstance(answer, GoalAnswer)
    assert answer.stamp * 1e-9 == pytest.approx(time.time(), abs=1)


@STEPS
def test_a_new_proxy_takes_the_times_of_the_journal_over(
    journal: GoalJournal, monkeypatch: pytest.MonkeyPatch, step: float
) -> None:
    ledger, goal = ledger_with_goal(accepted=True)
    ledger.report("a", goal, AttemptState.REJECTED, CLOCK.now())
    known = ledger.goals[goal]
    set_clock(monkeypatch, step)
    journal.save(ledger, ())
    CLOCK.restart()  # as a new process does
    try:
        found = journal.load()[0].goals[goal]
        assert found.received == pytest.approx(known.received + step, abs=1)
        assert found.refused_since == pytest.approx(known.refused_since + step, abs=1)
        assert found.attempts["a"].after == pytest.approx(known.attempts["a"].after + step, abs=1)
    finally:
        monkeypatch.undo()
        CLOCK.restart()


def test_a_journal_from_the_future_delays_nothing(journal: GoalJournal, monkeypatch: pytest.MonkeyPatch) -> None:
    ledger, goal = ledger_with_goal(accepted=True)
    ledger.report("a", goal, AttemptState.REJECTED, CLOCK.now())
    journal.save(ledger, ())
    set_clock(monkeypatch, -3600.0)  # while no proxy runs
    found = journal.load()[0].goals[goal]
    assert found.received <= CLOCK.now()
    assert found.attempts["a"].after <= CLOCK.now() + 3


def test_a_goal_that_is_adopted_waits_by_the_clock_of_its_adopter() -> None:
    ledger, goal = ledger_with_goal(accepted=False)
    note = ledger.orders("a")[0].note
    later = CLOCK.now() + 3600  # the clock of another node
    successor = GoalLedger()
    successor.place(control(), later)
    successor.adopt("a", goal, note, "", None, later)
    successor.advance(later)
    assert successor.goals[goal].phase is Phase.PENDING

"""The goals outlive the proxy's process, and its pod if there is a volume for that."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

import pytest

from tests.unit.action_proxy.conftest import ACTION, TYPE, eventually
from understudy.action_proxy import goal_journal
from understudy.action_proxy.control_state import ControlState, Peer, TaskRule
from understudy.action_proxy.goal_journal import GoalJournal, LastingCopy
from understudy.action_proxy.goal_ledger import GoalLedger

RULES = (TaskRule(ACTION, TYPE),)
GOAL = "0" * 32


def control(workload: str, active: str = "a") -> ControlState:
    peer = Peer(active, active, "10.0.0.1", 8950, "token", "")
    return ControlState("w", 3, active, True, RULES, (peer,), workload)


def asked(workload: str) -> GoalLedger:
    """A ledger with one goal, which the active instance of a workload must have."""
    ledger = GoalLedger()
    ledger.place(control(workload), 1.0)
    ledger.ask(ACTION, GOAL, "", ("0" * 32, 1), 1.0)
    ledger.advance(1.0)
    assert ledger.orders("a")
    return ledger


async def test_the_next_pod_continues_with_the_copy_on_the_lasting_volume(tmp_path: Path) -> None:
    copy = tmp_path / "kept" / "tasks" / "goals.json"
    GoalJournal(tmp_path / "goals.json", LastingCopy(copy)).save(asked("uid-1"), RULES)
    await eventually(copy.exists, 10)
    elsewhere = GoalJournal(tmp_path / "elsewhere.json", LastingCopy(copy))
    await elsewhere.fetch()
    ledger, rules = elsewhere.load()
    assert (list(ledger.goals), rules) == ([GOAL], RULES)


async def test_a_pod_that_has_a_journal_of_its_own_does_not_take_the_copy(tmp_path: Path) -> None:
    (tmp_path / "copy.json").write_text("{}")
    journal = GoalJournal(tmp_path / "goals.json", LastingCopy(tmp_path / "copy.json"))
    journal.save(asked("uid-1"), RULES)
    await journal.fetch()
    assert list(journal.load()[0].goals) == [GOAL]


async def test_a_lasting_volume_that_hangs_or_cannot_be_used_does_not_keep_the_proxy_from_serving(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(goal_journal, "FETCHED_WITHIN", 0.05)
    slow = LastingCopy(tmp_path / "copy.json")
    monkeypatch.setattr(slow, "read", lambda: time.sleep(0.3))
    await GoalJournal(tmp_path / "goals.json", slow).fetch()
    (tmp_path / "file").write_text("")
    broken = GoalJournal(tmp_path / "goals.json", LastingCopy(tmp_path / "file" / "goals.json"))
    await broken.fetch()
    broken.save(asked("uid-1"), RULES)
    await eventually(lambda: "could not copy the goals" in caplog.text, 10)
    assert list(broken.load()[0].goals) == [GOAL]
    await asyncio.sleep(0.3)


@pytest.mark.parametrize(("workload", "orders"), [("uid-1", 1), ("uid-2", 0)])
def test_a_new_workload_of_the_same_name_does_not_get_the_goals_of_the_deleted_one(
    tmp_path: Path, workload: str, orders: int
) -> None:
    journal = GoalJournal(tmp_path / "goals.json")
    journal.save(asked("uid-1"), RULES)
    ledger, _ = journal.load()
    ledger.place(control(workload, "b"), 2.0)
    ledger.advance(2.0)
    assert len(ledger.orders("b")) == orders

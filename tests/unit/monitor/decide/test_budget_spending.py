"""A budget that is spent: counted in the status, told with the way out, known to the next monitor, and ended by time or by a word."""

from __future__ import annotations

from typing import Any, Literal

import pytest

from tests.support.golden import assert_golden
from tests.support.notices import RecordedNotices
from tests.unit.monitor.cluster_objects import ClusterObjects, policy_of
from understudy.api import names
from understudy.api.kinds.robot_workload import Attempt
from understudy.failover.progress import PodIdentity, Progress, rfc3339
from understudy.monitor.decide.budget_spending import BudgetSpending
from understudy.monitor.notices import PublishedStatus

BUDGET = {"recoveries": 2, "within": "10m"}


class World:
    """A monitor's notices and view, and the workload that a user gives its budget back."""

    def __init__(self, status: dict[str, Any] | None = None) -> None:
        self.notices = RecordedNotices(PublishedStatus.adopt({"status": status or {}}))
        self._objects = ClusterObjects(notices=self.notices)
        self._objects.put_workload()
        self.limit(budget=BUDGET)
        self.spending = BudgetSpending(self._objects.view, self.notices)

    def limit(self, **limits: Any) -> None:
        """Have a policy with these limits."""
        self._objects.put_policy(policy_of(limits=limits))

    def recover(
        self, at: float, result: Literal["Verified", "NotVerified", "NotAvailable"] = "Verified", **more: Any
    ) -> None:
        progress = Progress.begin("it ended", last_healthy=at - 0.5, detected=at, **more)
        progress.attempts.append(Attempt(strategy="Restart", result=result))
        self.spending.count(progress, at + 1)

    def resume(self, at: str) -> None:
        self._objects.put_workload(annotations={names.RESUMED: at})

    @property
    def events(self) -> list[tuple[str, str]]:
        return [(kind, reason) for kind, reason, message in self.notices.events]

    @property
    def budget_condition(self) -> tuple[str, str]:
        found = self.notices.status.find("WithinBudget")
        assert found is not None
        return found.status, found.reason


@pytest.fixture
def world() -> World:
    return World()


def test_a_healthy_workload_reports_once_that_there_is_budget(world: World) -> None:
    world.spending.report(1000.0)
    assert world.budget_condition == ("True", "Left")
    before = world.notices.changes
    world.spending.report(1001.0)
    assert world.notices.changes == before, "no writes"
    assert world.events == []


def test_a_spent_budget_is_reported_with_its_end_and_a_remedy(world: World) -> None:
    world.recover(1000.0)
    assert world.spending.spent_until(1001.0) is None
    world.recover(1060.0)
    assert world.spending.spent_until(1061.0) == 1600.0
    assert world.budget_condition == ("False", "Spent")
    found = world.notices.status.find("WithinBudget")
    assert found is not None
    assert "2 recoveries within 10m" in found.message
    assert "1970-01-01 00:26:40 UTC" in found.message
    assert found.message.endswith("understudy resume -n fleet w")
    assert world.events == [("Warning", "BudgetSpent")]


def test_the_end_of_the_window_is_reported(world: World) -> None:
    for at in (1000.0, 1060.0):
        world.recover(at)
    world.spending.report(1599.0)
    assert world.budget_condition == ("False", "Spent")
    world.spending.report(1600.0)
    assert world.budget_condition == ("True", "Left")
    assert world.events[-1] == ("Normal", "BudgetLeft")


def test_a_resume_restores_the_whole_budget(world: World) -> None:
    for at in (1000.0, 1060.0):
        world.recover(at)
    world.resume(rfc3339(1100.0))
    assert world.spending.resumed == 1100.0
    assert world.spending.spent_until(1101.0) is None
    world.recover(1200.0)
    assert world.spending.spent_until(1201.0) is None
    world.recover(1300.0)
    assert world.spending.spent_until(1301.0) == 1800.0


@pytest.mark.parametrize("resume_time", ["", "soon", "2026-02-30T00:00:00Z"])
def test_an_invalid_resume_time_is_ignored(world: World, resume_time: str) -> None:
    world.resume(resume_time)
    assert world.spending.resumed is None


def test_a_new_monitor_knows_the_spent_budget(world: World) -> None:
    for at in (1000.0, 1060.0):
        world.recover(at)
    later = World(world.notices.status.to_wire())
    assert later.spending.spent_until(1061.0) == 1600.0
    later.spending.report(1061.0)
    assert later.events == [], "it was told already"


def test_a_planned_switchover_spends_no_budget(world: World) -> None:
    for at in (1000.0, 1060.0):
        world.recover(at, planned=True)
    assert world.notices.status.spent == []


def test_a_recovery_without_an_attempt_spends_no_budget_and_a_failed_attempt_does(world: World) -> None:
    world.recover(1000.0, "NotAvailable")
    assert world.notices.status.spent == []
    world.recover(1060.0, "NotVerified")
    assert world.notices.status.spent == [1060.0]


def test_only_as_many_recoveries_as_the_budget_allows_are_stored(world: World) -> None:
    for at in (1000.0, 2000.0, 3000.0):
        world.recover(at)
    assert world.notices.status.spent == [2000.0, 3000.0]


def test_without_a_budget_nothing_is_stored_or_reported(world: World) -> None:
    for at in (1000.0, 1060.0):
        world.recover(at)
    world.limit()
    world.spending.report(1061.0)
    assert world.spending.spent_until(1061.0) is None
    assert world.notices.status.find("WithinBudget") is None
    assert "spent" not in world.notices.status.to_wire()


def test_a_held_recovery_is_reported_in_the_condition_recovering(world: World) -> None:
    for at in (1000.0, 1060.0):
        world.recover(at)
    failed = [PodIdentity(name="w-1", uid="uid-1")]
    world.spending.report_held(Progress.begin("no /cmd_vel", last_healthy=1099.5, detected=1100.0, failed=failed))
    found = world.notices.status.find("Recovering")
    assert found is not None
    assert (found.status, found.reason) == ("False", "BudgetSpent")
    assert_golden("monitor", found.message, "/cmd_vel", "w-1", "limits.budget", "2 recoveries", "10m")
    assert world.events[-1] == ("Warning", "RecoveryHeld")

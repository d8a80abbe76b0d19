"""What is reserved, by what it is for."""

from __future__ import annotations

import pytest

from tests.unit.cli.report import fleet
from tests.unit.cli.report.fleet import DAY
from understudy.cli.report.recovery_records import findings
from understudy.cli.report.reserved_resources import Amounts, requested


def test_pods_are_grouped_by_purpose() -> None:
    found = findings([fleet.whole()], DAY, fleet.pods())
    executing, pool = found.shares
    assert (executing.name, executing.count) == ("Executing", 1)
    assert {role: amounts.cpu for role, amounts in executing.roles.items()} == {
        "control": 0.5,
        "standby": 0.52,
        "monitor": 0.1,
        "discovery": 0.0,
        "pool": 0.0,
    }
    assert (pool.name, pool.count, pool.total) == ("pool spare", 2, Amounts(2.0, 2 * 256 * 2.0**20))


def test_reservations_of_several_robots_are_averaged() -> None:
    executing, _ = findings([fleet.whole(), fleet.quiet()], DAY, fleet.pods()).shares
    assert (executing.count, executing.total.cpu) == (2, pytest.approx(0.56))


def test_finished_and_terminating_pods_are_left_out() -> None:
    pods = fleet.pods()
    pods[0]["status"]["phase"] = "Succeeded"
    pods[1]["metadata"]["deletionTimestamp"] = "2026-11-22T14:06:00Z"
    executing, _ = findings([fleet.whole()], DAY, pods).shares
    assert executing.total.cpu == pytest.approx(0.1)


def test_a_pod_that_requests_nothing_has_nothing_reserved() -> None:
    assert requested({"containers": [{"name": "app"}]}) == Amounts(0.0, 0.0)
    assert requested({"containers": [], "overhead": {"cpu": "250m"}}) == Amounts(0.25, 0.0)

"""What the limits of a policy would do to a failure now, in words."""

from __future__ import annotations

import pytest

from tests.support import fleet
from tests.support.golden import assert_golden
from tests.unit.cli.inspect.explanation_lines import explained_lines, known
from understudy.api import names


@pytest.mark.parametrize(("priority", "waits"), [("Normal", True), ("Safety", False)])
def test_the_cooldown_is_explained_unless_the_priority_overrides_it(priority: str, waits: bool) -> None:
    item = fleet.well()
    policy = fleet.policy(limits={"cooldown": "5m"}, priority=priority)
    others = [i for i in fleet.around(item) if i["kind"] != "FailurePolicy"]
    first = explained_lines(known(item, [*others, policy]))["If it failed now"][0]
    assert_golden("explain", first)
    assert first.startswith("! The monitor would do nothing for another 48 s") is waits
    assert ("limits.cooldown" in first) is waits


def test_a_pause_is_explained_with_owner_and_reason() -> None:
    item = fleet.well()
    item["spec"]["pause"] = {"reason": "a new gripper", "owner": "ann", "until": "2026-11-22T18:00:00Z"}
    first = explained_lines(known(item))["If it failed now"][0]
    assert_golden("explain", first)
    assert first.startswith("! The monitor would do nothing: paused by ann")
    assert all(fact in first for fact in ("a new gripper", "2026-11-22 18:00:00 UTC"))
    item["spec"]["pause"]["until"] = "2026-11-22T14:00:00Z"
    assert "paused" not in explained_lines(known(item))["If it failed now"][0], "that is over"


@pytest.mark.parametrize(
    ("spent", "resumed", "expected"),
    [
        ([], None, None),
        ([100], None, "limits.budget of its policy (2 recoveries within 10m) has 1 left."),
        (
            [100, 60],
            None,
            "! The monitor would fence the failed instance and not replace it: 2 recoveries within 10m were made",
        ),
        ([700, 60], None, "limits.budget of its policy (2 recoveries within 10m) has 1 left."),
        ([100, 60], 30, None),
    ],
)
def test_an_exhausted_budget_is_explained(spent: list[float], resumed: float | None, expected: str | None) -> None:
    item = fleet.well()
    item["status"]["spent"] = [fleet.ago(seconds) for seconds in spent]
    if resumed is not None:
        item["metadata"]["annotations"] = {names.RESUMED: fleet.ago(resumed)}
    policy = fleet.policy(limits={"budget": {"recoveries": 2, "within": "10m"}})
    others = [i for i in fleet.around(item) if i["kind"] != "FailurePolicy"]
    first = explained_lines(known(item, [*others, policy]))["If it failed now"][0]
    assert first.startswith(expected or "✓ 1. Fallback")


def test_a_storm_that_limits_recoveries_is_explained() -> None:
    item, policy = fleet.well(), fleet.policy(limits={"stormGuard": {}})
    policy["status"] = {
        "conditions": [fleet.condition("Storm", "True", "ManyFail", "12 of 20 workloads fail.", since=20).to_wire()]
    }
    others = [i for i in fleet.around(item) if i["kind"] != "FailurePolicy"]
    first = explained_lines(known(item, [*others, policy]))["If it failed now"][0]
    assert_golden("explain", first)
    assert first.startswith("The monitor would use only a standby that is ready"), "there is one"
    assert "12 of 20 workloads fail" in first


def test_a_limit_that_prevents_recovery_is_listed_once_as_missing() -> None:
    item = fleet.well()
    text = "Paused by ann: a new gripper."
    item["status"]["conditions"] = [
        *(c for c in item["status"]["conditions"] if c["type"] != "Protected"),
        fleet.condition("Paused", "True", "Maintenance", text).to_wire(),
        fleet.condition(
            "Protected", "False", "Paused", f"{text} If it failed now, the monitor would do nothing."
        ).to_wire(),
    ]
    found = known(item)
    assert not found.is_well
    (missing,) = explained_lines(found)["Missing"]
    assert_golden("explain", missing)
    assert missing.startswith("✗ not protected (Paused, 4m12s)")
    assert text in missing


def test_a_held_failure_is_explained_with_its_reason() -> None:
    why = "no /plan for 500 ms; localization, on which this workload depends, is Recovering; that one comes first"
    held = fleet.condition("DependencyFailed", "True", "Held", why, since=4)
    item = fleet.workload("planning", status=fleet.status("planning", "x8v2m", 4, held, health="Failed"))
    text = explained_lines(known(item))
    assert text[""][0] == "fleet/planning  Failed for 4s"
    assert text[""][1] == f"{why}."
    assert f"✗ suspended by a dependency (Held, 4s): {why}" in text["Missing"]

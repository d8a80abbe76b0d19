"""What users see in statuses, and what raises an Event."""

from __future__ import annotations

from tests.unit.controller.world import World, policy, workload
from understudy.controller.plan import Problem
from understudy.controller.status import policy_status, workload_status
from understudy.kube.client import Object


def test_a_name_conflict_is_reported_in_both_conditions() -> None:
    problem = Problem("NameTaken", 'NetworkPolicy "w-gate" exists')
    found = World(workload(), policy("Restart"))
    assert found.condition("Accepted", problem)["reason"] == "NameTaken"
    assert found.condition("Reconciled", problem)["message"] == problem.message


def test_a_condition_keeps_its_time_until_its_status_changes() -> None:
    found = World(workload(), policy("Restart"))
    found.build()
    first = workload_status.timed(found.workload, found.status())
    for condition in first["conditions"]:
        condition["lastTransitionTime"] = "2020-01-01T00:00:00Z"
    found.workload["status"] = first
    found.monitors = []
    second = {c["type"]: c for c in workload_status.timed(found.workload, found.status())["conditions"]}
    assert second["Accepted"]["lastTransitionTime"] == "2020-01-01T00:00:00Z"
    assert second["Protected"]["lastTransitionTime"] != "2020-01-01T00:00:00Z"


def test_a_workload_is_ready_if_it_is_accepted_built_and_protected() -> None:
    found = World(workload(), policy("Restart"))
    found.build()
    ready, protected = found.condition("Ready"), found.condition("Protected")
    assert (ready["status"], ready["reason"]) == ("True", protected["reason"]) == ("True", "FirstStrategyReady")
    found.monitors = []
    ready, protected = found.condition("Ready"), found.condition("Protected")
    assert (ready["status"], ready["reason"], ready["message"]) == ("False", "MonitorNotReady", protected["message"])
    taken = Problem("NameTaken", 'NetworkPolicy "w-gate" exists')
    assert found.condition("Ready", taken)["reason"] == "NameTaken", "the first reason, and not what follows from it"


def test_every_condition_has_a_message() -> None:
    found = World(workload(), policy("Restart"))
    assert all(one["message"] for one in found.status()["conditions"])
    found.build()
    assert all(one["message"] for one in found.status()["conditions"])


def test_a_policy_is_ready_if_it_is_accepted() -> None:
    for item in (policy("Restart"), policy()):
        accepted, ready = (
            next(
                one
                for one in policy_status.status(item, pools={}, config_maps={}, users=[])["conditions"]
                if one["type"] == type_
            )
            for type_ in ("Accepted", "Ready")
        )
        assert {**ready, "type": "Accepted"} == accepted


class TestTransitions:
    def event_count(self, before: list[tuple[str, str, str]], after: tuple[str, str, str]) -> int:
        def wire(found: tuple[str, str, str]) -> Object:
            return {"type": found[0], "status": found[1], "reason": found[2]}

        live = {"status": {"conditions": [wire(found) for found in before]}}
        return len(workload_status.transitions(live, {"conditions": [wire(after)]}))

    def test_a_start_that_is_not_finished_causes_no_event(self) -> None:
        assert self.event_count([], ("Protected", "False", "MonitorNotReady")) == 0
        assert (
            self.event_count([("Protected", "False", "MonitorNotReady")], ("Protected", "False", "StandbyNotReady"))
            == 0
        )

    def test_an_improvement_that_is_not_finished_causes_no_event(self) -> None:
        assert self.event_count([("Ready", "False", "NoMatchingWorkload")], ("Ready", "False", "PodsNotReady")) == 0

    def test_lost_protection_causes_an_event(self) -> None:
        assert (
            self.event_count([("Protected", "True", "FirstStrategyReady")], ("Protected", "False", "StandbyNotReady"))
            == 1
        )

    def test_a_dry_pool_causes_no_event_because_the_waiting_workloads_report_it(self) -> None:
        assert self.event_count([("Available", "True", "Available")], ("Available", "False", "Dry")) == 0

    def test_ready_causes_no_event_because_it_repeats_another_condition(self) -> None:
        lost = {"status": "False", "reason": "PoolEmpty", "message": "none"}
        desired = {"conditions": [{"type": "Ready", **lost}, {"type": "Protected", **lost}]}
        assert [one["type"] for one in workload_status.transitions({}, desired)] == ["Protected"]

    def test_invalid_input_causes_an_event_at_once(self) -> None:
        assert self.event_count([], ("Accepted", "False", "PolicyNotFound")) == 1

    def test_an_unchanged_condition_causes_no_event(self) -> None:
        assert self.event_count([("Accepted", "False", "PolicyNotFound")], ("Accepted", "False", "PolicyNotFound")) == 0

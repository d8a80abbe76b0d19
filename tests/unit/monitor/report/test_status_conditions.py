"""What the status says of a workload that is watched."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.unit.monitor.cluster_objects import policy_of
from tests.unit.monitor.gates import Packets
from tests.unit.monitor.monitors import GivenMonitor
from understudy.failover.interfaces import GateState, Instance
from understudy.monitor.judge.stage import Judgement
from understudy.trees.core.health_tree import Verdict
from understudy.trees.core.leaf import State


@pytest.fixture
def monitor(tmp_path: Path) -> GivenMonitor:
    """The monitor of a workload that a ready standby could take over."""
    found = GivenMonitor(tmp_path)
    found.objects.put_workload(generation=7)
    found.objects.put_policy(policy_of({"type": "Fallback", "poolRef": {"name": "hot"}}))
    found.objects.put_settings(pools=[{"name": "hot", "readiness": "Executing"}])
    found.objects.put_pods(
        Instance("w-1", "uid-1", running=True, ready=True),
        Instance("w-2", "uid-2", pool="hot", running=True, ready=True),
    )
    found.objects.put_gate(GateState(epoch=3, active="w-1", active_uid="uid-1"))
    return found


@pytest.mark.parametrize(
    ("received", "condition", "events"),
    [
        ({}, ("True", "Watching", "Watching /scan."), []),
        ({"waiting": "/plan"}, ("Unknown", "WaitingForTopics", "/plan"), []),
        ({"problems": ("no type.",), "waiting": "/plan"}, ("False", "NotWatched", "no type."), ["NotWatched"]),
        (
            {"problems": ("no type.",), "unsafe": ("my_msgs is not installed.",)},
            ("False", "TypeNotInstalled", "no type. my_msgs is not installed."),
            ["TypeNotInstalled"],
        ),
    ],
)
def test_the_condition_monitored_reports_whether_everything_is_received(
    monitor: GivenMonitor, received: dict[str, Any], condition: tuple[str, str, str], events: list[str]
) -> None:
    monitor.observer.troubles = list(received.get("problems", ()))
    monitor.observer.unpublished = [received["waiting"]] if "waiting" in received else []
    monitor.loop.act.safety.problems = list(received.get("unsafe", ()))
    monitor.loop.report.status_conditions.housekeeping()
    notices = monitor.notices
    assert notices.conditions["Monitored"] == condition
    assert notices.reasons == events
    monitored = notices.status.find("Monitored")
    assert monitored is not None
    assert (monitored.observed_generation, notices.status.strategy) == (7, "Executing")


@pytest.mark.parametrize(
    ("state", "degraded", "health", "status"),
    [
        ("Healthy", False, "Healthy", "True"),
        ("Healthy", True, "Degraded", "True"),
        ("Failed", True, "Failed", "False"),
        ("Starting", False, "Starting", "Unknown"),
    ],
)
def test_a_degraded_instance_is_still_healthy(
    monitor: GivenMonitor, state: State, degraded: bool, health: str, status: str
) -> None:
    verdict = Verdict(state, "why", "leaf", None)
    monitor.loop.report.judged(Judgement(0.0, verdict=verdict, degraded=degraded))
    assert (monitor.notices.status.health, monitor.notices.status.active) == (health, "w-1")
    assert monitor.notices.conditions["Healthy"] == (status, state, "why")


def test_a_healthy_instance_beside_an_unknown_sender_is_not_reported_as_healthy(monitor: GivenMonitor) -> None:
    report = monitor.loop.report
    report.status_conditions._sole_driver.strangers = ("/cmd_vel by /teleop",)
    report.judged(Judgement(0.0, verdict=Verdict("Healthy", "why", "leaf", None)))
    assert monitor.notices.status.health == "Degraded"
    assert monitor.notices.conditions["Healthy"][:2] == ("Unknown", "UnknownSender")
    assert "/cmd_vel by /teleop" in monitor.notices.conditions["Healthy"][2]
    report.judged(Judgement(0.0, verdict=Verdict("Failed", "why", "leaf", None)))
    assert monitor.notices.conditions["Healthy"] == ("False", "Failed", "why")


def test_whether_the_gate_is_enforced_is_reported_before_the_policy_can_be_read(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found = GivenMonitor(tmp_path)
    found.objects.put_workload()
    found.objects.put_pods(Instance("w-1", "uid-1", running=True, ready=True))
    found.objects.put_gate(GateState(epoch=3, active="w-1", active_uid="uid-1"))
    away = ("False", "NoMux", "No mux reports at the robot.")
    monkeypatch.setattr(Packets, "reported", lambda self, active: away)
    assert found.view.policy is None
    found.loop._housekeeping()
    assert found.notices.conditions["GateEnforced"] == away

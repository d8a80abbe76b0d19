"""What the status says of a workload that is watched."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from tests.support.notices import RecordedNotices
from understudy.failover.interfaces import GateState
from understudy.monitor.judge.stage import Judgement
from understudy.monitor.report.status_conditions import StatusConditions
from understudy.trees.core.health_tree import Verdict


def said(
    notices: RecordedNotices, *, problems: tuple[str, ...] = (), unsafe: tuple[str, ...] = (), waiting: str = ""
) -> StatusConditions:
    parts: list[Any] = [
        SimpleNamespace(object={"metadata": {"generation": 7}}),
        SimpleNamespace(state=GateState(epoch=3, active="w-1", active_uid="uid-1")),
        SimpleNamespace(problems=problems, waiting=[waiting] if waiting else [], summary="Watching /scan."),
        SimpleNamespace(problems=unsafe),
        SimpleNamespace(usable=lambda: "Executing"),
        notices,
    ]
    return StatusConditions(*parts)


@pytest.mark.parametrize(
    ("seen", "condition", "events"),
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
def test_whether_all_of_it_is_seen(seen: dict[str, Any], condition: tuple[str, str, str], events: list[str]) -> None:
    notices = RecordedNotices()
    said(notices, **seen).housekeeping()
    assert notices.conditions["Monitored"] == condition
    assert [reason for _, reason, _ in notices.events] == events
    assert (notices.status.find("Monitored").observed_generation, notices.status.strategy) == (7, "Executing")


@pytest.mark.parametrize(
    ("state", "degraded", "health", "status"),
    [
        ("Healthy", False, "Healthy", "True"),
        ("Healthy", True, "Degraded", "True"),
        ("Failed", True, "Failed", "False"),
        ("Starting", False, "Starting", "Unknown"),
    ],
)
def test_an_instance_that_is_degraded_is_healthy_still(state: Any, degraded: bool, health: str, status: str) -> None:
    notices = RecordedNotices()
    said(notices).judged(Judgement(0.0, verdict=Verdict(state, "why", "leaf", None), degraded=degraded))
    assert (notices.status.health, notices.status.active) == (health, "w-1")
    assert notices.conditions["Healthy"] == (status, state, "why")

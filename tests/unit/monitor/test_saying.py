"""What the status says of a workload that is watched."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from tests.unit.monitor.test_trying_again import Told
from understudy.failover.interfaces import GateState
from understudy.monitor.report.status_conditions import Saying
from understudy.trees.core.health_tree import Verdict


class Reporter(Told):
    """Has the fields of the status too."""

    def __init__(self) -> None:
        super().__init__()
        self.fields: dict[str, Any] = {}
        self.generation: int | None = None

    def set(self, **fields: Any) -> None:
        self.fields |= fields

    def look(self, item: object) -> None:
        return


def said(
    reporter: Reporter, *, problems: tuple[str, ...] = (), unsafe: tuple[str, ...] = (), waiting: str = ""
) -> Saying:
    parts: list[Any] = [
        SimpleNamespace(object={"metadata": {"generation": 7}}),
        SimpleNamespace(state=GateState(epoch=3, active="w-1", active_uid="uid-1")),
        SimpleNamespace(problems=problems, waiting=[waiting] if waiting else [], summary="Watching /scan."),
        SimpleNamespace(problems=unsafe),
        SimpleNamespace(usable=lambda: "Executing"),
        reporter,
    ]
    return Saying(*parts)


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
    reporter = Reporter()
    said(reporter, **seen).housekeeping()
    assert reporter.conditions["Monitored"] == condition
    assert [reason for _, reason, _ in reporter.events] == events
    assert (reporter.generation, reporter.fields["strategy"]) == (7, "Executing")


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
    reporter = Reporter()
    said(reporter).health(Verdict(state, "why", "leaf", None), degraded=degraded)
    assert (reporter.fields["health"], reporter.fields["active"]) == (health, "w-1")
    assert reporter.conditions["Healthy"] == (status, state, "why")

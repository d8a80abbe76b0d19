"""How a workload's state becomes a status of /diagnostics."""

from __future__ import annotations

from typing import Any, get_args

import pytest

pytest.importorskip("rclpy")

from tests.unit.monitor.diagnosed_tree import TREE
from understudy.api.kinds.robot_workload import GateStatus, Health, Moments, Parts, Recovery
from understudy.monitor.notices import Notices, PublishedStatus
from understudy.monitor.report.diagnostics_status import LEVELS, LONGEST, Details, status, workload_state
from understudy.ros.actions.diagnostics_topic import Status

NONE: Any = None
MORE = Details("navigation", "Executing (1/1)", {"/amcl_pose": 98.5}, TREE)


@pytest.fixture
def notices() -> Notices:
    made = Notices()
    made.set(active="w-1", health="Healthy", strategy="Executing", gate=GateStatus(epoch=3, active="w-1"))
    return made


def diagnostics(notices: Notices, more: Details = MORE) -> Status:
    return status("fleet", "robot-1-drive", workload_state(notices.status, 100.0), notices.status, more)


def test_every_health_has_a_level() -> None:
    assert set(get_args(Health)) <= LEVELS.keys()


def test_a_healthy_workload_reports_its_active_instance_and_standby(notices: Notices) -> None:
    found = diagnostics(notices)
    assert (found.level, found.name, found.hardware) == (0, "understudy: robot-1-drive", "fleet/robot-1-drive")
    assert found.message == "w-1 is in control"
    assert dict(found.values) == {
        "health": "Healthy",
        "in control": "w-1",
        "gate epoch": "3",
        "policy": "navigation",
        "if it failed now": "Executing",
        "standby": "Executing (1/1)",
        "recoveries": "0",
        "kept /amcl_pose: age (s)": "1.5",
        "leaf scan": "Healthy",
        "leaf cmd_vel": "Failed: no /cmd_vel for 500 ms",
    }


@pytest.mark.parametrize(
    ("health", "level", "condition", "message"),
    [
        ("Starting", 1, ("Healthy", "Unknown", "Starting", "waiting for the first /scan"), "waiting for the first /scan"),
        ("Starting", 1, None, "no instance has been healthy yet"),
        ("Degraded", 1, ("Degraded", "True", "NotWell", "/scan came at 7 Hz"), "/scan came at 7 Hz"),
        ("Degraded", 1, None, "it is degraded"),
        ("Failed", 2, ("Healthy", "False", "Failed", "no /scan for 1 s"), "no /scan for 1 s"),
        ("Failed", 2, ("Recovering", "False", "Waiting", "no /scan; tried again in 8 s."), "no /scan; tried again in 8 s."),
        ("Failed", 2, ("Recovering", "False", "Recovered", "w-1 took over"), "it has failed"),
        ("Recovering", 2, ("Recovering", "True", "FailureDetected", "pod w-1 is gone"), "pod w-1 is gone"),
        ("Recovering", 1, ("Recovering", "True", "Rescheduling", "/scan came at 7 Hz"), "/scan came at 7 Hz"),
        ("Unknown", 3, ("Healthy", "False", "Failed", "no /scan for 1 s"),
         "the health is unknown: no policy is in effect, or no instance is running"),
    ],
)  # fmt: skip
def test_the_message_is_the_reason_for_the_health(
    notices: Notices, health: Any, level: int, condition: tuple[str, str, str, str] | None, message: str
) -> None:
    if condition is not None:
        notices.condition(*condition)
    notices.set(health=health)
    found = diagnostics(notices)
    assert (found.level, found.message) == (level, message)


def test_the_reason_for_an_earlier_instance_is_not_repeated(notices: Notices) -> None:
    notices.condition("Healthy", "False", "Failed", "no /scan for 1 s")
    notices.set(active="", health="Starting")
    assert diagnostics(notices).message == "no instance has been healthy yet"


def test_the_last_recovery_is_reported_with_its_times() -> None:
    last = Recovery(
            id="r", number=3, reason="no /cmd_vel for 500 ms", result="Recovered", strategy="Fallback/Executing",
            recovery_seconds=0.5814, parts=Parts(detection=0.5, cluster=0.006, startup=0, reinitialization=0.0754),
            moments=Moments(detected="2026-01-02T14:02:11.000000Z"),
        )  # fmt: skip
    notices = Notices(PublishedStatus(recoveries=(last,), count=3))
    notices.set(active="w-1", health="Healthy")
    values = dict(diagnostics(notices).values)
    assert {key: value for key, value in values.items() if key.startswith("last recovery")} == {
        "last recovery": "Recovered by Fallback/Executing",
        "last recovery: reason": "no /cmd_vel for 500 ms",
        "last recovery: detected": "2026-01-02T14:02:11.000000Z",
        "last recovery: took (s)": "0.581",
        "last recovery: detection (s)": "0.500",
        "last recovery: cluster (s)": "0.006",
        "last recovery: startup (s)": "0.000",
        "last recovery: reinitialization (s)": "0.075",
    }


def test_long_texts_are_cut(notices: Notices) -> None:
    notices.condition("Recovering", "False", "NothingVerified", "tried\nin vain " * 200)
    notices.set(health="Failed")
    found = diagnostics(notices)
    assert len(found.message) == LONGEST
    assert "\n" not in found.message
    assert found.message.endswith("...")

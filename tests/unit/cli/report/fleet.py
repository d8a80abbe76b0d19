"""Robots with a past: of one all is known, of one the older records are gone, one failed in vain, one has names and messages that
are markup, one has had nothing.
"""

from __future__ import annotations

from typing import Any

from tests.support import fleet
from tests.support.fleet import NOW, ago, condition
from tests.unit.controller import world
from understudy.api import names
from understudy.api.kinds.robot_workload import Attempt, Moments, Recovery
from understudy.cli.report.recovery_records import Span

DAY = Span(NOW - 86400, NOW)

HOSTILE = """=HYPERLINK("x")</title></script><script>alert(1)</script><img src=x onerror='alert(1)'>\u202e"""

Object = dict[str, Any]


def robot(
    name: str,
    recoveries: list[Recovery],
    *conditions: Any,
    ever: int | None = None,
    since: float = 172800.0,
    **more: Any,
) -> Object:
    """A RobotWorkload that was made so many seconds ago."""
    count = len(recoveries) if ever is None else ever
    item = fleet.workload(
        name, status=fleet.status(name, "x8v2m", 41, *conditions, recoveries=recoveries, recovery_count=count, **more)
    )
    item["metadata"]["creationTimestamp"] = ago(since)[:19] + "Z"
    return item


def failed(number: int, seconds_ago: float, reason: str = "no /cmd_vel for 500 ms", **more: Any) -> Recovery:
    """A recovery in which no strategy was verified."""
    attempts = [
        Attempt(strategy="Fallback/Executing", result="NotAvailable", message="no standby is ready"),
        Attempt(strategy="Restart", pod="robot-z9", result="NotVerified", message="no output within 60 s"),
    ]
    defaults: dict[str, Any] = {
        "result": "Failed", "strategy": "", "recovery_seconds": None, "attempts": attempts, "new": "", "reason": reason,
        "parts": (0.5, 3.5, 60.0, 0.0),
        "moments": Moments(last_healthy=ago(seconds_ago), detected=ago(seconds_ago - 0.5)),
    }  # fmt: skip
    return fleet.recovery(number, seconds_ago, **(defaults | more))


def restart(number: int, seconds_ago: float, **more: Any) -> Recovery:
    return fleet.recovery(number, seconds_ago, strategy="Restart", parts=(0.502, 1.832, 0.758, 0.590), **more)


def switchover(number: int, seconds_ago: float) -> Recovery:
    moments = Moments(
        last_healthy=ago(seconds_ago), detected=ago(seconds_ago), last_output=ago(seconds_ago - 0.004),
        routed=ago(seconds_ago - 0.008), first_output=ago(seconds_ago - 0.044),
    )  # fmt: skip
    return fleet.recovery(
        number, seconds_ago, parts=(0.0, 0.008, 0.0, 0.0), planned=True, switchover="Failover", moments=moments
    )


def whole() -> Object:
    """Recovered three times by its standby, once by a restart, and handed over as planned."""
    found = [fleet.recovery(5 - n, 3600.0 * (n + 1), parts=(0.503, 0.006 + n / 1000, 0.0, 0.0)) for n in range(3)]
    return robot("robot-1-drive", [*found, restart(2, 30000.0), switchover(1, 40000.0)])


def forgetful() -> Object:
    """Of twelve recoveries ten are kept, the oldest of them ten hours old."""
    found = [fleet.recovery(12 - n, 3600.0 * (n + 1)) for n in range(10)]
    return robot("robot-2-drive", found, ever=12)


def in_vain() -> Object:
    """Failed an hour ago, and healthy again half an hour ago."""
    return robot(
        "robot-3-drive",
        [failed(2, 3600.0), restart(1, 50000.0)],
        condition("Healthy", "True", "Healthy", since=1800.0),
        condition("Protected", "False", "NoStandby", "no standby is ready", since=3600.0),
    )


def hostile() -> Object:
    return robot("robot-4-drive", [failed(1, 600.0, HOSTILE)], condition("Protected", "False", "NoStandby", HOSTILE))


def quiet() -> Object:
    return robot("robot-5-drive", [], since=7200.0)


def robots() -> list[Object]:
    return [whole(), forgetful(), in_vain(), hostile(), quiet()]


def pods() -> list[Object]:
    """Of the first robot, and what waits in a pool that is shared: the stand-in's answer to every selector."""
    return [
        pod("robot-1-drive-x8v2m", names.WORKLOAD, "robot-1-drive"),
        pod("robot-1-drive-w7h5k", names.WORKLOAD, "robot-1-drive", agent="20m"),
        pod("robot-1-drive-monitor-1", names.MONITORED, "robot-1-drive", cpu="100m"),
        pod("spare-1", names.POOL, "spare", cpu="1"),
        pod("spare-2", names.POOL, "spare", cpu="1"),
        pod("robot-1-59dd", "app", "robot-1"),
    ]


def pod(name: str, label: str, value: str, *, cpu: str = "500m", agent: str = "") -> Object:
    made = world.pod(name, labels={label: value, **({names.COMPONENT: "monitor"} if label == names.MONITORED else {})})
    resources = {"requests": {"cpu": cpu, "memory": "256Mi"}}
    made["spec"] = {"containers": [{"name": "app", "resources": resources}]}
    if agent:
        lasting = {"name": names.AGENT_CONTAINER, "restartPolicy": "Always", "resources": {"requests": {"cpu": agent}}}
        made["spec"]["initContainers"] = [lasting, {"name": "copy", "resources": {"requests": {"cpu": "4"}}}]
    return made

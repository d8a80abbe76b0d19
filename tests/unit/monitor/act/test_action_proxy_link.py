"""The monitor sends the state of control to the action proxy, and reports what it receives."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from tests.support.agents import PRIVATE_KEY
from tests.support.notices import RecordedNotices
from understudy.action_proxy.control_state import ControlState
from understudy.action_proxy.monitor_socket import MonitorSocket
from understudy.api.kinds.robot_workload import Health, RobotWorkloadSpec
from understudy.api.protocol.monitor_settings import PoolChoice, WorkloadSettings
from understudy.api.protocol.secure_channel import MonitorSecret
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import PodIdentity
from understudy.monitor.act.action_proxy_link import CONDITION, ActionProxyLink, executing, judged, reachable, settled

GATE = GateState(epoch=3, active="w-1", active_uid="1")
ACTIVE = Instance("w-1", "1", ip="10.0.0.1", running=True)
STANDBY = Instance("w-2", "2", ip="10.0.0.2", running=True, pool="hot")
TASK = {"action": "/goto", "type": "test_msgs/action/Fibonacci", "abortGrace": "1500ms"}


class Source:
    """Of changes."""

    def __init__(self) -> None:
        self._changed = asyncio.Event()

    def notify(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()

    async def changed(self) -> None:
        await self._changed.wait()


@dataclass
class View:
    """Everything that the link reads."""

    spec: RobotWorkloadSpec | None
    settings: WorkloadSettings
    pod_deleted: bool = False
    me: PodIdentity | None = None
    workload: str = "w"
    gates: Source = field(default_factory=Source)
    pods: Source = field(default_factory=Source)

    @property
    def pod_watches(self) -> list[Source]:
        return [self.pods]


@dataclass
class World:
    """Stands for fleet, gate, agents and notices."""

    instances: list[Instance]
    state: GateState = GATE
    health: Health = "Healthy"
    unanswered_since: float | None = None
    drove_on_board: bool = False
    deleted: set[str] = field(default_factory=set)
    """UIDs of pods whose deletion their watch has not reported."""
    pods: Source = field(default_factory=lambda: Source())
    notices: RecordedNotices = field(default_factory=RecordedNotices)

    def __post_init__(self) -> None:
        self.notices.set(health=self.health)

    def of_workload(self) -> list[Instance]:
        return self.instances

    def find(self, uid: str) -> Instance | None:
        return next((i for i in self.instances if i.uid == uid), None)

    async def look_at(self, instance: Instance) -> None:
        self.instances = [replace(i, terminating=True) if i.uid in self.deleted else i for i in self.instances]
        self.pods.notify()

    async def secret(self, instance: Instance) -> MonitorSecret:
        return MonitorSecret(f"token of {instance.name}".encode(), PRIVATE_KEY)


def view(*tasks: dict[str, Any], problem: str = "", **more: Any) -> View:
    spec = {
        "template": {"spec": {"containers": [{"name": "app", "image": "app"}]}},
        "outputs": [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}],
        "failurePolicyRef": {"name": "p"},
        "tasks": list(tasks),
        **more,
    }
    settings = WorkloadSettings(
        workload="w",
        namespace="n",
        uid="u",
        source_kind="ReplicaSet",
        source_name="w",
        tasks_problem=problem,
        pools=[PoolChoice(name="hot", readiness="Executing")],
    )
    return View(RobotWorkloadSpec.model_validate(spec), settings)


async def eventually(holds: Any, within: float = 20.0) -> None:
    end = time.monotonic() + within
    while not holds():
        assert time.monotonic() < end, f"not within {within} s"
        await asyncio.sleep(0.02)


@pytest.fixture
def socket(tmp_path: Path) -> Path:
    return tmp_path / "tasks.sock"


def link(socket: Path, task_view: View, world: World) -> asyncio.Task[None]:
    made = ActionProxyLink(socket, task_view, world, world, world, world.notices, world)  # type: ignore[arg-type]
    return asyncio.create_task(made.run())


async def test_the_proxy_receives_every_change_and_its_report_is_shown_even_if_it_starts_late(socket: Path) -> None:
    world, task_view = World([ACTIVE, STANDBY]), view(TASK)
    running = link(socket, task_view, world)
    states: list[ControlState] = []
    tasks = [{"action": "/goto", "active": 2, "resent": 1, "message": "", "served": True}]
    talk = MonitorSocket(states.append, lambda: {"tasks": tasks, "epoch": 3})
    server = await talk.listen(socket)
    await eventually(lambda: states)
    first = states[0]
    assert (first.workload, first.epoch, first.active, first.settled) == ("w", 3, "1", True)
    assert (first.rules[0].action, first.rules[0].on_failover, first.rules[0].abort_grace) == ("/goto", "Resend", 1.5)
    assert [(p.pod, p.ip, p.token, p.key, p.executing) for p in first.peers] == [
        ("w-1", "10.0.0.1", "token of w-1", PRIVATE_KEY.hex(), False),
        ("w-2", "10.0.0.2", "token of w-2", PRIVATE_KEY.hex(), True),
    ]
    await eventually(lambda: world.notices.status.task_statuses and world.notices.conditions)
    assert (world.notices.status.task_statuses[0].active, world.notices.status.task_statuses[0].resent) == (2, 1)
    assert world.notices.conditions[CONDITION][:2] == ("True", "Serving")
    assert states[-1].is_confirmed
    world.unanswered_since = 1.0
    await eventually(lambda: not states[-1].is_confirmed)
    world.notices.set(health="Recovering")
    await eventually(lambda: not states[-1].settled)
    world.state = GateState(epoch=4, active="w-2", active_uid="2")
    await eventually(lambda: states[-1].active == "2" and states[-1].epoch == 4)
    tasks[0]["message"] = "robots_msgs/action/Dock is not installed"
    talk.send_state()
    await eventually(lambda: world.notices.conditions[CONDITION][:2] == ("False", "TypeNotInstalled"))
    assert [event[1] for event in world.notices.events] == ["TypeNotInstalled"]
    server.close()
    running.cancel()


async def test_a_pod_whose_application_aborts_a_goal_is_looked_at_because_its_watch_may_be_late(socket: Path) -> None:
    """Its application has received the signal to end. The abort would count as the end of the goal (seed 2251198)."""
    world, task_view = World([ACTIVE, STANDBY], deleted={"1"}), view(TASK)
    task_view.pods = world.pods
    running = link(socket, task_view, world)
    states: list[ControlState] = []
    task = {"action": "/goto", "active": 1, "unasked": 0, "resent": 0, "message": "", "served": True}
    talk = MonitorSocket(states.append, lambda: {"tasks": [task], "epoch": 3})
    server = await talk.listen(socket)
    await eventually(lambda: states)
    assert states[-1].settled
    task["unasked"] = 1
    talk.send_state()
    await eventually(lambda: not states[-1].settled, within=5.0)
    server.close()
    running.cancel()


async def test_a_workload_without_tasks_has_no_condition_about_them(socket: Path) -> None:
    world = World([ACTIVE])
    world.notices.condition(CONDITION, "True", "Serving", "")
    running = link(socket, view(), world)
    await eventually(lambda: CONDITION not in world.notices.conditions)
    running.cancel()


async def test_a_reference_with_tasks_reports_that_there_is_no_proxy(socket: Path) -> None:
    world = World([ACTIVE])
    task_view = view(TASK, problem="no agent there", template=None, workloadRef={"kind": "Deployment", "name": "arm"})
    running = link(socket, task_view, world)
    await eventually(lambda: world.notices.conditions.get(CONDITION) == ("False", "NoAgent", "no agent there"))
    running.cancel()


def test_goals_are_sent_to_running_instances_with_an_agent() -> None:
    assert reachable(ACTIVE, GATE)
    assert reachable(replace(ACTIVE, terminating=True), GATE), "its word counts until the switch"
    for other in ({"terminating": True}, {"held": True}, {"running": False}, {"has_agent": False}, {"ip": ""}):
        assert not reachable(replace(STANDBY, **other), GATE)


def test_only_standbys_of_executing_pools_and_own_pods_are_executing() -> None:
    assert executing(STANDBY, GATE, {"hot"})
    assert executing(replace(STANDBY, pool=""), GATE, {"hot"}), "the controller's own, while a standby is in control"
    assert not executing(STANDBY, GATE, set())
    assert not executing(ACTIVE, GATE, {"hot"})
    assert not executing(replace(STANDBY, claim="u/1"), GATE, {"hot"})


def test_an_instance_is_settled_if_it_is_active_and_does_not_fail_or_recover() -> None:
    assert settled("Healthy", ACTIVE)
    assert settled("Starting", ACTIVE)
    assert not settled("Failed", ACTIVE)
    assert not settled("Recovering", ACTIVE)
    assert not settled("Healthy", None)
    assert not settled("Healthy", replace(ACTIVE, terminating=True))


def test_a_proxy_that_serves_nothing_yet_is_starting() -> None:
    assert judged([], "")[:2] == ("Unknown", "Starting")


def test_the_condition_reports_the_state_of_the_tasks() -> None:
    task = {"action": "/goto", "message": "", "served": True}
    assert judged([task], "")[:2] == ("True", "Serving")
    assert judged([{**task, "served": False}], "")[:2] == ("Unknown", "Starting")
    assert judged([task], "container app sets it itself")[:2] == ("False", "OwnProfiles")
    assert judged([{**task, "message": "refused"}], "")[1:] == ("GoalsNotSent", "/goto: refused")
    missing = {**task, "message": "my/action/Go is not installed"}
    assert judged([missing], "")[1:] == ("TypeNotInstalled", "spec.tasks: /goto: my/action/Go is not installed")

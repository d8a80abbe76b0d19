"""Clients keep their goals while the instances that work on them fail, and while the task proxy itself is restarted.

Server and client are written with rclpy as users write them, and run in pods of their own.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.conftest import SYSTEM
from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import eventually, never, only_mux

NODES = Path(__file__).parents[1] / "unit" / "action_proxy" / "nodes.py"
IMAGE = "localhost/understudy-monitor:dev"
ACTION, TYPE = "/goto", "test_msgs/action/Fibonacci"
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
NAME = "worker"


def container(role: str, *arguments: str, name: str = "app", action: str = ACTION, **environment: str) -> Object:
    return {
        "name": name,
        "image": IMAGE,
        "imagePullPolicy": "IfNotPresent",
        "command": ["python3", "/nodes/nodes.py", role, action, *arguments],
        "env": [{"name": key, "value": value} for key, value in {"HOME": "/tmp", **environment}.items()],
        "securityContext": {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}},
        "volumeMounts": [{"name": "nodes", "mountPath": "/nodes"}],
    }


NODES_VOLUME: Object = {"name": "nodes", "configMap": {"name": "nodes"}}


class Cell:
    """A workload with a task, its policy, and clients."""

    gap = "1s"
    """How long its output may be silent."""

    def __init__(self, kubectl: Kubectl, strategy: str, *other_tasks: Object, gate_kind: str = "NetworkPolicy") -> None:
        self.kubectl, self._gate_kind = kubectl, gate_kind
        self._other_tasks = other_tasks
        config = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "nodes"}}
        kubectl.apply(
            [config | {"data": {"nodes.py": NODES.read_text()}}, *self._protection(strategy), self._workload()]
            + ([only_mux(NAME)] if gate_kind == "Mux" else [])
        )

    @property
    def told(self) -> str:
        """The reason that the condition of the tasks has when all is as well as it can be."""
        return "TypeNotInstalled" if self._other_tasks else "Serving"

    def tasks(self) -> list[Object]:
        """``spec.tasks``."""
        return [{"action": ACTION, "type": TYPE}, *self._other_tasks]

    def containers(self) -> list[Object]:
        """The application."""
        return [container("serve", STEP="0.1", TALK="/cmd_vel")]

    def recovery(self) -> Object | None:
        """What is done to the instance that takes over."""
        return None

    def _workload(self) -> Object:
        template = {
            "spec": {
                "terminationGracePeriodSeconds": 1,
                "securityContext": {"runAsNonRoot": True, "seccompProfile": {"type": "RuntimeDefault"}},
                "containers": self.containers(),
                "volumes": [NODES_VOLUME],
            }
        }
        return {
            "apiVersion": "understudy.dev/v1alpha1",
            "kind": "RobotWorkload",
            "metadata": {"name": NAME, "labels": {"app": NAME}},
            "spec": {
                "template": template,
                "ros": {"domainId": 7},
                "outputs": [{"topic": "/cmd_vel", "type": "std_msgs/msg/String"}],
                "tasks": self.tasks(),
                "failurePolicyRef": {"name": NAME},
                "gate": {"kind": self._gate_kind},
            },
        }

    def _protection(self, strategy: str) -> list[Object]:
        def custom(kind: str, spec: Object) -> Object:
            version = "understudy.dev/v1alpha1"
            return {"apiVersion": version, "kind": kind, "metadata": {"name": NAME}, "spec": spec}

        selector = {"matchLabels": {"app": NAME}}
        pool: Object = {"readiness": strategy, "workloadSelector": selector}
        if strategy == "Executing":
            pool["perWorkload"] = 1
        else:
            pool |= {"replicas": 2, "templateFrom": {"workload": NAME}}
        fallback: Object = {"type": "Fallback", "poolRef": {"name": NAME}, "verifyWithin": "60s"}
        if recovery := self.recovery():
            fallback["recovery"] = recovery
        strategies = [fallback, {"type": "Restart"}]
        tree = {"topic": {"name": "/cmd_vel", "gap": self.gap}}
        policy = {"monitoring": {"yaml": tree}, "strategies": strategies, "limits": {"cooldown": "1s"}}
        return [custom("FailurePolicy", policy), custom("FallbackPool", pool)]

    def status(self) -> Object:
        found: Object = self.kubectl.get("robotworkload", NAME).get("status") or {}
        return found

    def condition(self, type_: str) -> Object:
        return next((c for c in self.status().get("conditions") or [] if c["type"] == type_), {})

    def task(self) -> Object:
        """How the first one is doing."""
        return (self.status().get("tasks") or [{}])[0]

    def wait_protected(self) -> str:
        def protected() -> str | None:
            fine = self.condition("Protected").get("status") == "True"
            serving = self.condition("TasksProxied").get("reason") == self.told
            return self.status().get("active") if fine and serving else None

        active: str = eventually(protected, within=150, what="protected, and its tasks served", note=self.describe)
        return active

    def proxy_pod(self) -> str:
        """The pod of the monitor and the task proxy."""
        selector = f"understudy.dev/monitored={NAME},understudy.dev/component=monitor"
        found: str = self.kubectl.list("pods", selector)[0]["metadata"]["name"]
        return found

    def client(self, name: str, *orders: str, action: str = ACTION) -> Client:
        spec = {
            "restartPolicy": "Never",
            "terminationGracePeriodSeconds": 0,
            "containers": [
                container("client", *orders, action=action)
                | {"envFrom": [{"configMapRef": {"name": f"{NAME}-robot-env"}}]}
            ],
            "volumes": [NODES_VOLUME, {"name": "profiles", "configMap": {"name": f"{NAME}-robot-profiles"}}],
        }
        mounts: list[Object] = spec["containers"][0]["volumeMounts"]  # type: ignore[index]
        mounts.append({"name": "profiles", "mountPath": "/etc/understudy"})
        self.kubectl.apply([{"apiVersion": "v1", "kind": "Pod", "metadata": {"name": name}, "spec": spec}])
        return Client(self, name)

    def events(self, pod: str, container: str = "app") -> list[dict[str, Any]]:
        """What the application in a pod has said."""
        return lines(self.kubectl("logs", pod, "-c", container))

    def describe(self) -> str:
        texts = [self.kubectl("get", "pods", "-o", "wide"), json.dumps(self.status(), indent=1)]
        logs = ("logs", f"deployment/{NAME}-monitor", "--tail=30", "-c")
        texts += [self.kubectl(*logs, who) for who in ("tasks", "monitor")]
        return "\n".join(texts)


def lines(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines() if line.startswith("{")]


class Client:
    """A pod that has sent goals."""

    def __init__(self, cell: Cell, name: str) -> None:
        self.cell, self.name = cell, name

    def said(self, event: str, **fields: Any) -> list[dict[str, Any]]:
        found = lines(self.cell.kubectl("logs", self.name))
        return [e for e in found if e["event"] == event and fields.items() <= e.items()]

    def wait(self, event: str, within: float, **fields: Any) -> dict[str, Any]:
        found: dict[str, Any] = eventually(
            lambda: (self.said(event, **fields) or [None])[0],
            within=within,
            what=f"{self.name} says {event} {fields}",
            note=self.cell.describe,
        )
        return found


@pytest.mark.long
def test_goals_outlive_two_instances_and_the_proxys_restart_with_held_pods(kubectl: Kubectl, gate_kind: str) -> None:
    def restart_the_proxy(pod: str) -> None:
        stop = "import os, signal; os.kill(1, signal.SIGTERM)"
        kubectl("exec", pod, "-c", "tasks", "--", "python3", "-c", stop)

    outlives(Cell(kubectl, "Uninitialized", gate_kind=gate_kind), restart_the_proxy)


def test_goals_outlive_two_instances_and_the_proxys_pod_with_a_standby(kubectl: Kubectl, gate_kind: str) -> None:
    cell = Cell(kubectl, "Executing", {"action": "/dock", "type": "robots_msgs/action/Dock"}, gate_kind=gate_kind)

    def move_the_proxy(pod: str) -> None:
        kubectl("delete", "pod", pod, "--wait=true")

    outlives(cell, move_the_proxy)
    assert "/dock: robots_msgs/action/Dock is not installed" in cell.condition("TasksProxied")["message"]


def outlives(cell: Cell, disturb: Callable[[str], None]) -> None:
    """Two goals, two instances that die one after the other, and in between what ``disturb`` does to the proxy's pod."""
    kubectl, first = cell.kubectl, cell.wait_protected()
    client = cell.client("client", "300", "301")
    client.wait("feedback", 90, index=1)
    goals = {line["goal"] for line in client.said("answered", accepted=True)}
    assert len(goals) == 2
    assert {e["goal"] for e in cell.events(first) if e["event"] == "executing"} == goals, "under the client's own ids"

    kubectl("delete", "pod", first, "--grace-period=0", "--force", "--wait=false")
    second = eventually(
        lambda: (active := cell.status().get("active")) not in ("", first, None) and active,
        within=90,
        what="another instance in control",
        note=cell.describe,
    )
    eventually(
        lambda: {e["goal"] for e in cell.events(second) if e["event"] == "executing"} == goals,
        within=60,
        what="both goals are executed there",
        note=cell.describe,
    )
    assert client.said("ended") == []

    disturb(cell.proxy_pod())
    cell.wait_protected()

    kubectl("delete", "pod", second, "--wait=false")
    for index in (0, 1):
        assert client.wait("ended", 150, index=index)["status"] == SUCCEEDED
    assert len(client.said("answered")) == 2
    third = cell.status()["active"]
    assert third not in (first, second)
    executed = [e["goal"] for e in cell.events(third) if e["event"] == "executing"]
    assert sorted(executed) == sorted(goals), "each of them once"
    eventually(lambda: cell.task().get("active") == 0, within=30, what="no goal is active", note=cell.describe)
    assert cell.task()["resent"] >= 2, "those since the proxy is in its present pod"


CARRY, CARRYING = "/carry", "/carrying"


class Fates(Cell):
    """Two tasks that are treated differently at a failover. The tree that brings up the next instance wants to see the second
    one's goal worked on there, behind the closed gate.
    """

    gap = "4s"  # what is looked at is one failover, and on a machine that is busy no other

    def __init__(self, kubectl: Kubectl) -> None:
        super().__init__(kubectl, "Uninitialized", {"action": CARRY, "type": TYPE, "onFailover": "Tree"})

    def tasks(self) -> list[Object]:
        return [task | {"onFailover": task.get("onFailover", "Abort")} for task in super().tasks()]

    @property
    def told(self) -> str:
        return "Serving"

    def containers(self) -> list[Object]:
        carry = container("serve", name="carry", action=CARRY, STEP="0.1", TALK_WORKING=CARRYING)
        return [*super().containers(), carry]

    def recovery(self) -> Object:
        working = {"wait_for": {"topic": CARRYING, "type": "std_msgs/msg/String", "within": "40s"}}
        return {"within": "50s", "yaml": {"sequence": [{"resend_goals": {}}, working]}}


@pytest.mark.long
@pytest.mark.shows("step/resend_goals", "step/wait_for")
def test_a_goal_is_aborted_or_sent_by_the_recovery_tree_as_its_task_says(kubectl: Kubectl) -> None:
    cell = Fates(kubectl)
    first = cell.wait_protected()
    going, carrying = cell.client("going", "450"), cell.client("carrying", "400", action=CARRY)
    for client in (going, carrying):
        client.wait("feedback", 90, index=0)
    (goal,) = {line["goal"] for line in carrying.said("answered", accepted=True)}

    kubectl("delete", "pod", first, "--grace-period=0", "--force", "--wait=false")
    recovery = eventually(
        lambda: next((r for r in cell.status().get("recoveries") or [] if r["result"] == "Recovered"), None),
        within=120,
        what="another instance in control",
        note=cell.describe,
    )
    second = recovery["toPod"]
    assert recovery["strategy"] == "Fallback/Uninitialized", "its tree saw the goal worked on before the gate opened"

    executed = [e["goal"] for e in cell.events(second, "carry") if e["event"] == "executing"]
    assert executed == [goal], "once, under its client's id"
    assert going.wait("ended", 60, index=0)["status"] == ABORTED
    never([e for e in cell.events(second) if e["event"] == "executing"], "it is sent again")
    assert carrying.wait("ended", 150, index=0)["status"] == SUCCEEDED
    assert len(carrying.said("answered")) == 1
    assert cell.condition("TasksProxied")["status"] == "True"


def test_the_action_proxy_of_a_replaced_monitor_ends(kubectl: Kubectl) -> None:
    """As on a node that counts as lost: the monitor's pod lives on beside the next one."""
    cell = Cell(kubectl, "Executing")
    cell.wait_protected()
    first = cell.proxy_pod()
    template = kubectl.get("deployment", f"{NAME}-monitor")["spec"]["template"]
    second = template | {"apiVersion": "v1", "kind": "Pod", "metadata": template["metadata"] | {"name": "second"}}
    # Nobody else may create a pod with a monitor's labels.
    operator = f"--as=system:serviceaccount:{SYSTEM}:understudy-operator"
    kubectl("create", "-f", "-", operator, given=json.dumps(second))

    def has_ended() -> bool:
        said = kubectl("logs", first, "-c", "tasks")  # of the next container, if that runs already
        return "has replaced this one" in said or "this one waits until it is gone" in said

    eventually(
        has_ended,
        within=60,
        what="the first proxy ends",
        note=lambda: "\n".join(kubectl("logs", pod, "-c", "tasks") for pod in (first, "second")),
    )

"""A team with an application of its own, which is none of the examples: from its Deployments to a robot that survives a failure."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.console import shell_environment, understudy
from tests.e2e.kubectl import Kubectl
from tests.e2e.scenario import eventually

IMAGE = "localhost/understudy-quickstart:dev"
HEIGHT, COMMAND = "/mast/height", "/mast/command"

LIFT = f"""\
import rclpy
from std_msgs.msg import Float64

rclpy.init()
node = rclpy.create_node("lift")
publisher = node.create_publisher(Float64, "{COMMAND}", 1)
height = 0.0


def measured(message):
    global height
    height = message.data


node.create_subscription(Float64, "{HEIGHT}", measured, 1)
node.create_timer(0.05, lambda: publisher.publish(Float64(data=0.5 * (1.0 - height))))
rclpy.spin(node)
"""
MAST = f"""\
import time

import rclpy
from std_msgs.msg import Float64

rclpy.init()
node = rclpy.create_node("mast")
publisher = node.create_publisher(Float64, "{HEIGHT}", 1)
height, last = 0.0, None


def command(message):
    global height, last
    now = time.monotonic()
    if last is None or now - last > 0.2:
        print("the first command" if last is None else f"no command for {{now - last:.3f}} s", flush=True)
    height, last = height + 0.05 * message.data, now


node.create_subscription(Float64, "{COMMAND}", command, 1)
node.create_timer(0.05, lambda: publisher.publish(Float64(data=height)))
rclpy.spin(node)
"""


def deployment(name: str, strategy: str) -> dict[str, Any]:
    secure = {"runAsNonRoot": True, "runAsUser": 1000, "seccompProfile": {"type": "RuntimeDefault"}}
    container = {
        "name": "main",
        "image": IMAGE,
        "imagePullPolicy": "IfNotPresent",
        "args": ["python3", f"/code/{name}.py"],
        "securityContext": {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}},
        "volumeMounts": [{"name": "code", "mountPath": "/code"}],
    }
    pod = {
        "terminationGracePeriodSeconds": 2,
        "securityContext": secure,
        "containers": [container],
        "volumes": [{"name": "code", "configMap": {"name": "code"}}],
    }
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": name},
        "spec": {
            "strategy": {"type": strategy},
            "selector": {"matchLabels": {"app": name}},
            "template": {"metadata": {"labels": {"app": name}}, "spec": pod},
        },
    }


@pytest.mark.alone  # its times are those of a robot that has the machine for itself
def test_a_team_protects_its_own_deployment_with_the_commands_that_init_prints(
    kubectl: Kubectl, kubeconfig: Path, tmp_path: Path
) -> None:
    code = {"lift.py": LIFT, "mast.py": MAST}
    kubectl.apply(
        [
            {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "code"}, "data": code},
            deployment("lift", "RollingUpdate"),
            deployment("mast", "Recreate"),
        ]
    )
    written = understudy(
        kubectl, "init", "deployment/lift", "--robot", "deployment/mast", "--output", f"{COMMAND}=std_msgs/msg/Float64",
        "--watch", HEIGHT, "--write", str(tmp_path / "lift"),
    )  # fmt: skip
    assert written.returncode == 0
    steps = [line.strip() for line in written.stderr.splitlines() if line.startswith("  ")]
    assert 1 + len(steps) <= 10
    environment = shell_environment(kubeconfig, tmp_path, namespace=kubectl.namespace)
    for step in steps:
        done = subprocess.run(
            ["bash", "-c", step], env=environment, capture_output=True, text=True, timeout=320, check=False
        )
        print(step, done.stdout, done.stderr, sep="\n")
        assert done.returncode == 0, step

    def recoveries() -> list[dict[str, Any]]:
        status = kubectl.get("robotworkload", "lift").get("status") or {}
        return [one for one in status.get("recoveries") or [] if one["result"] != "Running"]

    active = kubectl.get("robotworkload", "lift")["status"]["active"]
    assert active
    kubectl("delete", "pod", active, "--grace-period=0", "--force")
    eventually(lambda: bool(recoveries()), within=30, what="the failure is recovered")
    assert (recoveries()[0]["strategy"], recoveries()[0]["result"]) == ("Fallback/Executing", "Recovered")
    output = kubectl("logs", "deployment/mast")
    assert "the first command" in output

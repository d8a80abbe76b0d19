"""A procedure that localizes a robot, for tests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.unit.agent.conftest import Pod

NODES = str(Path(__file__).parent / "nodes.py")


OUTPUTS = [{"topic": "/cmd_vel", "type": "std_msgs/msg/String"}]


TREE = {"topic": {"name": "/cmd_vel", "gap": "300ms"}}


WITHIN = 60.0


def run(pod: Pod, *arguments: str) -> subprocess.Popen[bytes]:
    """A node in the pod."""
    return pod.keep(subprocess.Popen([sys.executable, NODES, *arguments], stdout=subprocess.DEVNULL))


def localize(pod: Pod) -> subprocess.Popen[bytes]:
    return run(pod, "localize")

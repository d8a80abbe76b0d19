"""Processes of an example as they run in their pods, over loopback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from understudy_demo.robotview import RobotLog, parse

REPOSITORY = Path(__file__).parents[3]
SOURCES = (
    REPOSITORY / "operator",
    *(REPOSITORY / "examples" / name / "src" for name in ("navigation", "manipulation")),
)
SEED = 7


class Run:
    """Processes of one test, in a ROS domain of their own, with their outputs in files."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder = folder
        self._stack = stack
        self._environment = {
            k: v for k, v in os.environ.items() if not k.startswith(("ROS_", "FASTRTPS_", "FASTDDS_"))
        } | {
            "PYTHONPATH": os.pathsep.join(map(str, SOURCES)),
            "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
            "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_DOMAIN_ID": os.environ.get("ROS_DOMAIN_ID") or str(10 + os.getpid() % 80),
            "NAVIGATION_SEED": str(SEED),
            "ROBOT_LOG": str(folder / "robot.jsonl"),
            "NAVIGATION_CLIENT_LOG": str(folder / "client.jsonl"),
        }

    def start(self, name: str, *command: str) -> subprocess.Popen[bytes]:
        output = self._stack.enter_context((self.folder / f"{name}.out").open("wb"))
        process = subprocess.Popen(
            [sys.executable, *command], env=self._environment, stdout=output, stderr=subprocess.STDOUT
        )
        self._stack.callback(stop, process)
        return process

    def records(self, name: str) -> list[dict[str, Any]]:
        """What a process has said, in JSON."""
        lines = (self.folder / f"{name}.out").read_text().splitlines(keepends=True)
        return [json.loads(line) for line in lines if line.startswith("{") and line.endswith("\n")]

    def log(self) -> RobotLog:
        file = self.folder / "robot.jsonl"
        return parse(file.read_text() if file.exists() else "")

    def wait(self, what: str, condition: Callable[[], object], *, within: float = 30.0) -> None:
        end = time.monotonic() + within
        while not condition():
            if time.monotonic() > end:
                outputs = "\n".join(f"{f.name}:\n{f.read_text()[-1500:]}" for f in self.folder.glob("*.out"))
                pytest.fail(f"not within {within} s: {what}\n{outputs}")
            time.sleep(0.1)


def stop(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.kill()
    process.wait(10)

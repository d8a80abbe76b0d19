"""Processes of an example as they run in their pods, over loopback, for the tests of every example."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from understudy_demo.robotview import RobotLog, parse


class Run:
    """Processes of one test, in a ROS domain of their own, with their outputs in files."""

    def __init__(self, folder: Path, stack: ExitStack, sources: Sequence[Path], **environment: str) -> None:
        self.folder = folder
        self._stack = stack
        self.environment = {
            k: v for k, v in os.environ.items() if not k.startswith(("ROS_", "FASTRTPS_", "FASTDDS_", "NAVIGATION_"))
        } | {
            "PYTHONPATH": os.pathsep.join(map(str, sources)),
            "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            # A domain of its own for each run; 2 to 9 and 90 up are left to others.
            "ROS_DOMAIN_ID": os.environ.get("ROS_DOMAIN_ID") or str(10 + os.getpid() % 80),
            "ROBOT_LOG": str(folder / "robot.jsonl"),
            **environment,
        }

    def start(self, name: str, *command: str, **more: str) -> subprocess.Popen[bytes]:
        """Start a process of Python; ``more`` is for its environment."""
        output = self._stack.enter_context((self.folder / f"{name}.out").open("ab"))
        process = subprocess.Popen(
            [sys.executable, *command], env=self.environment | more, stdout=output, stderr=subprocess.STDOUT
        )
        self._stack.callback(self.end, process)
        return process

    def end(self, process: subprocess.Popen[bytes]) -> None:
        """End a process when the test is over."""
        stop(process)

    def output(self, name: str) -> str:
        """What a process has said; of several of one name, all that they have."""
        file = self.folder / f"{name}.out"
        return file.read_text() if file.exists() else ""

    def records(self, name: str) -> list[dict[str, Any]]:
        """What a process has said, in JSON."""
        lines = self.output(name).splitlines(keepends=True)
        return [json.loads(line) for line in lines if line.startswith("{") and line.endswith("\n")]

    def log(self) -> RobotLog:
        file = self.folder / "robot.jsonl"
        return parse(file.read_text() if file.exists() else "")

    def wait(self, what: str, condition: Callable[[], Any], *, within: float = 30.0) -> Any:
        """What the condition gave when it was met."""
        end = time.monotonic() + within
        while not (found := condition()):
            if time.monotonic() > end:
                outputs = "\n".join(f"{f.name}:\n{f.read_text()[-3000:]}" for f in self.folder.glob("*.out"))
                pytest.fail(f"not within {within} s: {what}\n{outputs}")
            time.sleep(0.05)
        return found


def stop(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.kill()
    process.wait(10)

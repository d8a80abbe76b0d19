"""The navigation example on the cluster: a robot that is driven through a list of goals while its stack is taken away.

The result is read from three logs: the robot's (commands with their senders, where it really was), the client's (its
goals and their results) and the workload's status.
"""

from __future__ import annotations

import json
import math
import re
from bisect import bisect_left
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from understudy_demo.robotview import RobotLog

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import Robot, eventually
from understudy.api import names
from understudy.ros.dds.host_ids import VENDOR, host_id

EXAMPLES = Path(__file__).parents[2] / "examples"
CONTAINER = "navigation"

CONFIGURATIONS = {
    "restart": "Restart",
    "pod-started": "Fallback/Uninitialized",
    "stack-started": "Fallback/Initialized",
    "localization-running": "Fallback/Initialized",
    "executing": "Fallback/Executing",
}
"""The paper's five configurations (its section IV-B), by the name of the manifest, and what each recovers by."""

GOAL_TOLERANCE = 0.25
"""Metres from the goal that the stack's controller calls reached; what it believes, so localization's error adds to it."""

LOCALIZING = re.compile(r"localizing from (?P<x>-?[\d.]+), (?P<y>-?[\d.]+), heading -?[\d.]+ at (?P<time>[\d.]+)")
"""What the stack's localization logs with the first pose after it received its own."""

LOCATE = """
import math, sys, time
import rclpy
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
rclpy.init()
node = rclpy.create_node("locate")
truth, errors = [], []
def believed(m):
    stamp = m.header.stamp.sec + m.header.stamp.nanosec / 1e9
    near = min(truth, key=lambda t: abs(t[0] - stamp), default=None)
    if near is not None and abs(near[0] - stamp) < 0.15:
        p = m.pose.pose.position
        errors.append(math.hypot(p.x - near[1], p.y - near[2]))
node.create_subscription(PoseStamped, "/ground_truth/pose", lambda m: truth.append(
    (m.header.stamp.sec + m.header.stamp.nanosec / 1e9, m.pose.position.x, m.pose.position.y)), 10)
node.create_subscription(PoseWithCovarianceStamped, "/amcl_pose", believed,
    QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
end = time.monotonic() + float(sys.argv[1])
while time.monotonic() < end and len(errors) < 40:
    rclpy.spin_once(node, timeout_sec=0.1)
print(len(errors), max(errors, default=0.0))
"""
"""Run in a pod of the stack: how far its own localization is from where the robot really is."""


@dataclass
class Goal:
    """One goal as its client saw it."""

    number: int
    x: float
    y: float
    z: float = 0.0
    heading: float = 0.0
    identity: str = ""
    asked: int = 0
    """How often the client sent it."""
    status: str = ""
    """Empty while there is no result."""
    ended: float = 0.0
    silence: float = 0.0
    """Longest time without feedback in seconds."""


@dataclass
class Tour:
    """What the client wrote down."""

    wanted: int = 0
    goals: list[Goal] = field(default_factory=list)
    done: bool = False

    @property
    def running(self) -> Goal | None:
        """The goal that it waits for."""
        return self.goals[-1] if self.goals and not self.goals[-1].status and self.goals[-1].identity else None

    @classmethod
    def read(cls, text: str) -> Tour:
        """From the client's log."""
        tour = cls()
        for line in text.splitlines():
            if not line.startswith("{"):
                continue
            record: dict[str, Any] = json.loads(line)
            match record["event"]:
                case "client":
                    tour.wanted = record["goals"]
                case "goal":
                    place = [record[name] for name in ("x", "y", "z") if name in record]
                    tour.goals.append(Goal(record["number"], *place, heading=record.get("heading", 0.0)))
                case "answer":
                    tour.goals[-1].asked += 1
                    tour.goals[-1].identity = record["goal"] if record["accepted"] else ""
                case "result":
                    goal = tour.goals[-1]
                    goal.status, goal.ended = record["status"], record["time"]
                    goal.silence = record.get("silence", 0.0)
                case "summary":
                    tour.done = True
        return tour


class Navigator(Robot):
    """A mobile robot with its navigation stack and a client."""

    EXAMPLE = "navigation"
    """Its folder, and what its manifests and modules are named after."""
    FOLDER = "manifests"
    """The folder of the example that has the workload and the robot."""
    LOCATED_IN = names.AGENT_CONTAINER
    """The container in which a pod's localization is looked at: that of the stack has no memory to spare."""
    POSES = 6
    """How many poses a localization publishes in 20 s at least."""

    def __init__(self, kubectl: Kubectl, name: str = "robot-1") -> None:
        super().__init__(kubectl, name)
        self.workload = f"{name}-{self.EXAMPLE}"
        self._manifests = EXAMPLES / self.EXAMPLE / "manifests"
        self._hosts: dict[str, str] = {}

    # -- setting up -------------------------------------------------------------------------------------------------

    def set_up(self, configuration: str, *, edit: Callable[[list[Object]], None] | None = None) -> None:
        """Apply policy, pool, workload and robot; ``edit`` may change the objects first."""
        found = [item for file in self._files(configuration) for item in yaml.safe_load_all(file.read_text()) if item]
        for item in found:
            if item["kind"] == "RobotWorkload":
                item["spec"]["failurePolicyRef"] = {"name": f"{self.EXAMPLE}-{configuration}"}
        if edit:
            edit(found)
        self.kubectl.apply(found)

    def _files(self, configuration: str) -> Iterable[Path]:
        """The manifests of a configuration."""
        beside = self._manifests.parent / self.FOLDER
        return self._manifests / f"strategies/{configuration}.yaml", beside / "workload.yaml", beside / "robot.yaml"

    def begin(self) -> None:
        """Forget what happened so far, and the client of an earlier test."""
        self.kubectl("delete", "job", f"{self.name}-client", "--ignore-not-found")
        super().begin()

    def wait_protected(self, within: float = 240.0) -> str:
        """Wait until the stack is healthy, which without a goal commands nothing, and its first strategy's resources are available.

        Returns the active pod.
        """

        def ready() -> str | None:
            status = self.status()
            self._note_hosts()
            held = self.condition("Protected").get("status") == "True"
            active: str = status.get("active", "")
            return active if held and status.get("health") == "Healthy" else None

        pod: str = eventually(ready, within=within, what=f"{self.workload} is healthy and protected", every=1.0,
                              note=self.describe)  # fmt: skip
        return pod

    def send_client(self, goals: int, tour: int | None = None, *, within: float | None = None) -> None:
        """Have a client send so many goals, one after the other, and wait for each as many seconds."""
        (job,) = yaml.safe_load_all((self._manifests / "client.yaml").read_text())
        container = job["spec"]["template"]["spec"]["containers"][0]
        container["command"] = ["python3", "-m", f"{self.EXAMPLE}_client", "--goals", str(goals)]
        container["command"] += ["--tour", str(tour)] if tour is not None else []
        container["command"] += ["--within", str(within)] if within is not None else []
        self.kubectl.apply([job])

    # -- looking ----------------------------------------------------------------------------------------------------

    def tour(self) -> Tour:
        """The client's goals so far."""
        return Tour.read(self.kubectl("logs", f"job/{self.name}-client", "--tail=-1"))

    def wait_driving(self, within: float = 60.0, *, beyond: int = 0) -> Goal:
        """Wait until the robot moves to a goal after the ``beyond``-th; that goal."""

        def driving() -> Goal | None:
            goal = self.tour().running
            moving = any(abs(m.speed) > 0.1 for m in self.log(tail=20).motions[-3:])
            return goal if goal and goal.number > beyond and moving else None

        goal: Goal = eventually(driving, within=within, what="the robot drives to a goal", note=self.describe)
        return goal

    def wait_done(self, within: float) -> Tour:
        """Wait for the client's summary."""
        tour: Tour = eventually(
            lambda: (t := self.tour()).done and t, within=within, what="the client is done", every=1.0,
            note=lambda: f"{self.tour()}\n{self.describe()}",
        )  # fmt: skip
        return tour

    def log(self, tail: int = 0) -> RobotLog:
        """What the robot wrote down, its commands by pod."""
        self._note_hosts()
        return super().log(tail).renamed(self._hosts)

    def _note_hosts(self) -> None:
        """Which pod has which host id, also of pods that are gone by the time the log is read."""
        for pod in self.pods():
            if ip := pod["status"].get("podIP"):
                self._hosts[(VENDOR + host_id(ip)).hex()] = pod["metadata"]["name"]

    def localization_error(self, pod: str) -> float:
        """How far a pod's stack is off with where it believes the robot, in metres: the most in four seconds."""
        graph: dict[str, str] = self.kubectl.get("configmap", f"{self.workload}-robot-env")["data"]
        environment = [f"{name}={value}" for name, value in graph.items() if not name.startswith("FASTRTPS")]
        command = ("env", *environment, "python3", "-c", LOCATE, "20")
        said = self.kubectl("exec", pod, "-c", self.LOCATED_IN, "--", *command, timeout=60).split()
        assert int(said[0]) >= self.POSES, f"{pod} hardly says where the robot is: {said[0]} poses in 20 s"
        return float(said[1])

    def first_localization_error(self, pod: str, since: float) -> float:
        """How far a pod's localization was off in the first pose that it published after it received its own, in metres.

        Told since that moment (unix seconds); by its own log, which says that pose and its time.
        """

        def said() -> tuple[float, float, float] | None:
            found = LOCALIZING.finditer(self.kubectl("logs", pod, "-c", CONTAINER, "--tail=-1"))
            poses = [(float(m["time"]), float(m["x"]), float(m["y"])) for m in found]
            return next((pose for pose in poses if pose[0] >= since), None)

        time, x, y = eventually(said, within=20, what=f"{pod} says from where it localizes", note=self.describe)
        motions = sorted(self.log().motions, key=lambda m: m.time)
        index = min(max(1, bisect_left(motions, time, key=lambda m: m.time)), len(motions) - 1)
        before, after = motions[index - 1], motions[index]
        assert before.time - 0.5 < time < after.time + 0.5, f"the robot's log has nothing of {time}"
        part = (time - before.time) / (after.time - before.time)
        return math.hypot(x - before.x - part * (after.x - before.x), y - before.y - part * (after.y - before.y))

    def carried(self, number: int) -> float | None:
        """By how many metres the pose that was given in a recovery was carried; None where it wasn't."""
        entry = next(r for r in self.status()["recoveries"] if r["number"] == number)
        metres: float | None = next((s.get("carriedMetres") for s in entry["state"] if s["name"] == "/amcl_pose"), None)
        return metres

    def distance_to(self, goal: Goal) -> float:
        """Where the robot really was when a goal ended, from the goal, in metres."""
        near = min(self.log().motions, key=lambda m: abs(m.time - goal.ended))
        return math.hypot(near.x - goal.x, near.y - goal.y)

    # -- failing ----------------------------------------------------------------------------------------------------

    def send_signal(self, pod: str, number: str, *nodes: str) -> None:
        """Send a signal to nodes of a pod's stack, or to all of it."""
        command = ("python3", "-m", "navigation_stack.send_signal", number, *nodes)
        self.kubectl.kill(pod, *command, container=CONTAINER)

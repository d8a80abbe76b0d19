"""Starts the robots of a campaign in one namespace, and reads what they wrote down."""

from __future__ import annotations

import base64
import copy
import json
import subprocess
import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from understudy_demo.robotview import RobotLog

from bench.chaos.ways import BY_NAME, Way
from tests.e2e.faults import staying
from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import APPLICATION, Robot, manifest, shared_claim
from understudy.api import names

HOUSE = "node1"
"""The node of the robots and clients. It is never lost."""

REFLEX_DEADLINE = 0.3
"""Seconds of silence after which a reader of a robot with a reflex takes the standby's commands."""

PERIOD = 0.05
"""Seconds between two commands of the applications, and their lifespan."""

GOAL = 24
"""Steps of each goal of the worker's client."""

KEPT = "kept"
"""End of the name of the claim of a worker's kept state, which outlasts the node of its monitor."""

_COMMANDS = {"worker": ("python3", "/nodes/worker.py"), "driver": ("ros-environment", "/nodes/driver")}
_FOLDER = Path(__file__).parent
_IMAGE = "localhost/understudy-monitor:dev"
_HARDENED = {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}


@dataclass(frozen=True)
class Journal:
    """What a robot wrote down."""

    log: RobotLog
    steps: dict[int, int]
    """The application's step, by the sequence number of the command."""
    finished: list[tuple[str, str]]
    """Goals that were finished, each with the pod."""


class CampaignRobot(Robot):
    """A robot of the campaign."""

    def __init__(self, kubectl: Kubectl, index: int, way: Way, timeout: float, *, muxed: bool = False) -> None:
        self.index, self.way, self.timeout, self.muxed = index, way, timeout, muxed
        super().__init__(kubectl, f"{self.way.name}-{index + 1}", gate_kind="Mux" if muxed else "NetworkPolicy")

    @property
    def application(self) -> str:
        """Words of the command line of its application."""
        return _COMMANDS[self.way.application][-1] if self.way.application in _COMMANDS else APPLICATION

    def all_objects(self) -> list[Object]:
        """Return the robot, its workload, policy and pool, and its client, all under names of its own."""
        policy = f"quickstart-{self.way.strategy}"
        mine = f"{self.name}-policy"
        text = json.dumps(manifest(f"strategies/{self.way.strategy}.yaml"))
        found: list[Object] = json.loads(text.replace(policy, mine).replace("robot-1-drive", self.workload))
        labels = {"app": self.workload}
        for item in found:
            if item["kind"] == "FallbackPool":
                item["spec"]["workloadSelector"] = {"matchLabels": labels}
            else:
                self._policy(item["spec"])
        made = self.objects(policy=mine, labels=labels, edit=self._workload, workload=self.way.workload)
        for item in staying(made):
            if item["kind"] == "Deployment":
                item["spec"]["template"]["spec"]["nodeSelector"] = {"kubernetes.io/hostname": HOUSE}
        return [*found, *made, *self._client()]

    def _policy(self, spec: Object) -> None:
        for leaf in spec["monitoring"]["yaml"]["parallel"]:
            commands = leaf["topic"]["name"] == "/cmd_vel"
            leaf["topic"]["gap"] = f"{1000 * (self.timeout if commands else 2 * self.timeout + 1):.0f}ms"
        if self.way.worker:
            kept = {
                "topic": "/progress",
                "type": "std_msgs/msg/Int64",
                "restoreTo": "/restore_progress",
                "maxAge": "10m",
            }
            spec["state"] = {"keep": [kept], "storage": {"claimName": f"{self.name}-{KEPT}"}}

    def _workload(self, item: Object) -> None:
        spec = item["spec"]
        pod = spec["template"]["spec"]
        for output in spec["outputs"]:
            if output.get("topic") == "/cmd_vel":
                output["lifespan"] = f"{1000 * PERIOD:.0f}ms"
        if self.way.reflex:
            spec["gate"] = {"reflex": {"deadline": f"{1000 * REFLEX_DEADLINE:.0f}ms"}}
        if self.way.application in _COMMANDS:
            application = _container("drive", *_COMMANDS[self.way.application], "drive")
            pod["containers"] = [pod["containers"][0] | application]
            pod["volumes"] = [_volume()]
        if self.way.worker:
            spec["tasks"] = [{"action": "/goto", "type": "test_msgs/action/Fibonacci"}]
        away = {"key": "kubernetes.io/hostname", "operator": "NotIn", "values": [HOUSE]}
        terms = {"nodeSelectorTerms": [{"matchExpressions": [away]}]}
        pod["affinity"] = {"nodeAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": terms}}

    def _client(self) -> list[Object]:
        if not self.way.worker:
            return []
        container = _container("client", *_COMMANDS["worker"], "client", str(GOAL))
        container["envFrom"] = [{"configMapRef": {"name": names.robot_env(self.workload)}}]
        container["volumeMounts"].append({"name": "profiles", "mountPath": "/etc/understudy"})
        profiles = {"name": "profiles", "configMap": {"name": names.robot_profiles(self.workload)}}
        spec = {
            "restartPolicy": "Never",
            "terminationGracePeriodSeconds": 0,
            "nodeSelector": {"kubernetes.io/hostname": HOUSE},
            "tolerations": [{"operator": "Exists"}],
            "containers": [container],
            "volumes": [_volume(), profiles],
        }
        return [{"apiVersion": "v1", "kind": "Pod", "metadata": {"name": self.client_pod}, "spec": spec}]

    def log(self, tail: int = 0) -> RobotLog:
        """What the robot wrote down, its commands by pod."""
        found = super().log(tail)
        return found.renamed({source: source.split()[0] for source in found.sources() if source})

    def journal(self) -> Journal:
        """Return all that the robot wrote down, also what the worker says in its commands."""
        said = super().log()
        words = {command.sequence: command.source.split() for command in said.commands}
        steps = {number: int(found[1]) for number, found in words.items() if len(found) > 1}
        finished = [(found[2], found[0]) for found in words.values() if len(found) > 2]
        log = said.renamed({source: source.split()[0] for source in said.sources() if source})
        return Journal(log, steps, finished)

    def goals(self) -> dict[str, str]:
        """Return the result of each accepted goal at the client; empty if the client still waits."""
        if not self.way.worker:
            return {}
        found: dict[str, str] = {}
        for line in self.kubectl("logs", self.client_pod).splitlines():
            if line.startswith("{"):
                record = json.loads(line)
                if record["event"] == "ended":
                    found[record["goal"]] = record["status"]
                elif record["event"] == "answered" and record["accepted"]:
                    found[record["goal"]] = ""
        return found

    @property
    def client_pod(self) -> str:
        """The pod that sends goals to it."""
        return f"{self.name}-client"


def _container(name: str, *command: str) -> Object:
    return {
        "name": name,
        "image": _IMAGE,
        "imagePullPolicy": "IfNotPresent",
        "command": list(command),
        "env": [{"name": "HOME", "value": "/tmp"}],
        "securityContext": copy.deepcopy(_HARDENED),
        "volumeMounts": [{"name": "nodes", "mountPath": "/nodes"}],
    }


def _volume() -> Object:
    return {"name": "nodes", "configMap": {"name": "nodes", "defaultMode": 0o555}}


def compiled(program: str, folder: Path) -> bytes:
    """Return a program in C that is built with the headers and libraries of the Python environment's wheels of ROS."""
    environment = Path(sys.prefix)
    libraries = (
        "rcl",
        "rcutils",
        "rosidl_runtime_c",
        "geometry_msgs__rosidl_generator_c",
        "geometry_msgs__rosidl_typesupport_c",
    )
    command = [
        *("gcc", "-O1", "-Wall", "-Werror", "-rdynamic", "-Wl,--allow-shlib-undefined"),
        *(f"-I{headers}" for headers in sorted((environment / "include").iterdir())),
        *(str(_FOLDER / f"{program}.c"), "-o", str(folder / program), f"-L{environment / 'lib'}"),
        *(f"-l{library}" for library in libraries),
    ]
    try:
        built = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise SystemExit("a robot's application is in C: install gcc, or name other robots with --robots") from error
    if built.returncode:
        raise SystemExit(f"{program}.c: {built.stderr}")
    return (folder / program).read_bytes()


def start(
    kubectl: Kubectl, ways: Sequence[str], timeout: float, folder: Path, muxed: Collection[int]
) -> Sequence[CampaignRobot]:
    """Create a robot for each of these ways, and wait until all are protected. The workers' kept state is in the folder.

    ``muxed`` are the indices of those with gate kind Mux.
    """
    programs: Object = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "nodes"}}
    programs["data"] = {"worker.py": (_FOLDER / "worker.py").read_text()}
    if any(BY_NAME[way].application == "driver" for way in ways):
        programs["binaryData"] = {"driver": base64.b64encode(compiled("driver", folder)).decode()}
    kubectl.apply([programs])
    robots = [
        CampaignRobot(kubectl, index, BY_NAME[way], timeout, muxed=index in muxed) for index, way in enumerate(ways)
    ]
    for robot in robots:
        if robot.way.worker:
            kubectl.apply(shared_claim(kubectl, f"{robot.name}-{KEPT}", folder / f"{robot.name}-{KEPT}"))
        kubectl.apply(robot.all_objects())
    for robot in robots:
        robot.wait_protected(240)
    return robots

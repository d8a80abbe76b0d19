"""``understudy robot-profile NAME``: what a robot outside the cluster needs, where to put it, and what is still to be done; pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from understudy.api import names
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.ros.rmw import MIDDLEWARE

ENV_FILE = "ros.env"
PROFILES_FILE = names.PROFILES_KEY


@dataclass(frozen=True)
class Profile:
    """What the robot's side of a workload needs."""

    name: str
    namespace: str
    spec: RobotWorkloadSpec
    environment: Mapping[str, str]
    profiles: str
    folder: str
    """Where the files will be on the robot."""

    @property
    def variables(self) -> dict[str, str]:
        """The environment, with the profiles where they will be."""
        return {**self.environment, MIDDLEWARE.settings_variable: f"{self.folder.rstrip('/')}/{PROFILES_FILE}"}

    @property
    def env_file(self) -> str:
        """The environment as systemd's EnvironmentFile and docker's --env-file read it, and a shell with ``set -a``."""
        return "".join(f"{key}={value}\n" for key, value in self.variables.items())

    @property
    def files(self) -> dict[str, str]:
        """Both files by their names."""
        return {ENV_FILE: self.env_file, PROFILES_FILE: self.profiles}

    @property
    def ports(self) -> dict[str, int]:
        """The gated ports by the topics that are read there."""
        return MIDDLEWARE.gate_ports(self.spec.outputs)

    def lines(self) -> Iterator[str]:
        """Both files with where they go, and what is to be done, for a person."""
        for name, text in self.files.items():
            yield f"# {self.folder.rstrip('/')}/{name}"
            yield from text.rstrip("\n").splitlines()
            yield ""
        yield from self.advice()

    def advice(self) -> Iterator[str]:
        """What to do with the files, and what else is needed."""
        topics = ", ".join(dict.fromkeys(output.name for output in self.spec.outputs))
        folder = self.folder.rstrip("/")
        yield f"On the robot, put both files into {folder}; then start its ROS processes with the environment:"
        yield f"  systemd   EnvironmentFile={folder}/{ENV_FILE}"
        yield f"  docker    --env-file {folder}/{ENV_FILE} -v {folder}:{folder}:ro --network host"
        yield f"  a shell   set -a; . {folder}/{ENV_FILE}; set +a"
        yield ""
        yield f"Each process that reads {topics} must be started so, or a standby gets through to it. For the others the variables"
        yield f"but {MIDDLEWARE.settings_variable} suffice. One output is read by one process of the robot only."
        first, last = names.GATE_RANGE
        ports = ", ".join(f"{name} at {port}" for name, port in self.ports.items())
        yield f"Its firewall must let UDP in: {ports} (all gated ports: {first} to {last}), and what DDS uses from 7400 on."
        yield ""
        for number, todo in enumerate(self._todo(), 1):
            yield f"{number}. {todo}"

    def _todo(self) -> Iterator[str]:
        if self.spec.gate.robots:
            yield f"The robot's address must be in spec.gate.robots ({', '.join(self.spec.gate.robots)}), or no instance hears it."
        else:
            patch = '{"spec":{"gate":{"robots":["ADDRESS/32"]}}}'
            yield (
                "spec.gate.robots has no address of a robot, so no instance hears it: "
                f"kubectl patch robotworkload -n {self.namespace} {self.name} --type=merge -p '{patch}'"
            )
        server = MIDDLEWARE.discovery_server(self.environment)
        match self.spec.ros.discovery.mode:
            case "Managed":
                yield (
                    f"The discovery server {server} has an address that only nodes of the cluster reach. Where the robot is none, run one "
                    "that both sides reach, and name it in spec.ros.discovery (mode: External, server: HOST:PORT)."
                )
            case "External":
                yield f"The robot must reach the discovery server {server}."
            case "Multicast":
                yield "Multicast must get from the robot to the pods, which most pod networks don't do: see spec.ros.discovery."
        yield "Pods and robot must reach each other's addresses untranslated: DDS tells the addresses that it has itself."
        yield "When spec.outputs or spec.ros changes, do this again and start the robot's processes anew."

    def to_wire(self) -> dict[str, Any]:
        """Everything, for scripts."""
        return {
            "namespace": self.namespace,
            "name": self.name,
            "folder": self.folder,
            "environment": self.variables,
            "files": self.files,
            "ports": self.ports,
            "robots": self.spec.gate.robots,
        }

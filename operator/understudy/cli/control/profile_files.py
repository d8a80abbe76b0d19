"""The text of ``understudy robot-profile NAME``: the files that a robot outside the cluster needs, where to put them,
and what else to do. Pure."""

from __future__ import annotations

import shlex
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from understudy.api import names
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.ros.rmw import MIDDLEWARE

ENV_FILE = "ros.env"
PROFILES_FILE = names.PROFILES_KEY


def env_text(variables: Mapping[str, str]) -> str:
    """Return an environment in a format for systemd's EnvironmentFile, docker's --env-file, and a shell with ``set -a``.

    The values must contain nothing that a shell interprets, because docker does not remove quotes.
    """
    return "".join(f"{key}={value}\n" for key, value in variables.items())


def quoted_env_text(variables: Mapping[str, str]) -> str:
    """Return an environment with any values in a format for systemd's EnvironmentFile and a shell. Docker would keep the quotes."""
    return "".join(f"{key}={shlex.quote(value)}\n" for key, value in variables.items())


def own_ports(environment: Mapping[str, str]) -> str:
    """Return the ranges of ports at which the middleware listens, as text."""
    return " and ".join(f"{first} to {last}" for first, last in MIDDLEWARE.own_ports(environment))


def to_reach(spec: RobotWorkloadSpec, environment: Mapping[str, str]) -> Iterator[str]:
    """Yield what must reach what, as sentences, whatever the kind of the gate is."""
    server = MIDDLEWARE.discovery_server(environment)
    match spec.ros.discovery.mode:
        case "Managed":
            yield (
                f"Only nodes of the cluster reach the discovery server {server}. If the robot is not one, run a server that both "
                "sides reach, and name it in spec.ros.discovery (mode: External, server: HOST:PORT)."
            )
        case "External":
            yield f"The robot must reach the discovery server {server}."
        case "Multicast":
            yield "Multicast must reach the pods from the robot, which most pod networks do not support: see spec.ros.discovery."
    yield "Pods and robot must reach each other without address translation: DDS announces the addresses of its own host."


@dataclass(frozen=True)
class RobotFiles(ABC):
    """The files and settings that the robot's side of a workload needs."""

    name: str
    namespace: str
    spec: RobotWorkloadSpec
    environment: Mapping[str, str]
    folder: str
    """Folder of the files on the robot."""

    @property
    @abstractmethod
    def files(self) -> dict[str, str]:
        """Both files by name."""

    @abstractmethod
    def advice(self) -> Iterator[str]:
        """Describe what to do with the files, and what else is needed."""

    @abstractmethod
    def to_wire(self) -> dict[str, Any]:
        """Return everything for scripts."""

    @property
    def place(self) -> str:
        """The folder without a slash at its end."""
        return self.folder.rstrip("/")

    def lines(self) -> Iterator[str]:
        """Format both files, their paths and the next steps as text."""
        for name, text in self.files.items():
            yield f"# {self.place}/{name}"
            yield from text.rstrip("\n").splitlines()
            yield ""
        yield from self.advice()


@dataclass(frozen=True)
class Profile(RobotFiles):
    """Those of a robot whose processes read the outputs at gated ports: their environment, and their DDS profiles."""

    profiles: str

    @property
    def variables(self) -> dict[str, str]:
        """The environment, with the path of the profiles on the robot."""
        return {**self.environment, MIDDLEWARE.settings_variable: f"{self.place}/{PROFILES_FILE}"}

    @property
    def files(self) -> dict[str, str]:
        """Both files by name."""
        return {ENV_FILE: env_text(self.variables), PROFILES_FILE: self.profiles}

    @property
    def ports(self) -> dict[str, int]:
        """The gated ports by the topics whose readers receive at them."""
        return MIDDLEWARE.gate_ports(self.spec.outputs)

    def advice(self) -> Iterator[str]:
        """Describe what to do with the files, and what else is needed."""
        topics = ", ".join(dict.fromkeys(output.name for output in self.spec.outputs))
        folder = self.place
        yield f"On the robot, put both files into {folder}; then start its ROS processes with the environment:"
        yield f"  systemd   EnvironmentFile={folder}/{ENV_FILE}"
        yield f"  docker    --env-file {folder}/{ENV_FILE} -v {folder}:{folder}:ro --network host"
        yield f"  a shell   set -a; . {folder}/{ENV_FILE}; set +a"
        yield ""
        yield f"Each process that reads {topics} must be started like this; otherwise it also receives what standbys send."
        yield (
            f"Other processes need the variables except {MIDDLEWARE.settings_variable}. Only one process of the robot may read an "
            "output."
        )
        first, last = names.GATE_RANGE
        ports = ", ".join(f"{name} at {port}" for name, port in self.ports.items())
        yield (
            f"Its firewall must accept UDP at: {ports} (all gated ports: {first} to {last}), and at the ports of DDS: "
            f"{own_ports(self.environment)}."
        )
        yield ""
        for number, todo in enumerate(self._todo(), 1):
            yield f"{number}. {todo}"

    def _todo(self) -> Iterator[str]:
        if self.spec.gate.robots:
            robots = ", ".join(self.spec.gate.robots)
            yield f"The robot's address must be in spec.gate.robots ({robots}), or instances receive nothing from it."
        else:
            patch = '{"spec":{"gate":{"robots":["ADDRESS/32"]}}}'
            yield (
                "spec.gate.robots has no address, so instances receive nothing from the robot: "
                f"kubectl patch robotworkload -n {self.namespace} {self.name} --type=merge -p '{patch}'"
            )
        yield from to_reach(self.spec, self.environment)
        yield "When spec.outputs or spec.ros changes, do this again and restart the robot's processes."

    def to_wire(self) -> dict[str, Any]:
        """Return everything for scripts."""
        return {
            "namespace": self.namespace,
            "name": self.name,
            "folder": self.folder,
            "environment": self.variables,
            "files": self.files,
            "ports": self.ports,
            "robots": self.spec.gate.robots,
        }

"""The text of ``understudy robot-profile NAME`` for a workload with a mux: the files that a robot outside the cluster needs. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from understudy.api import names
from understudy.cli.control.profile_files import ENV_FILE, RobotFiles, env_text, own_ports, quoted_env_text, to_reach

MUX_FILE = "mux.env"
TOKEN_FILE = "token"
UNIT = "understudy-mux@"
"""Name of the systemd unit (examples/quickstart/manifests/mux) without the name of the workload."""


@dataclass(frozen=True)
class MuxFiles(RobotFiles):
    """The environment of the robot's processes, and that of the mux. Nothing of the robot needs a DDS profile."""

    settings: Mapping[str, str]
    """The environment of the mux in addition."""

    @property
    def files(self) -> dict[str, str]:
        """Both files by name."""
        return {ENV_FILE: env_text(self.environment), MUX_FILE: quoted_env_text(self.settings)}

    def advice(self) -> Iterator[str]:
        """Describe what to do with the files, and what else is needed."""
        folder, secret = self.place, names.mux(self.name)
        template = f"'{{{{.data.{names.TOKEN} | base64decode}}}}'"
        yield f"On the robot, put both files into {folder}."
        yield f"Start its ROS processes with the environment {ENV_FILE}: they need no DDS profile."
        yield ""
        yield "The mux needs both, and the token, which only root should be able to read there:"
        yield f"  kubectl get secret -n {self.namespace} {secret} -o go-template={template} > {TOKEN_FILE}"
        yield f"  sudo install -D -m 600 {TOKEN_FILE} {folder}/{TOKEN_FILE}"
        yield f"  sudo systemctl enable --now {UNIT}{self.name}        # the unit: docs/mux.md#a-robot-outside-of-the-cluster"
        yield ""
        yield f"Its firewall must accept UDP at the ports of DDS: {own_ports(self.environment)}."
        yield ""
        for number, todo in enumerate(self._todo(), 1):
            yield f"{number}. {todo}"

    def _todo(self) -> Iterator[str]:
        robots = ", ".join(self.spec.gate.robots) or "which is empty"
        yield f"The robot's address must be in spec.gate.robots ({robots}), or the monitor receives nothing from it."
        yield from to_reach(self.spec, self.environment)
        yield "When spec.outputs, spec.ros or spec.gate.mux changes, do this again and restart the mux."

    def to_wire(self) -> dict[str, Any]:
        """Return everything for scripts, without the token."""
        return {
            "namespace": self.namespace,
            "name": self.name,
            "folder": self.folder,
            "environment": dict(self.environment),
            "files": self.files,
            "robots": self.spec.gate.robots,
        }

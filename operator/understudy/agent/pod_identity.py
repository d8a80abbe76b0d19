"""The identity of the agent's pod, from the environment that the operator sets."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from understudy.api import names
from understudy.api.protocol.secure_channel import AgentSecret


@dataclass(frozen=True)
class PodIdentity:
    """One pod."""

    workload: str
    """RobotWorkload that the pod was created for; empty for a pod that may be claimed."""
    pod: str
    uid: str
    held: tuple[str, ...]
    """Containers that wait for a claim."""
    directory: Path
    """The emptyDir shared with the application, which cannot write to it."""
    memory: Path
    """The agent's own emptyDir. In a pod of an older operator it is the shared one."""
    token_file: Path
    fenced: tuple[str, ...] = ()
    """Containers whose application can be frozen while the pod is isolated."""
    unfenced: tuple[str, ...] = ()
    """Containers whose application should be frozen then, but cannot be."""
    ip: str = ""
    """The address in the pod's status."""

    @classmethod
    def from_environment(cls, environment: Mapping[str, str]) -> PodIdentity:
        """Read the identity from environment variables. Raises ValueError with the names of missing variables."""
        needed = ("UNDERSTUDY_POD", "UNDERSTUDY_POD_UID")
        if missing := [name for name in needed if not environment.get(name)]:
            raise ValueError(f"{', '.join(missing)} not set: the operator sets them in the container's env")
        workload = environment.get("UNDERSTUDY_WORKLOAD", "")
        held = tuple(environment.get("UNDERSTUDY_HELD_CONTAINERS", "").split())
        directory = Path(environment.get("UNDERSTUDY_DIR", names.AGENT_DIR))
        if not workload and not held:
            raise ValueError(
                "neither UNDERSTUDY_WORKLOAD nor UNDERSTUDY_HELD_CONTAINERS is set: a pod is a workload's, or held"
            )
        return cls(
            workload=workload,
            pod=environment["UNDERSTUDY_POD"],
            uid=environment["UNDERSTUDY_POD_UID"],
            held=held,
            directory=directory,
            memory=Path(environment.get(names.MEMORY_VARIABLE, directory)),
            token_file=Path(environment.get("UNDERSTUDY_TOKEN_FILE", f"{names.SECRET_DIR}/token")),
            fenced=tuple(environment.get(names.FENCED_VARIABLE, "").split()),
            unfenced=tuple(environment.get(names.UNFENCED_VARIABLE, "").split()),
            ip=environment.get("UNDERSTUDY_POD_IP", ""),
        )

    def secret(self) -> AgentSecret:
        """Return what shows a monitor to be this pod's. It is read each time, since a Secret can change.

        Raises OSError.
        """
        key = b""
        with contextlib.suppress(FileNotFoundError):  # of an older operator, or after a rollback to one
            key = self.token_file.with_name(names.MONITOR_PUBLIC_KEY).read_bytes()
        return AgentSecret(self.token_file.read_bytes().strip(), key)

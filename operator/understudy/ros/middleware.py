"""The interface of a ROS middleware: its environment and settings files, and who sends and reads in the graph.

To support another middleware, implement :class:`Middleware` in a folder of its own beside ros/dds, and name it in
ros/rmw.py.

This module imports only names, because the operator and every agent have it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from understudy.api.kinds.robot_workload import Gate, Output, Ros
    from understudy.api.kinds.task_spec import Task


@dataclass(frozen=True)
class Locator:
    """Where a process listens for UDP."""

    address: str
    port: int


class Middleware(ABC):
    """A ROS middleware (RMW)."""

    implementation: ClassVar[str]
    """Value of ``RMW_IMPLEMENTATION``."""
    name: ClassVar[str]
    """The name in messages."""
    settings_variable: ClassVar[str]
    """The environment variable with the path of a process's settings file."""
    common: ClassVar[Mapping[str, str]]
    """The environment of every ROS process of every robot."""
    variables: ClassVar[frozenset[str]]
    """The names of all environment variables that describe a ROS graph to a process."""
    introspection: ClassVar[Mapping[str, str]]
    """Further variables of a process that must see the whole graph, and not only the endpoints with which it exchanges
    data."""

    # -- Environment --------------------------------------------------------------------------------------------------

    @abstractmethod
    def environment(self, ros: Ros, address: str | None) -> dict[str, str]:
        """Return the environment of every process in a robot's ROS graph.

        ``address`` is the managed discovery server's. Raises ValueError if the server is managed and has no address.
        """

    @abstractmethod
    def introspecting(self, environment: Mapping[str, str]) -> dict[str, str]:
        """Return this environment for a process that must see the whole graph."""

    @abstractmethod
    def discovery_server(self, environment: Mapping[str, str]) -> str:
        """Return the discovery server, as ``HOST:PORT``, of a process with this environment; empty if it uses none."""

    @abstractmethod
    def own_ports(self, environment: Mapping[str, str]) -> Sequence[tuple[int, int]]:
        """Return the ranges of UDP ports at which processes with this environment listen, besides their gated ports."""

    @abstractmethod
    def discovery_command(self, address: str, port: int) -> list[str]:
        """Return the command of a managed discovery server that others reach at an address."""

    # -- Settings files -----------------------------------------------------------------------------------------------

    @abstractmethod
    def gate_ports(self, outputs: Iterable[Output]) -> dict[str, int]:
        """Return the UDP port of each gated reader on the robot's side, by the name of what it reads.

        Raises ValueError, naming the output, if there are more readers than gated ports.
        """

    @abstractmethod
    def robot_settings(self, outputs: Iterable[Output], gate: Gate) -> str:
        """Return the settings file of the robot's processes. Raises ValueError as :meth:`gate_ports` does."""

    @abstractmethod
    def monitor_settings(self, outputs: Iterable[Output], gate: Gate) -> str:
        """Return the settings file of the monitor, which receives what the robot receives, or what a mux receives for it.

        Raises ValueError as :meth:`gate_ports` does.
        """

    @abstractmethod
    def instance_settings(self, tasks: Iterable[Task], outputs: Iterable[Output], gate: Gate) -> str:
        """Return the settings file of an instance's processes and of its agent; empty if they need none.

        Values that differ between pods are variables (agent/prepare.py).
        """

    @abstractmethod
    def mux_settings(self, outputs: Iterable[Output]) -> str:
        """Return the settings file of a mux, which passes these outputs on between the instances and the robot."""

    @abstractmethod
    def is_kept_apart(self, environment: Mapping[str, str]) -> bool:
        """Whether no other instance and no process of the robot matches the writers of a process with this environment."""

    # -- Who sends and who reads --------------------------------------------------------------------------------------

    @abstractmethod
    def requests(self, output: Output) -> list[str]:
        """Return the middleware's names of the channels for an output's requests, or for its goals and cancellations.

        Empty for a topic.
        """

    @abstractmethod
    def host_of(self, gid: bytes) -> bytes:
        """Return the part of an endpoint's GID that all endpoints of its host have in common."""

    @abstractmethod
    def process_of(self, gid: bytes) -> bytes:
        """Return the part of an endpoint's GID that identifies its process. A process that restarts has another one."""

    @abstractmethod
    def host_at(self, address: str) -> bytes:
        """Return what :meth:`host_of` returns for the endpoints of a host with one IP address.

        Raises ValueError if that cannot be known.
        """

    @abstractmethod
    async def reader_locators(
        self, readers: Collection[bytes], address: str, environment: Mapping[str, str], *, within: float
    ) -> dict[bytes, tuple[Locator, ...]]:
        """Return where readers, given by their GIDs, listen.

        Readers that are not announced within ``within`` seconds are left out. ``address`` is this host's own;
        ``environment`` says whom to ask. Raises OSError and ValueError.
        """

    @abstractmethod
    async def instances_of_writers(
        self, writers: Collection[bytes], address: str, environment: Mapping[str, str], *, within: float
    ) -> dict[bytes, str]:
        """Return the pods whose outputs writers send, given by their GIDs, if a mux forwards these; empty for a writer of nobody's outputs.

        Everything else is as for :meth:`reader_locators`.
        """

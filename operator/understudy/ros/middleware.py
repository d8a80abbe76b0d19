"""The interface of a ROS middleware: its settings in environment and files, and what it shows of who sends and who reads.

To support another middleware, implement :class:`Middleware` in a folder of its own beside ros/dds, and name it in ros/rmw.py.

Imports nothing but names: the operator and every agent have it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from understudy.api.kinds.robot_workload import Output, Reflex, Ros
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
    """What messages call it."""
    settings_variable: ClassVar[str]
    """The environment variable with the path of a process's settings file."""
    common: ClassVar[Mapping[str, str]]
    """The environment of every ROS process of every robot."""
    introspection: ClassVar[Mapping[str, str]]
    """What the environment of a process must have besides, if it is to see the whole graph and not only what it exchanges data with."""

    # -- Environment --------------------------------------------------------------------------------------------------

    @abstractmethod
    def environment(self, ros: Ros, address: str | None) -> dict[str, str]:
        """The environment of every process in a robot's ROS graph. ``address`` is the managed discovery server's.

        Raises ValueError if the server is managed and has no address.
        """

    @abstractmethod
    def introspecting(self, environment: Mapping[str, str]) -> dict[str, str]:
        """This environment for a process that must see the whole graph."""

    @abstractmethod
    def discovery_server(self, environment: Mapping[str, str]) -> str:
        """The discovery server, as ``HOST:PORT``, of a process with this environment; empty if it uses none."""

    @abstractmethod
    def discovery_command(self, address: str, port: int) -> list[str]:
        """The command of a managed discovery server that others reach at an address."""

    # -- Settings files -----------------------------------------------------------------------------------------------

    @abstractmethod
    def gate_ports(self, outputs: Iterable[Output]) -> dict[str, int]:
        """The UDP port of each gated reader on the robot's side, by the name of what it reads.

        Raises ValueError, naming the output, if there are more readers than gated ports.
        """

    @abstractmethod
    def robot_settings(self, outputs: Iterable[Output], reflex: Reflex | None = None) -> str:
        """The settings file of the robot's processes and of the monitor. Raises ValueError as :meth:`gate_ports` does."""

    @abstractmethod
    def instance_settings(
        self, tasks: Iterable[Task], outputs: Iterable[Output] = (), reflex: Reflex | None = None
    ) -> str:
        """The settings file of an instance's processes and of its agent; empty if they need none.

        What differs from pod to pod stands in it as variables (api/protocol/profile_placeholders.py).
        """

    # -- Who sends and who reads --------------------------------------------------------------------------------------

    @abstractmethod
    def host_of(self, gid: bytes) -> bytes:
        """The part of an endpoint's GID that all endpoints of its host have in common."""

    @abstractmethod
    def host_at(self, address: str) -> bytes:
        """What :meth:`host_of` returns for the endpoints of a host with one IP address. Raises ValueError if that cannot be known."""

    @abstractmethod
    async def reader_locators(
        self, readers: Collection[bytes], address: str, environment: Mapping[str, str], *, within: float
    ) -> dict[bytes, tuple[Locator, ...]]:
        """Where readers, given by their GIDs, listen. Those of which nothing is heard within so many seconds are left out.

        ``address`` is this host's own; ``environment`` tells whom to ask. Raises OSError and ValueError.
        """

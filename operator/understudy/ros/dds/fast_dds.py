"""Implements the middleware interface with Fast DDS, as ``rmw_fastrtps_cpp`` runs it.

Imports what it needs when it is asked: an agent has neither models of the API nor RTPS in memory.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING

from understudy.api import names
from understudy.ros.dds.host_ids import HOST, VENDOR, host_id
from understudy.ros.middleware import Locator, Middleware

if TYPE_CHECKING:
    from understudy.api.kinds.robot_workload import Output, Reflex, Ros
    from understudy.api.kinds.task_spec import Task

SERVER_VARIABLE = "ROS_DISCOVERY_SERVER"


class FastDds(Middleware):
    """Fast DDS: XML profiles by topic name, discovery servers, and GUIDs that begin with an id of the host."""

    implementation = "rmw_fastrtps_cpp"
    name = "Fast DDS"
    settings_variable = "FASTRTPS_DEFAULT_PROFILES_FILE"
    common = {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp", "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}  # noqa: RUF012
    """UDP only: over shared memory between containers, topics are listed and carry no data."""

    introspection = {"ROS_SUPER_CLIENT": "TRUE"}  # noqa: RUF012
    """A plain client of a discovery server hears of matching endpoints only, so it could never learn a topic's type."""

    def environment(self, ros: Ros, address: str | None) -> dict[str, str]:
        """Domain and discovery server."""
        environment = {"ROS_DOMAIN_ID": str(ros.domain_id), **self.common}
        match ros.discovery.mode:
            case "Managed":
                if address is None:
                    raise ValueError("a managed discovery server has an address")
                host = f"[{address}]" if ":" in address else address
                environment[SERVER_VARIABLE] = f"{host}:{names.DISCOVERY_PORT}"
            case "External":
                environment[SERVER_VARIABLE] = ros.discovery.server or ""
        return environment

    def introspecting(self, environment: Mapping[str, str]) -> dict[str, str]:
        """Behind a discovery server, only a super client sees the whole graph."""
        return {**environment, **(self.introspection if self.discovery_server(environment) else {})}

    def discovery_server(self, environment: Mapping[str, str]) -> str:
        """The only server that a robot has."""
        return environment.get(SERVER_VARIABLE, "")

    def discovery_command(self, address: str, port: int) -> list[str]:
        """A server that announces this address as its own, since its pod's address changes."""
        return ["understudy-discovery-server", address, str(port)]

    def gate_ports(self, outputs: Iterable[Output]) -> dict[str, int]:
        """By profile name."""
        from understudy.ros.dds import profiles

        return profiles.gate_ports(outputs)

    def robot_settings(self, outputs: Iterable[Output], reflex: Reflex | None = None) -> str:
        """Profiles with a gated port for each reader."""
        from understudy.ros.dds import profiles

        return profiles.profiles_xml(outputs, reflex)

    def instance_settings(
        self, tasks: Iterable[Task], outputs: Iterable[Output] = (), reflex: Reflex | None = None
    ) -> str:
        """Profiles with partitions for tasks, and ownership for outputs with the reflex."""
        from understudy.ros.dds import profiles

        return profiles.instance_profiles_xml(tasks, outputs, reflex)

    def host_of(self, gid: bytes) -> bytes:
        """Vendor and host id."""
        return gid[HOST]

    def host_at(self, address: str) -> bytes:
        """Of IPv4 addresses only: Fast DDS leaves IPv6 out."""
        return VENDOR + host_id(address)

    async def reader_locators(
        self, readers: Collection[bytes], address: str, environment: Mapping[str, str], *, within: float
    ) -> dict[bytes, tuple[Locator, ...]]:
        """As DDS discovery announces them."""
        from understudy.ros.dds import reader_locators

        discovery = reader_locators.Discovery.of(environment)
        return await reader_locators.locators(readers, address, discovery, within=within)

"""Implements the middleware interface with Fast DDS, as ``rmw_fastrtps_cpp`` uses it.

Modules are imported when they are first used: an agent has neither models of the API nor RTPS in memory.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from understudy.api import names
from understudy.ros.dds.host_ids import HOST, PARTICIPANT, VENDOR, host_id
from understudy.ros.middleware import Locator, Middleware

if TYPE_CHECKING:
    from understudy.api.kinds.robot_workload import Gate, Output, Ros
    from understudy.api.kinds.task_spec import Task

SERVER_VARIABLE = "ROS_DISCOVERY_SERVER"

_UNIQUE_FLOWS = (7000, 7399)
"""The ports that Fast DDS gives to readers with the property fastdds.unique_network_flows, in any domain."""


class FastDds(Middleware):
    """Fast DDS: XML profiles by topic name, discovery servers, and GUIDs that begin with an id of the host."""

    implementation = "rmw_fastrtps_cpp"
    name = "Fast DDS"
    settings_variable = "FASTRTPS_DEFAULT_PROFILES_FILE"
    common = {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp", "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}  # noqa: RUF012
    """UDP only: over shared memory, topics of other containers are discovered but carry no data."""

    variables = frozenset(
        {
            "ROS_DOMAIN_ID",
            "ROS_AUTOMATIC_DISCOVERY_RANGE",
            "ROS_STATIC_PEERS",
            "ROS_SUPER_CLIENT",
            "RMW_IMPLEMENTATION",
            "FASTDDS_BUILTIN_TRANSPORTS",
            SERVER_VARIABLE,
            settings_variable,
        }
    )

    introspection = {"ROS_SUPER_CLIENT": "TRUE"}  # noqa: RUF012
    """A plain client of a discovery server discovers matching endpoints only, so it could never learn a topic's
    type."""

    def environment(self, ros: Ros, address: str | None) -> dict[str, str]:
        """Return the variables for the domain and the discovery server."""
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
        """Return the environment of a super client: behind a discovery server, only that sees the whole graph."""
        return {**environment, **(self.introspection if self.discovery_server(environment) else {})}

    def discovery_server(self, environment: Mapping[str, str]) -> str:
        """Return the discovery server; a robot has only one."""
        return environment.get(SERVER_VARIABLE, "")

    def own_ports(self, environment: Mapping[str, str]) -> Sequence[tuple[int, int]]:
        """Return the ports of the domain, and those of readers with a network flow of their own: that of ROS's graph is one."""
        from understudy.ros.dds import endpoint_announcements

        first = endpoint_announcements.first_port(int(environment.get("ROS_DOMAIN_ID") or 0))
        return (_UNIQUE_FLOWS, (first, min(first + endpoint_announcements.PORTS - 1, 65535)))

    def discovery_command(self, address: str, port: int) -> list[str]:
        """Return the command of a server that announces this address as its own, since its pod's address changes."""
        return ["understudy-discovery-server", address, str(port)]

    def gate_ports(self, outputs: Iterable[Output]) -> dict[str, int]:
        """Return the ports by profile name."""
        from understudy.ros.dds import profiles

        return profiles.gate_ports(outputs)

    def robot_settings(self, outputs: Iterable[Output], gate: Gate) -> str:
        """Return the profiles with a gated port for each reader; none with a mux."""
        from understudy.ros.dds import profiles

        return profiles.profiles_xml([] if gate.is_at_robot else outputs, gate.reflex)

    def monitor_settings(self, outputs: Iterable[Output], gate: Gate) -> str:
        """Return the profiles of the robot; with a mux, those with readers in the partitions of all pods."""
        from understudy.ros.dds import profiles

        if gate.is_at_robot:
            return profiles.mux_monitor_profiles_xml(outputs)
        return profiles.profiles_xml(outputs, gate.reflex)

    def instance_settings(self, tasks: Iterable[Task], outputs: Iterable[Output], gate: Gate) -> str:
        """Return the profiles with the partition of the pod: for tasks, and with a mux for everything.

        Without a mux, they have lifespans for outputs, and ownership with the reflex.
        """
        from understudy.ros.dds import profiles

        if gate.is_at_robot:
            return profiles.muxed_profiles_xml(outputs, tasks)
        return profiles.instance_profiles_xml(tasks, outputs, gate.reflex)

    def requests(self, output: Output) -> list[str]:
        """Return the DDS topics."""
        from understudy.ros.dds import profiles

        return [] if output.topic else profiles.command_writers(output)

    def mux_settings(self, outputs: Iterable[Output]) -> str:
        """Return the profiles with the endpoints toward the instances in the partitions of all pods."""
        from understudy.ros.dds import profiles

        return profiles.mux_profiles_xml(outputs)

    def is_kept_apart(self, environment: Mapping[str, str]) -> bool:
        """Read the settings file: those of an instance with a mux have a partition for all writers."""
        file = environment.get(self.settings_variable)
        if not file:
            return False
        try:
            return names.APART_PROFILE in Path(file).read_text()
        except (OSError, ValueError):
            return False

    def host_of(self, gid: bytes) -> bytes:
        """Return the vendor and the host id."""
        return gid[HOST]

    def process_of(self, gid: bytes) -> bytes:
        """Return the prefix of the participant, of which 16 bits are random: the process ids of containers are often the same."""
        return gid[PARTICIPANT]

    def host_at(self, address: str) -> bytes:
        """Return the host part for an IPv4 address. Fast DDS leaves IPv6 out."""
        return VENDOR + host_id(address)

    async def reader_locators(
        self, readers: Collection[bytes], address: str, environment: Mapping[str, str], *, within: float
    ) -> dict[bytes, tuple[Locator, ...]]:
        """Return the locators that DDS discovery announces."""
        from understudy.ros.dds import endpoint_announcements

        discovery = endpoint_announcements.Discovery.of(environment)
        return await endpoint_announcements.locators(readers, address, discovery, within=within)

    async def instances_of_writers(
        self, writers: Collection[bytes], address: str, environment: Mapping[str, str], *, within: float
    ) -> dict[bytes, str]:
        """Return the pods by the partitions that DDS discovery announces."""
        from understudy.ros.dds import endpoint_announcements, profiles

        discovery = endpoint_announcements.Discovery.of(environment)
        found = await endpoint_announcements.partitions(writers, address, discovery, within=within)
        return {writer: profiles.instance_of(partitions) for writer, partitions in found.items()}

"""The environment of a robot's ROS graph, and what the robot's side needs of it: two ConfigMaps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from understudy.api import names
from understudy.api.kinds.robot_workload import Output, Reflex, Ros
from understudy.kube.client import Object
from understudy.ros.dds.profiles import profiles_xml

PROFILES_DIR = "/etc/understudy"
PROFILES_KEY = "profiles.xml"
PROFILES_FILE = f"{PROFILES_DIR}/{PROFILES_KEY}"

COMMON = {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp", "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
"""The same for every robot. UDP only: shared memory between containers lists topics and carries no data."""


def ros_environment(ros: Ros, cluster_ip: str | None) -> dict[str, str]:
    """The ROS environment of every process in the robot's graph; ``cluster_ip`` is the managed discovery server's."""
    environment = {"ROS_DOMAIN_ID": str(ros.domain_id), **COMMON}
    match ros.discovery.mode:
        case "Managed":
            if cluster_ip is None:
                raise ValueError("a managed discovery server has an address")
            host = f"[{cluster_ip}]" if ":" in cluster_ip else cluster_ip
            environment["ROS_DISCOVERY_SERVER"] = f"{host}:{names.DISCOVERY_PORT}"
        case "External":
            environment["ROS_DISCOVERY_SERVER"] = ros.discovery.server or ""
    return environment


def introspecting(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment of a process that looks at the whole graph: behind a discovery server only a super client may."""
    return {**environment, **({"ROS_SUPER_CLIENT": "TRUE"} if "ROS_DISCOVERY_SERVER" in environment else {})}


def config_maps(
    workload: str, environment: Mapping[str, str], outputs: Sequence[Output], reflex: Reflex | None = None
) -> list[Object]:
    """What the robot's side takes in: environment (``envFrom``) and profiles (mounted at PROFILES_DIR).

    Raises ValueError where the gated ports don't suffice for the outputs.
    """
    return [
        {
            "apiVersion": "v1",
            "kind": "ConfigMap",
            "metadata": {"name": names.robot_env(workload)},
            "data": {**environment, "FASTRTPS_DEFAULT_PROFILES_FILE": PROFILES_FILE},
        },
        {
            "apiVersion": "v1",
            "kind": "ConfigMap",
            "metadata": {"name": names.robot_profiles(workload)},
            "data": {PROFILES_KEY: profiles_xml(outputs, reflex)},
        },
    ]

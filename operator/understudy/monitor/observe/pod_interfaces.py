"""Finds the network interfaces of the instances that the gate does not control, as their agents report them."""

from __future__ import annotations

from collections.abc import Mapping

from understudy.failover.interfaces import Instances
from understudy.monitor.observe.agent_connections import AgentConnections

FURTHER = "FurtherInterfaces"


class PodInterfaces:
    """The further interfaces of a workload's instances. An instance without an agent is not known to have any."""

    def __init__(self, pods: Instances, agents: AgentConnections) -> None:
        self._pods, self._agents = pods, agents
        self._reported: dict[str, Mapping[str, tuple[str, ...]]] = {}
        """By UID, what each agent reported last. A pod keeps its interfaces while the connection to its agent is lost."""

    def further(self) -> str:
        """Return the further interfaces of all instances, and what to do, as sentences; empty if there are none."""
        reported, found = self._reported, []
        self._reported = {}
        for instance in sorted(self._pods.of_workload(), key=lambda one: one.name):
            status = self._agents.status(instance)
            interfaces = status.further_interfaces if status is not None else reported.get(instance.uid, {})
            self._reported[instance.uid] = interfaces
            if interfaces:
                those = (f"{name} ({', '.join(addresses)})" for name, addresses in sorted(interfaces.items()))
                found.append(f"{instance.name} has {', '.join(those)}")
        if not found:
            return ""
        return (
            f"Instances have network interfaces besides that of the pod network: {'; '.join(found)}. The gate does not control "
            "them, so a standby could reach the robot by them. Change the network plugin's configuration so that these pods have the pod "
            "network only, and reach the robot by it."
        )

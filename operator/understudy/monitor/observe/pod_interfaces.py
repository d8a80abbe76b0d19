"""Finds the network interfaces of the instances that the gate does not control, as their agents report them and their pods show them."""

from __future__ import annotations

from collections.abc import Mapping

from understudy.failover.interfaces import Instances
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.objects.cluster_view import ClusterView

FURTHER = "FurtherInterfaces"


class PodInterfaces:
    """The further interfaces of a workload's instances. Of one without an agent, only what its pod's object shows is known."""

    def __init__(self, view: ClusterView, pods: Instances, agents: AgentConnections) -> None:
        self._view, self._pods, self._agents = view, pods, agents
        self._reported: dict[str, Mapping[str, tuple[str, ...]]] = {}
        """By UID, what each agent reported last. A pod keeps its interfaces while the connection to its agent is lost."""

    def further(self) -> str:
        """Return the further interfaces of all instances, and what to do, as sentences; empty if there are none."""
        reported, found = self._reported, []
        self._reported = {}
        shown = {pod["metadata"]["uid"]: self._view.gate_kind.ungated(pod) for pod in self._view.all_pods()}
        for instance in sorted(self._pods.of_workload(), key=lambda one: one.name):
            status = self._agents.status(instance)
            interfaces = status.further_interfaces if status is not None else reported.get(instance.uid, {})
            self._reported[instance.uid] = interfaces
            if interfaces := {**shown.get(instance.uid, {}), **interfaces}:
                those = (
                    f"{name} ({', '.join(addresses)})" if addresses else name
                    for name, addresses in sorted(interfaces.items())
                )
                found.append(f"{instance.name} has {', '.join(those)}")
        if not found:
            return ""
        return (
            f"Instances have network interfaces besides that of the pod network: {'; '.join(found)}. The gate does not control "
            "them, so a standby could reach the robot by them. Change the pods' template or the network plugin's configuration so that "
            "these pods have the pod network only, and reach the robot by it."
        )

"""The gate kind ``Mux``: the gate object is a Lease, and a process beside the robot forwards the instance that it names.

All endpoints of the instances' outputs are in DDS partitions of their own, so they cannot reach the robot's nodes, whatever the network
is. The monitor passes on what the Lease says (understudy.api.protocol.mux_messages).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from understudy.api import names
from understudy.api.kinds.robot_workload import Output
from understudy.kube.client import LEASES, Object, Resource
from understudy.kube.gates.base import GateKind, Reach
from understudy.kube.gates.mux_reports import MuxReports


class MuxGate(GateKind):
    """Fences at the robot. The network need not enforce anything."""

    kind = "Mux"
    object_kind = "Lease"
    resource = LEASES
    page = "docs/mux.md"
    is_at_robot = True
    fence_hint = (
        "The monitor passes this on to the mux at the robot, which forwards as before until then. To stop the robot without the monitor, "
        "stop the mux."
    )

    def how_it_switches(self, workload: str) -> str:
        """Return that one write switches, and that the monitor orders the mux to follow it."""
        return (
            f"The gate is Lease {names.gate(workload)}: one write to it switches. The monitor then orders the mux at the robot to forward "
            "the new instance, and the mux drops what that instance sent before. While monitor and mux are not connected, the mux "
            "forwards as before."
        )

    def words_for_admitted(self, standby: str) -> str:
        """Return that the mux may switch to the standby."""
        return (
            f"If the active instance falls silent, the mux switches to standby {standby} by itself (spec.gate.reflex)."
        )

    def not_covered(self, outputs: Sequence[Output]) -> Sequence[str]:
        """Return that an instance must not serve an output."""
        served = [output.name for output in outputs if not output.topic]
        if not served:
            return ()
        return (
            f"The mux forwards requests to the robot only. If an instance serves {', '.join(served)}, nobody reaches that server.",
        )

    def routing(self, workload: str, active: str, admitted: str = "") -> Object:
        """Return merge patch fields of the holder. An admitted standby is in the record only: the mux may switch to it by itself."""
        return {"spec": {"holderIdentity": active or None}}

    def let_through(self, gate: Object) -> tuple[str, ...]:
        """Return the holder."""
        holder = (gate.get("spec") or {}).get("holderIdentity")
        return (holder,) if holder else ()

    def routing_repair(self, gate: Object, workload: str, active: str, admitted: str = "") -> Object:
        """Return merge patch fields of the holder; empty if it is right."""
        return {} if self.let_through(gate) == ((active,) if active else ()) else self.routing(workload, active)

    def ungateable(self, template: Mapping[str, Any]) -> str:
        """Return nothing: the partitions hold on every network, also on that of a node."""
        return ""

    def ungated(self, pod: Object) -> Mapping[str, tuple[str, ...]]:
        """Return nothing: the partitions hold on every network."""
        return {}

    def closed(self, workload: str, reach: Reach, *, epoch: int, fenced: int = 0) -> Object:
        """Return a Lease without a holder."""
        record = {names.EPOCH: str(epoch), names.ACTIVE: "", names.ACTIVE_UID: "", names.RECOVERY: ""}
        record |= {names.FENCED: str(fenced)} if fenced else {}
        return {
            "apiVersion": "coordination.k8s.io/v1",
            "kind": "Lease",
            "metadata": {"name": names.gate(workload), "annotations": record},
            "spec": {},
        }

    def spec_repair(self, gate: Object, workload: str, reach: Reach) -> Object:
        """Return nothing: a Lease has no rules."""
        return {}

    def companions(self, workload: str, reach: Reach) -> list[tuple[Resource, Object]]:
        """Return nothing."""
        return []

    def instance_rules(self, workload: str, reach: Reach, pools: Sequence[str] = ()) -> Object:
        """Return rules that allow everything, since no policy applies to instances."""
        return {"policyTypes": ["Ingress", "Egress"], "ingress": [{}], "egress": [{}]}

    def secrets(self, workload: str) -> tuple[str, ...]:
        """Return the Secret with the token that monitor and mux share."""
        return (names.mux(workload),)

    async def proof(self) -> MuxReports:
        """Return the reports of the mux, which the monitor receives."""
        return MuxReports()


GATE = MuxGate()

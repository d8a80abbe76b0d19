"""The monitor's report to the task proxy: the tasks, the instances, and the active one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from understudy.api.protocol.agent_messages import PROTOCOL, GateEpoch


@dataclass(frozen=True)
class TaskRule:
    """A task, with the rules for its goals at a failover."""

    action: str
    type: str
    on_failover: str = "Resend"
    """Resend, Abort or Tree."""
    abort_grace: float = 2.0
    """Seconds for which an end that no client requested is withheld."""


@dataclass(frozen=True)
class Peer:
    """An instance whose agent the proxy may command."""

    uid: str
    pod: str
    ip: str
    port: int
    token: str
    claim: str
    executing: bool = False
    """Whether it is an executing standby, which receives all goals too."""
    protocol: int = PROTOCOL
    """Version of the agents' protocol that its agent knows at least."""
    key: str = ""
    """The private key of the monitor in hex, with which this side proves itself too; empty if there is none."""


@dataclass(frozen=True)
class ControlState:
    """The state of control, as the monitor reports it."""

    workload: str
    epoch: int = 0
    """Of the gate, as the monitor knows it."""
    active: str = ""
    """UID of the active instance; empty if there is none."""
    settled: bool = True
    """Whether no failure is detected and no recovery is in progress."""
    rules: tuple[TaskRule, ...] = ()
    peers: tuple[Peer, ...] = ()
    workload_uid: str = ""
    """UID of the RobotWorkload."""
    on_board: bool = False
    """Whether an instance on board drives, or did a moment ago: the active instance could not reach the robot."""
    is_confirmed: bool = True
    """Whether the API server answers the monitor, and has confirmed since its last outage that their pod exists. If not, another monitor
    may have switched: no goal is withdrawn from an instance, and none that an instance had is given to another one."""
    pod_deleted: bool = False
    """Whether the pod of the monitor and this proxy was deleted, so that others have replaced them."""

    @property
    def gate(self) -> GateEpoch:
        """The epoch of the workload's gate, as the monitor knows it."""
        return GateEpoch(self.workload_uid, self.epoch)

    def to_wire(self) -> dict[str, Any]:
        """Return the state as one JSON object."""
        return asdict(self)

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> ControlState:
        """Read the JSON object. Raises KeyError and TypeError if it is invalid."""
        rules = tuple(TaskRule(**rule) for rule in data["rules"])
        peers = tuple(Peer(**peer) for peer in data["peers"])
        return cls(**{**data, "rules": rules, "peers": peers})

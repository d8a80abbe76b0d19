"""The monitor's sources of observations besides the objects in the cluster, as one value."""

from __future__ import annotations

from dataclasses import dataclass

from understudy.kube.gates.base import Proof
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.instance_roles import InstanceRoles
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.monitor.observe.robot.robot_readers import RobotReaders
from understudy.monitor.observe.wakeups import Wakeups


@dataclass(frozen=True)
class Senses:
    """The sources of observations of one workload."""

    observer: HealthObserver
    agents: AgentConnections
    probes: Proof
    readership: RobotReaders
    roles: InstanceRoles
    wakeups: Wakeups

    @property
    def current(self) -> CurrentRecovery:
        """The recovery in progress."""
        return self.roles.current

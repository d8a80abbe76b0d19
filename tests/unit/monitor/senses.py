"""What a monitor sees of a robot and hears of agents, as a test says it: there is neither ROS nor a network."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from tests.unit.monitor.cluster_objects import NOWHERE, ClusterObjects
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.protocol.agent_messages import AgentStatus
from understudy.failover.interfaces import Gate, Instance, Instances, Outputs
from understudy.failover.pinned import PinnedPod
from understudy.monitor.act.instances.state_manager import StateManager
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.instance_roles import InstanceRoles
from understudy.monitor.observe.robot.context_detection import SituationState
from understudy.monitor.observe.robot.degraded_tree import BusyReason
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.monitor.observe.robot.known_senders import Caller, KnownSender, OutputSender, host_at
from understudy.monitor.observe.robot.robot_readers import RobotReaders
from understudy.monitor.observe.senses import Senses
from understudy.ros.runtime.graph_node import Endpoint, Graph
from understudy.state.state_store import StateStore
from understudy.trees.core.health_tree import Verdict
from understudy.trees.core.snapshots import Snapshot

STARTING = Verdict("Starting", "nothing has come yet", "", None)


class GivenGraph(Graph):
    """A ROS graph in which there is what a test says, and no node."""

    def __init__(self) -> None:
        self.readers: dict[str, list[Endpoint]] = {}

    def subscribers(self, topic: str) -> list[Endpoint]:
        return self.readers.get(topic, [])


class NoOutputs(Outputs):
    """No output is expected of the instance in control, and none comes from another."""

    @property
    def expected(self) -> Sequence[str]:
        return ()

    async def first_from(self, instance: Instance, *, since: float) -> float | None:
        return None

    @property
    def blind(self) -> bool:
        return False

    async def heard_held_back(self, instance: Instance) -> None:
        return

    def last_from_others(self, instance: Instance) -> tuple[float, str]:
        return 0.0, ""

    def heard(self) -> Sequence[tuple[float, float]]:
        return []

    def switched_to(self, instance: Instance) -> str:
        return ""

    def period_of_others(self, instance: Instance) -> float:
        return 0.0


class GivenObserver(HealthObserver):
    """Sees of the robot what a test says."""

    def __init__(self) -> None:
        self.graph: Graph = GivenGraph()
        self.coming = None  # type: ignore[assignment]
        self.addresses = {}
        self.health, self.well = STARTING, STARTING
        """The verdicts of the health tree and of the tree of spec.degraded."""
        self.times_asked = 0
        """How often the second one was asked for."""
        self.work: BusyReason | None = None
        self.situation_states: dict[str, SituationState] = {}
        self.received_at: dict[str, float] = {}
        """When an output was last received from each pod."""
        self.received: dict[tuple[str, str], list[float]] = {}
        """When each topic was received from each pod, of late."""
        self.restarted: set[str] = set()
        """Pods whose writers are of a new process."""
        self.heard_processes: dict[str, frozenset[bytes]] = {}
        """The processes from which outputs of each pod were received."""
        self.twins: set[str] = set()
        """Pods that cannot be distinguished from others."""
        self.is_on_board = False
        """Whether an instance on board drives."""
        self.missed = ""
        """A topic that a mux at the robot does not hear."""
        self.undiscovered: set[str] = set()
        """UIDs of the instances of which discovery has found no output."""
        self.is_alone = False
        """Whether discovery has found nobody else."""
        self.searched: list[str] = []
        """UIDs of the instances of which it was asked for, each time."""
        self.senders: list[KnownSender] = []
        """The instances that exist, and those that are gone and may still send."""
        self.heard: list[OutputSender] = []
        """Who sent on an output."""
        self.clients: list[Caller] = []
        """Who has a client of an output."""
        self.troubles: list[str] = []
        self.unpublished: list[str] = []
        self.tree: Snapshot | None = None

    def follow(self, policy: FailurePolicySpec, spec: RobotWorkloadSpec | None) -> None:
        return

    def unreached(self, pod: str) -> str:
        return self.missed

    @property
    def drove_on_board(self) -> bool:
        return self.is_on_board

    def drain(self, instances: Sequence[Instance], active: str, pinned: Sequence[PinnedPod] = ()) -> None:
        return

    def outputs(self, fleet: Instances, gate: Gate) -> Outputs:
        return NoOutputs()

    def known_senders(self) -> Sequence[KnownSender]:
        return self.senders

    def output_senders(self) -> Sequence[OutputSender]:
        return self.heard

    def callers(self) -> Sequence[Caller]:
        return self.clients

    def verdict(self, *, now: float, since: float) -> Verdict:
        return self.health

    def degraded_verdict(self, *, now: float, since: float) -> Verdict:
        self.times_asked += 1
        return self.well

    def busy(self, *, now: float, since: float) -> BusyReason | None:
        return self.work

    def situations(self, goals: Collection[str], *, now: float, since: float) -> dict[str, SituationState]:
        return self.situation_states

    def deadline(self, *, now: float, since: float) -> float | None:
        return None

    def last_from(self, pod: str) -> float | None:
        return self.received_at.get(pod)

    def last_well(self, pod: str) -> float | None:
        return self.received_at.get(pod)

    def arrivals(self, topic: str, pod: str) -> Sequence[float]:
        return self.received.get((topic, pod), [])

    def new_process(self, pod: str, *, since: float) -> bool:
        return pod in self.restarted

    def processes(self, pod: str) -> frozenset[bytes]:
        return self.heard_processes.get(pod, frozenset())

    def discovered(self, instance: Instance) -> bool | None:
        self.searched.append(instance.uid)
        return instance.uid not in self.undiscovered if host_at(instance.ip) else None

    hears_nobody = False
    """Whether it has received nothing from anybody."""

    unheard = ""
    """A failing topic of the robot of which it has received nothing."""

    awaited: Sequence[str] = ()
    """The topics of the robot of which it has received nothing."""

    def others_discovered(self, instance: Instance) -> bool:
        return not self.is_alone

    def expect_samples(self, *, since: float, heard_from: float) -> None:
        return

    def ambiguous(self, pod: str) -> bool:
        return pod in self.twins

    def snapshot(self) -> Snapshot | None:
        return self.tree

    @property
    def expected(self) -> list[str]:
        return []

    @property
    def gated(self) -> list[str]:
        return []

    @property
    def problems(self) -> list[str]:
        return self.troubles

    @property
    def waiting(self) -> list[str]:
        return self.unpublished

    @property
    def summary(self) -> str:
        return "Watching /scan."


class GivenAgents(AgentConnections):
    """Agents that report what a test says."""

    def __init__(self, objects: ClusterObjects, roles: InstanceRoles) -> None:
        super().__init__(
            objects.client, objects.view, "127.0.0.1", objects.crash_points, roles, objects.wakeups, objects.proof
        )
        self.statuses: dict[str, AgentStatus] = {}
        """The last status of each instance's agent, by UID."""
        self.unready: dict[str, str] = {}
        """Why instances are not ready, by UID."""
        self.settled: list[list[str]] = []
        """The instances whose agents were waited for, each time."""

    def follow(self, instances: Sequence[Instance]) -> None:
        return

    async def settle(self, instances: Sequence[Instance], within: float) -> None:
        self.settled.append([instance.name for instance in instances])

    def status(self, instance: Instance) -> AgentStatus | None:
        return self.statuses.get(instance.uid)

    def is_ready(self, instance: Instance) -> tuple[bool, str]:
        reason = self.unready.get(instance.uid, "")
        return not reason, reason


class GivenSenses:
    """All that a monitor observes of one workload beside its objects."""

    def __init__(self, objects: ClusterObjects, observer: GivenObserver | None = None) -> None:
        self.observer = observer or GivenObserver()
        self.current = CurrentRecovery()
        self.roles = InstanceRoles(objects.view, objects.gate, self.current)
        self.agents = GivenAgents(objects, self.roles)
        self.state_manager = StateManager(self.observer.graph, StateStore(NOWHERE), self.agents, objects.notices)
        """Keeps the state that a test's policy names: none."""
        readers = RobotReaders(objects.view, self.observer, objects.notices, "127.0.0.1")
        self.value = Senses(self.observer, self.agents, objects.proof, readers, self.roles, objects.wakeups)
        """The same as the monitor's value."""

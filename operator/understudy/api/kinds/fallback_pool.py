"""FallbackPool: instances that wait at a given readiness."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from understudy.api.base import Duration, Model, ObjectName, Percentage, UnknownContent, matching, with_rules
from understudy.api.conditions import Conditions, Time
from understudy.api.kinds.label_selector import LabelSelector
from understudy.api.kinds.pod_template import pod_template
from understudy.api.kinds.procedure_spec import Check, Procedure

Readiness = Literal["Uninitialized", "Initialized", "Executing"]


@dataclass(frozen=True)
class ReadinessLevel:
    """What a readiness means. Whoever treats pools differently asks here, and never compares the names of levels."""

    shared: bool = False
    """Whether a pod belongs to no robot until a workload claims it. Otherwise every workload has standbys of its own."""
    runs_in_full: bool = False
    """Whether a standby runs as the active instance does, so that the workload's bringUp and health tree apply to it."""

    @property
    def has_standbys(self) -> bool:
        """Whether every workload has standbys of its own."""
        return not self.shared

    @property
    def is_prepared(self) -> bool:
        """Whether a procedure of the pool brings its standbys to this readiness, and the rest follows at a failover."""
        return self.has_standbys and not self.runs_in_full


LEVELS: dict[Readiness, ReadinessLevel] = {
    "Uninitialized": ReadinessLevel(shared=True),
    "Initialized": ReadinessLevel(),
    "Executing": ReadinessLevel(runs_in_full=True),
}
"""Every readiness, from the one that needs most at a failover to the one that needs least."""


_SHARED = [name for name, level in LEVELS.items() if level.shared]
_STANDBYS = [name for name, level in LEVELS.items() if level.has_standbys]
_PREPARED = [name for name, level in LEVELS.items() if level.is_prepared]


def _either(levels: Iterable[str]) -> str:
    *others, last = levels
    return f"{', '.join(others)} or {last}" if others else last


SHARED_NAMES, STANDBY_NAMES = _either(_SHARED), _either(_STANDBYS)
"""The levels of shared pools, and of pools with standbys, for messages."""


def is_shared(readiness: object) -> bool:
    """Return whether a pool with this readiness is shared; False if the readiness of a stored object is unknown."""
    return readiness in _SHARED


def has_standbys(readiness: object) -> bool:
    """Return whether every workload has standbys of its own from a pool with this readiness; False if it is unknown."""
    return readiness in _STANDBYS


def _is(levels: Iterable[str]) -> str:
    """Return the CEL expression for a pool of one of these levels."""
    return f"self.readiness in [{', '.join(repr(name) for name in levels)}]"


WARM_PATH_PATTERN = r"^/[^\x00-\x1f]+$"

WarmPath = Annotated[
    str,
    matching(WARM_PATH_PATTERN, "write the absolute path of a file or folder, such as /opt/app", max_length=1024),
]
"""A file or folder in the containers."""


PythonModule = Annotated[
    str,
    matching(
        r"^[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*$",
        "write the name of a Python module as in an import, such as rclpy or geometry_msgs.msg",
        max_length=253,
    ),
]
"""A module that the application imports."""


class TemplateSource(Model):
    """Source of the pool's pod template."""

    workload: ObjectName
    """Name of the RobotWorkload whose template is used."""


class KeepUp(Model):
    """How a waiting standby receives the state of the active instance."""

    period: Duration = "5s"
    """Time between two transfers of the kept state."""


class Reserve(Model):
    """Pods of a shared pool that are reserved for workloads with a high spec.poolPriority."""

    pods: int = Field(default=1, ge=1, le=1000)
    """Number of ready pods that are reserved."""
    pool_priority: int = Field(ge=-999, le=1000)
    """Minimum spec.poolPriority of a RobotWorkload that may claim reserved pods."""


@with_rules(("self.min <= self.max", "min must not be greater than max", ".min"))
class Sizing(Model):
    """How to compute the size of a shared pool from its workloads' failures. The command `understudy size` uses the same calculation."""

    risk: Percentage
    """Accepted share of the failures for which the pool has too few pods (see riskOf), such as 1%. The operator makes
    the pool large enough for it."""
    risk_of: Literal["Loss", "Waiting"] = "Loss"
    """What the risk is. Loss: a workload fails and no pod is ready, so the policy's next strategy is used. Waiting: a
    workload fails and has to wait for a pod; for policies with waitFor."""
    failures_per_robot_hour: float = Field(default=1.0, ge=0.0001, le=3600)
    """Prior estimate of the number of failures per robot and hour. It counts as much as one observed failure."""
    refill: Duration = "30s"
    """Time from a claim until a replacement pod is ready. Usually the start-up time of a pod."""
    history: Duration = "24h"
    """Length of the time window in which failures count."""
    min: int = Field(default=1, ge=0, le=1000)
    """Minimum number of pods."""
    max: int = Field(ge=0, le=1000)
    """Maximum number of pods, even if the risk is then exceeded."""


@with_rules(
    (
        "self.type == 'Recreate' || !has(self.minReady)",
        "minReady is allowed only for type Recreate, because OnReplenish does not remove pods",
        ".minReady",
    )
)
class UpdateStrategy(Model):
    """What happens to the waiting pods of a shared pool when its template changes. Claimed pods never change."""

    type: Literal["Recreate", "OnReplenish"] = "Recreate"
    """Recreate: new pods are created, and replace the waiting ones when they are ready (unlike Recreate of a
    Deployment). OnReplenish: waiting pods stay until they are claimed, and their replacements use the new template."""
    min_ready: int | None = Field(default=None, ge=0, le=1000)
    """For type Recreate: minimum number of ready pods during the update. Old pods above this number are deleted
    immediately, which frees resources for the new ones. Absent: an old pod is deleted only when a new ready pod
    replaces it."""


@with_rules(
    (
        f"{_is(_SHARED)} ? (has(self.replicas) || has(self.sizing)) && !has(self.perWorkload) "
        ": has(self.perWorkload) && !has(self.replicas) && !has(self.sizing)",
        f"a pool with readiness {SHARED_NAMES} is shared and needs replicas or sizing; a pool with readiness "
        f"{STANDBY_NAMES} needs perWorkload, because its standbys belong to one robot's ROS graph",
    ),
    (
        "!has(self.replicas) || !has(self.sizing)",
        "replicas and sizing exclude each other: sizing computes the size from failures, between its "
        "min and max. Remove sizing to set replicas",
        ".replicas",
    ),
    (
        f"{_is(_SHARED)} ? has(self.template) != has(self.templateFrom) "
        ": !has(self.template) && !has(self.templateFrom)",
        f"a pool with readiness {SHARED_NAMES} needs exactly one of template and templateFrom; a pool with readiness "
        f"{STANDBY_NAMES} has neither, because it uses the template of each workload",
    ),
    *(
        (
            f"{_is(_STANDBYS)} || !has(self.{field})",
            f"{field} is allowed only for pools with readiness {STANDBY_NAMES}",
            f".{field}",
        )
        for field in ("initialization", "readinessCheck", "keepUp")
    ),
    (
        f"{_is(_SHARED)} || !has(self.reserve)",
        f"reserve is allowed only for pools with readiness {SHARED_NAMES}, because other standbys belong to one workload",
        ".reserve",
    ),
    (
        f"{_is(_SHARED)} || !has(self.updateStrategy)",
        f"updateStrategy is allowed only for pools with readiness {SHARED_NAMES}: standbys of other pools use their "
        "workload's template, and an old standby stays until its replacement is ready",
        ".updateStrategy",
    ),
    (
        f"{_is(_SHARED)} || !has(self.preload)",
        f"preload is allowed only for pools with readiness {SHARED_NAMES}: the processes of other standbys run and have their modules",
        ".preload",
    ),
    (
        f"!({_is(_PREPARED)}) || has(self.initialization)",
        f"a pool with readiness {_either(_PREPARED)} needs an initialization, the procedure that prepares its standbys",
        ".initialization",
    ),
    ("self.readiness == oldSelf.readiness", "readiness is immutable: create another pool", ".readiness"),
)
class FallbackPoolSpec(Model):
    """A pool of instances that wait to take over."""

    readiness: Readiness
    """How far the pool's instances are prepared. Uninitialized: the pods run, but their processes are held (start
    later) until a workload claims (takes) the pod; several workloads share the pool. Initialized: the application runs
    and is configured by spec.initialization. Executing: the application runs completely. The gate blocks the outputs of
    every instance that waits, except one if the workload has a reflex."""
    replicas: int | None = Field(default=None, ge=0, le=1000)
    """Only for readiness Uninitialized: number of unclaimed pods to keep. Set either this field or sizing."""
    sizing: Sizing | None = None
    """Only for readiness Uninitialized: the operator computes the number of unclaimed pods from the failures of the
    workloads that use the pool. Set either this field or replicas. See docs/sizing.md."""
    per_workload: int | None = Field(default=None, ge=0, le=8)
    """Only for readiness Initialized or Executing: number of standbys for each workload."""
    workload_selector: LabelSelector
    """Labels of the RobotWorkloads that this pool serves, in the same namespace. An empty selector selects all of
    them."""
    template: UnknownContent | None = Field(
        default=None,
        json_schema_extra=pod_template(
            (
                "has(self.command) && size(self.command) > 0",
                "command is required in a pool's template: Understudy starts it when the pod is claimed",
                ".command",
            )
        ),
    )
    """Pod template of an Uninitialized pool. Every container needs a command, which Understudy starts only when the pod
    is claimed."""
    template_from: TemplateSource | None = None
    """Use the template of a RobotWorkload instead of template."""
    initialization: Procedure | None = None
    """Only for readiness Initialized (required) or Executing: procedure that brings a started standby to the pool's
    readiness, such as lifecycle transitions. Absent in an Executing pool: the workload's bringUp is used."""
    readiness_check: Check | None = None
    """Only for readiness Initialized or Executing: condition that a standby must meet after its initialization before
    it counts as ready. Absent in an Executing pool: the policy's health tree must succeed. Absent in an Initialized
    pool: no condition except the initialization."""
    keep_up: KeepUp | None = None
    """Only for readiness Initialized: waiting standbys periodically receive the kept state (spec.state of the policy),
    so that a recovery has less to restore. No effect in an Executing pool, whose standbys have state of their own."""
    reserve: Reserve | None = None
    """Only for readiness Uninitialized: ready pods that only workloads with a high spec.poolPriority may claim. Absent:
    any workload may claim the last pod. See docs/waiting.md."""
    update_strategy: UpdateStrategy | None = None
    """Only for readiness Uninitialized: what happens to waiting pods when the pool's template changes. Absent:
    Recreate."""
    warm_paths: list[WarmPath] = Field(default_factory=list, max_length=16)
    """Files and folders that each container reads once while it is held, so that they are in the node's page cache when
    the application starts."""
    preload: list[PythonModule] | None = Field(default=None, min_length=1, max_length=64)
    """Only for readiness Uninitialized: Python modules that each container whose command begins with python3 imports
    while it is held. The application then runs in that interpreter, so its start takes less time and the waiting pod
    more memory. See docs/pools.md."""

    @property
    def level(self) -> ReadinessLevel:
        """What its readiness means."""
        return LEVELS[self.readiness]

    def kept_from(self, priority: int) -> int:
        """Return how many of the ready pods a workload with this poolPriority may not claim."""
        return self.reserve.pods if self.reserve is not None and priority < self.reserve.pool_priority else 0


class SizingStatus(Model):
    """The computed size and the figures behind it. Figures have two significant digits."""

    size: int
    """Number of unclaimed pods to keep now."""
    last_change: Time
    """When the size last changed, RFC 3339."""
    needed: int
    """Smallest size within spec.sizing.risk at the expected failure rate, before min and max are applied."""
    robots: int
    """Number of workloads that can claim a pod of this pool."""
    failures: int
    """Number of failures within spec.sizing.history in which a workload claimed a pod of this pool or found none."""
    robot_hours: float
    """Total time for which the workloads were observed, in robot hours."""
    failures_per_robot_hour: float
    """Expected number of failures per robot and hour."""
    low: float
    """Lower bound of failuresPerRobotHour: the true rate is higher with a probability of 95%."""
    high: float
    """Upper bound of failuresPerRobotHour: the true rate is lower with a probability of 95%."""


class FallbackPoolStatus(Model):
    """Observed state."""

    observed_generation: int | None = None
    """Generation of the spec that was last reconciled."""
    replicas: int | None = None
    """Number of waiting (unclaimed) pods that exist."""
    desired: int | None = None
    """Number of waiting pods that should exist."""
    ready: int | None = None
    """Number of waiting pods that could take over now."""
    claimed: int | None = None
    """Number of this pool's pods that were claimed (taken for a workload) or have taken over."""
    updated: int | None = None
    """Only for readiness Uninitialized: number of unclaimed pods with the current template; see the condition
    Updated."""
    waiting: int | None = None
    """Only for readiness Uninitialized: number of workloads that wait for a pod; see the condition Available."""
    sizing: SizingStatus | None = None
    """Result of spec.sizing."""
    selector: str | None = None
    """Label selector of the pool's pods, for the scale subresource."""
    conditions: Conditions | None = None
    """Each is True if the following holds. Accepted: the spec is valid, and pods can be created. Reconciled: all
    objects match the spec. Ready: every pod of the desired number could take over now. Available (only Uninitialized):
    a workload that fails now could claim a pod; if not, with the reason Dry, the message lists the waiting workloads in
    the order in which they will get a pod. Sized (if spec.sizing is set): max is large enough for the risk; the message
    explains the computed size. Updated (only Uninitialized): every unclaimed pod uses the current template, or
    updateStrategy OnReplenish lets earlier ones stay. Moving: pods are being replaced on other nodes, because their
    node is being drained or was lost."""

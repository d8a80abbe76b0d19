"""Answers for each strategy: whether it could run now, and if not, what is missing. Pure.

Monitor and operator describe what each of them sees as ``Resources``; the answer is the same for the same resources. The monitor uses it
during a recovery, the operator for the condition Protected, and ``understudy explain``, ``status`` and ``check`` show it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from understudy.api.kinds.fallback_pool import has_standbys, is_shared

NO_POOL = "NoPool"
POOL_DOES_NOT_SERVE = "PoolDoesNotServe"
POOL_NOT_ACCEPTED = "PoolNotAccepted"
POOL_EMPTY = "PoolEmpty"
STANDBY_NOT_READY = "StandbyNotReady"
PODS_RESERVED = "PodsReserved"
PODS_AWAITED = "PodsAwaited"
PODS_CLAIMED = "PodsClaimed"
INSTANCE_GONE = "InstanceGone"
DISCOVERY_NOT_READY = "DiscoveryNotReady"

NAMED = 3
"""Maximum number of workloads that a message names."""


@dataclass(frozen=True)
class Problem:
    """Why something is missing."""

    reason: str
    """CamelCase, as in a condition."""
    message: str


@dataclass(frozen=True)
class Availability:
    """Whether a strategy could run now."""

    available: bool
    reason: str = ""
    """Why not; empty if it could."""
    message: str = ""
    """What is missing, or what it would use."""

    @classmethod
    def missing(cls, problem: Problem) -> Availability:
        """Return that the strategy is not available because of a problem."""
        return cls(False, problem.reason, problem.message)


@dataclass(frozen=True)
class Pool:
    """A pool as far as one workload is concerned. The problems are messages that are used if nothing is ready."""

    readiness: str = ""
    """Empty if the pool was never accepted."""
    serves: bool = True
    """Whether its workloadSelector selects the workload."""
    wanted: int | None = None
    """How many pods or standbys it should have; None if that is not known."""
    size_field: str = "spec.replicas"
    """The field of a shared pool that sets this number."""
    ready: int = 0
    """How many are ready: standbys of the workload, or unclaimed pods of a shared pool."""
    reserved: int = 0
    """Ready pods that a shared pool keeps for other workloads."""
    ahead: tuple[str, ...] = ()
    """Workloads that wait for a pod of a shared pool and come first."""
    uses: str = ""
    """What the strategy would use, such as the name of the standby."""
    refused: Problem | None = None
    """Why the present spec of the pool is not accepted."""
    pod_problem: Problem | None = None
    """What is wrong with the first pod that is not ready."""


@dataclass(frozen=True)
class Resources:
    """The resources of the strategies of one workload, at one instant."""

    pools: Mapping[str, Pool] = field(default_factory=dict)
    discovery: Problem | None = None
    """Why the ROS discovery server is not ready. A process that starts without it does not find its robot."""
    restart: Problem | None = None
    """Why the workload's own controller cannot run a pod."""
    hints: Mapping[str, str] = field(default_factory=dict)
    """The existing pools, as text, by the name of a pool that does not exist."""


def restart(there: Resources) -> Availability:
    """Return whether a restart could run."""
    problem = there.discovery or there.restart
    return Availability.missing(problem) if problem is not None else Availability(True)


def fallback(name: str, there: Resources) -> Availability:
    """Return whether a fallback to a pool could run."""
    pool = there.pools.get(name)
    if pool is None:
        hint = f" ({there.hints[name]})" if name in there.hints else ""
        text = f'FallbackPool "{name}", which its policy names, does not exist{hint}. Create it, or correct the policy'
        return Availability(False, NO_POOL, text)
    if not pool.serves:
        text = (
            f"FallbackPool {name} does not serve this RobotWorkload: the pool's workloadSelector does not match the workload's "
            "labels. Add the selector's labels to metadata.labels of the RobotWorkload, or correct the selector"
        )
        return Availability(False, POOL_DOES_NOT_SERVE, text)
    if has_standbys(pool.readiness):
        return _standby(name, pool, there)
    if is_shared(pool.readiness):
        return _shared(name, pool, there)
    text = f"FallbackPool {name} was not accepted: kubectl describe fbp {name}"
    return Availability(False, POOL_NOT_ACCEPTED, text)


def _standby(name: str, pool: Pool, there: Resources) -> Availability:
    """Return whether a standby could take over. A ready standby has found its robot; one that must start needs the discovery server."""
    if pool.wanted != 0 and pool.ready:
        return Availability(True, message=pool.uses)
    if there.discovery is not None:
        return Availability.missing(there.discovery)
    if pool.wanted == 0:
        return Availability(False, POOL_EMPTY, f"FallbackPool {name} has spec.perWorkload 0")
    if pool.refused is not None:
        text = f"FallbackPool {name} is not accepted, so no standby is created: {pool.refused.message}"
        return Availability(False, POOL_NOT_ACCEPTED, text)
    if pool.pod_problem is not None:
        return Availability.missing(pool.pod_problem)
    return Availability(
        False, STANDBY_NOT_READY, f"no standby of FallbackPool {name} is ready (see the condition BroughtUp)"
    )


def _shared(name: str, pool: Pool, there: Resources) -> Availability:
    """Return whether a pod of a shared pool could take over. It starts when it is claimed, so it needs the discovery server."""
    if there.discovery is not None:
        return Availability.missing(there.discovery)
    if pool.ready > pool.reserved + len(pool.ahead):
        return Availability(True, message=pool.uses)
    if pool.ready > pool.reserved:
        others = ", ".join(pool.ahead[:NAMED])
        free = pool.ready - pool.reserved
        text = f"other workloads are first in the queue for the ready pods ({free}) of FallbackPool {name}: {others}"
        return Availability(False, PODS_AWAITED, text)
    if pool.ready:
        text = (
            f"FallbackPool {name} reserves its last ready pods ({pool.reserved}, by its spec.reserve) for workloads with a higher "
            "spec.poolPriority, and no other pod is ready"
        )
        return Availability(False, PODS_RESERVED, text)
    if pool.wanted == 0:
        return Availability(False, POOL_EMPTY, f"FallbackPool {name} has {pool.size_field} 0")
    if pool.pod_problem is not None:
        return Availability.missing(pool.pod_problem)
    return Availability(False, STANDBY_NOT_READY, f"no pod of FallbackPool {name} is ready")

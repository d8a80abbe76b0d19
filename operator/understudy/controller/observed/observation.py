"""The observed state around a workload, and values that follow from it alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError

from understudy.api import names
from understudy.api.kinds.switchover_spec import Phase
from understudy.api.protocol.monitor_settings import PoolChoice, WorkloadSettings
from understudy.controller.observed import committed_recovery, kube_objects, pool_reader, workload_reference
from understudy.controller.plan import Problem
from understudy.kube.client import CONFIG_MAPS, Object
from understudy.kube.gates import registry
from understudy.kube.gates.cilium import PolicyMapUse

_UNDER_WAY: tuple[Phase, ...] = ("Preparing", "Switching")
"""The phases of a planned switchover that use an understudy."""


@dataclass(frozen=True)
class Observed:
    """The observed state around a workload."""

    workload: Object
    now: float
    policies: Mapping[str, Object] = field(default_factory=dict)
    """All FailurePolicies of the namespace."""
    config_maps: Mapping[str, Object] = field(default_factory=dict)
    """The ConfigMaps of the namespace that policies may read, and those of Understudy."""
    pools: Mapping[str, Object] = field(default_factory=dict)
    """All FallbackPools of the namespace."""
    held_policies: Mapping[str, Object] = field(default_factory=dict)
    """The network policies of the pools' held pods, by pool."""
    owned: Mapping[tuple[str, str], Object] = field(default_factory=dict)
    """Objects that the workload controls, except pods, by plural and name."""
    pods: Sequence[Object] = ()
    """The workload's pods: by its label, by their owner, or by their spec if their controller has released them."""
    monitors: Sequence[Object] = ()
    """The monitor's pods."""
    discovery: Sequence[Object] = ()
    """The managed discovery server's pods."""
    unclaimed: Mapping[str, Sequence[Object]] = field(default_factory=dict)
    """Held pods, by pool."""
    reference: workload_reference.ReferencedObjects | None = None
    """The object of ``workloadRef``; None if the workload has a template."""
    rivals: Sequence[str] = ()
    """Older RobotWorkloads that refer to the same controller."""
    expected: Mapping[str, int] = field(default_factory=dict)
    """Number of standbys that were created but not yet observed, by pool."""
    dependencies: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """The dependencies of each workload of the namespace; empty if this workload has none."""
    resized: Object | None = None
    """The complete active pod, if the workload is degraded and its policy then gives it more resources; else None."""
    cordoned: frozenset[str] = frozenset()
    """The nodes of the cluster that are being drained or are cordoned."""
    budgets: Sequence[Object] = ()
    """PodDisruptionBudgets of the namespace that Understudy did not create."""
    leaving: frozenset[str] = frozenset()
    """The nodes whose pods are about to go."""
    nodes: Sequence[Object] = ()
    """The nodes of the cluster."""
    going: frozenset[str] = frozenset()
    """The deleted shared pools that still have claimable pods, of those whose agents the monitor may command."""
    apiservers: tuple[tuple[str, int], ...] = ()
    """Addresses and ports of the API server, if the workload has a reflex."""
    policy_map: PolicyMapUse | None = None
    """What the gate needs of Cilium's policy map, if there is little room; None if there is enough, or the network is not Cilium."""
    policy_map_known: bool = False
    """Whether the operator has looked for that."""

    def left(self, seconds: float, *, since: float) -> float:
        """Return how many seconds are left of this many since a time (Unix seconds); not above 0 if they have passed."""
        return seconds - (self.now - since)

    @property
    def policy(self) -> Object | None:
        """The workload's policy, or None."""
        name = ((self.workload.get("spec") or {}).get("failurePolicyRef") or {}).get("name", "")
        return self.policies.get(name)

    @property
    def serving(self) -> dict[str, Object]:
        """The pools whose selector matches the workload, except those that are being deleted."""
        return {
            name: pool
            for name, pool in self.pools.items()
            if not kube_objects.deleted(pool) and pool_reader.serves(pool, self.workload)
        }

    @property
    def standby_pools(self) -> dict[str, Object]:
        """The pools that keep standbys of the workload's own template."""
        return {name: pool for name, pool in self.serving.items() if pool_reader.has_standbys(pool)}

    def refused(self, pool: str) -> Problem | None:
        """Return why a pool is not accepted, or None.

        No pods are created for such a pool, and its existing ones stay unchanged.
        """
        return pool_reader.problem(self.pools[pool])

    @property
    def written_settings(self) -> WorkloadSettings | None:
        """The settings that the operator last wrote for the monitor; None if missing or unreadable."""
        present = self.owned.get((CONFIG_MAPS.plural, names.settings(kube_objects.name(self.workload))))
        text = ((present or {}).get("data") or {}).get("settings.json")
        try:
            return WorkloadSettings.model_validate_json(text) if text else None
        except ValidationError:
            return None

    @property
    def written_pools(self) -> list[PoolChoice]:
        """The pools in the monitor's last settings."""
        settings = self.written_settings
        return settings.pools if settings is not None else []

    @property
    def gate(self) -> Object | None:
        """The gate object, or None."""
        resource = registry.of(self.workload).resource
        return self.owned.get((resource.plural, names.gate(kube_objects.name(self.workload))))

    @property
    def active(self) -> Object | None:
        """The active pod, or None."""
        return next((p for p in self.pods if kube_objects.is_active(p, self.gate) and kube_objects.alive(p)), None)

    @property
    def instances(self) -> list[Object]:
        """The workload's pods, including those of a referred controller that are not labelled yet, oldest first."""
        found = {kube_objects.uid(pod): pod for pod in self.pods}
        if self.reference is not None:
            found |= {kube_objects.uid(pod): pod for pod in self.reference.pods}
        return sorted(found.values(), key=kube_objects.sort_key)

    @property
    def written_recovering(self) -> bool:
        """Whether the monitor reports a recovery: first at the gate, and in the status if the recovery takes long."""
        health = (self.workload.get("status") or {}).get("health")
        return health == "Recovering" or committed_recovery.under_way(self.workload, self.gate, self.now)

    @property
    def recovering(self) -> bool:
        """Whether a recovery is in progress, as far as the operator can see.

        A gate that somebody deleted counts as the closed one that is created in its place: the instance that it named may drive again.
        """
        epoch = kube_objects.notes(self.gate).get(names.EPOCH, "0") if self.gate else str(self.reported_epoch)
        return self.written_recovering or (epoch != "0" and not kube_objects.active(self.gate)[0])

    @property
    def reported_epoch(self) -> int:
        """The last epoch of the gate that the monitor has reported; 0 if it has reported none."""
        return ((self.workload.get("status") or {}).get("gate") or {}).get("epoch") or 0

    @property
    def handing_over(self) -> bool:
        """Whether a planned switchover is requested or, as the monitor reports, in preparation or in progress.

        A switchover that waits for a drain does not count. It may wait as long as the drain lasts, for a pod that is
        created meanwhile.
        """
        asked = kube_objects.notes(self.workload).get(names.SWITCHOVER)
        return bool(asked and asked != self.switchover.get("handled")) or self.switchover.get("phase") in _UNDER_WAY

    @property
    def switchover(self) -> Mapping[str, Any]:
        """The monitor's report of the last planned switchover; empty if there was none."""
        return (self.workload.get("status") or {}).get("switchover") or {}

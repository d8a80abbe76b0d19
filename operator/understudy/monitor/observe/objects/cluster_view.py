"""The monitor's local copies of objects in the cluster, from watches: its workload, policy, settings, gate and pods."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence

from pydantic import ValidationError

from understudy.api import names
from understudy.api.kinds.failure_policy import FailurePolicySpec, following, in_force
from understudy.api.kinds.procedure_spec import Procedure
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.failover.progress import PodIdentity
from understudy.kube.client import CONFIG_MAPS, PODS, POLICIES, WORKLOADS, Client, Object
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateKind, GateRecord
from understudy.kube.repeated_requests import answered
from understudy.kube.watched_collection import Reflector, any_changed
from understudy.monitor.observe.objects import long_trees
from understudy.monitor.observe.objects.unclaimed_pods import Unclaimed
from understudy.monitor.observe.wakeups import Wakeups
from understudy.trees.languages.procedure_notations import composed
from understudy.trees.source.problems import TreeError

_logger = logging.getLogger(__name__)

POLICY_WITHIN = 10.0
"""Maximum seconds that a new monitor waits for its policy. The monitor may have no right to read it as long as the operator is away, or if
the operator does not accept a spec that names another policy. The monitor must look after the gate nevertheless.
"""


def unloadable(procedures: Sequence[tuple[str, Procedure]]) -> str | None:
    """Return the first error in the trees of procedures, each given with its path for messages; None if all trees load."""
    for path, procedure in procedures:
        try:
            composed(procedure, path=path)
        except TreeError as error:
            return error.in_short()
    return None


def _version(item: Object) -> str:
    return f"{item['metadata']['uid']} {item['metadata']['resourceVersion']}"


def _only(name: str) -> str:
    return f"metadata.name={name}"


class ClusterView:
    """Local copies of all objects that the monitor's decisions depend on."""

    def __init__(
        self,
        client: Client,
        namespace: str,
        workload: str,
        wakeups: Wakeups,
        gate: GateKind = registry.DEFAULT,
        me: PodIdentity | None = None,
    ) -> None:
        """``gate`` is the kind of the workload's gate; ``me`` is this monitor's pod, if it is known."""
        self.client, self.namespace, self.workload, self.me = client, namespace, workload, me
        self.pod_deleted = False
        """Whether this monitor's pod was deleted while its process lives on (own_pod.py)."""
        self.pod_confirmed = 0
        """The number of the API server's return after which it was last asked for this monitor's pod, and the pod was not deleted."""
        self._wakeups = wakeups
        self.gate_kind = gate

        self.workloads = Reflector(client, WORKLOADS, namespace, fields=_only(workload), on_change=self._refer)
        self.policies = self._watching_policy("")
        """The policy that the workload refers to; no others are watched."""
        self.settings_maps = Reflector(
            client, CONFIG_MAPS, namespace, fields=_only(names.settings(workload)), on_change=self._queue
        )
        self.gates = Reflector(client, gate.resource, namespace, fields=_only(names.gate(workload)))
        self.pods = Reflector(
            client, PODS, namespace, labels=f"{names.WORKLOAD}={workload}", on_change=wakeups.pod_changed
        )
        self.claimed_pods = Reflector(
            client, PODS, namespace, labels=f"{names.CLAIMED_BY}={workload}", on_change=wakeups.pod_changed
        )
        """Pods that the workload has claimed. Watched only if it may claim some, or has: each watch costs the API server something."""
        self._claimed_watch: asyncio.Task[None] | None = None
        self._unclaimed: dict[str, Unclaimed] = {}
        self.waiting_gates = [
            Reflector(client, resource, namespace, labels=names.WAITS_FOR) for resource in registry.GATE_RESOURCES
        ]
        """The gates of workloads that wait for a pod of a shared pool: usually none. Watched only if this workload may use such a pool."""
        self.source_pods: Reflector | None = None
        self._group: asyncio.TaskGroup | None = None
        self._referred = ""
        self._policy_watch: asyncio.Task[None] | None = None
        self._waiting_watches: list[asyncio.Task[None]] = []
        self._policy: FailurePolicySpec | None = None
        self._policy_version: tuple[str, int] = ("", 0)
        self._policy_trees, self._workload_trees = long_trees.ReadAhead(wakeups), long_trees.ReadAhead(wakeups)
        self._gate_record: tuple[Object | None, GateRecord | None] = (None, None)
        """The gate object that was read last, and its record."""
        self._followed: tuple[FailurePolicySpec | None, WorkloadSettings | None, FailurePolicySpec | None] = (None,) * 3
        self._spec: tuple[tuple[int, int], RobotWorkloadSpec | None] = ((-1, 0), None)
        self._settings: tuple[int, WorkloadSettings | None] = (-1, None)

    async def run(self, group: asyncio.TaskGroup) -> None:
        """Start the watches and wait for the first copies."""
        self._group = group
        watches = [self.workloads, self.settings_maps, self.gates, self.pods]
        for watch in watches:
            group.create_task(watch.run())
        for watch in watches:
            await watch.synced.wait()
        try:
            async with asyncio.timeout(POLICY_WITHIN):
                while self._referred and not self.policies.synced.is_set():
                    await any_changed((self.policies, self.workloads))
        except TimeoutError:
            _logger.warning(
                "cannot read FailurePolicy %s yet: the monitor starts without a policy, and uses it as soon as it can read it",
                self._referred,
            )
        claimed = await answered(
            lambda: self.client.list(PODS, self.namespace, labels=f"{names.CLAIMED_BY}={self.workload}")
        )
        if claimed["items"]:
            self.follow_claimed()
        while self.settings is None:
            _logger.info("waiting for ConfigMap %s", names.settings(self.workload))
            await self.settings_maps.changed()
        if self._claimed_watch is not None:
            await self.claimed_pods.synced.wait()
        if self.settings.source_selector:
            labels = ",".join(f"{key}={value}" for key, value in self.settings.source_selector.items())
            self.source_pods = Reflector(
                self.client, PODS, self.namespace, labels=labels, on_change=self._wakeups.pod_changed
            )
            group.create_task(self.source_pods.run())
            await self.source_pods.synced.wait()

    def _watching_policy(self, name: str) -> Reflector:
        """Return a watch of one policy by its name. The monitor has no right to read all policies of the namespace."""
        return Reflector(self.client, POLICIES, self.namespace, fields=_only(name))

    def _refer(self) -> None:
        """Watch the policy that the workload refers to now. Until it has been read, the last one stays in force."""
        spec = self.spec
        if self._group is None or spec is None or spec.failure_policy_ref.name == self._referred:
            return
        self._read_policy(self.policies.items.get(self._referred))
        self._referred = spec.failure_policy_ref.name
        if self._policy_watch is not None:
            self._policy_watch.cancel()
        self.policies = self._watching_policy(self._referred)
        self._policy_watch = self._group.create_task(self.policies.run())

    def _queue(self) -> None:
        """Watch which workloads wait for pods of shared pools, as long as this workload may claim from such a pool.

        Nothing waits for the first copies: without them, the order in which workloads get pods may be less fair.
        """
        settings = self.settings
        if self._group is None or settings is None:
            return
        shared = any(pool.level.shared for pool in settings.pools)
        if shared:  # a claim of the monitor before this one may still be under way
            self.follow_claimed()
        if shared and not self._waiting_watches:
            self._waiting_watches = [self._group.create_task(one.run()) for one in self.waiting_gates]
        elif not shared:
            for watch in self._waiting_watches:
                watch.cancel()
            self._waiting_watches = []

    @property
    def pod_watches(self) -> list[Reflector]:
        """The watches that report the workload's pods. One pod may be in several."""
        claimed = [self.claimed_pods] if self._claimed_watch is not None else []
        return [self.pods, *claimed, *([self.source_pods] if self.source_pods else [])]

    @property
    def pods_revision(self) -> tuple[int, ...]:
        """A value that changes whenever one of the workload's pods changes."""
        return self.pods.revision, self.claimed_pods.revision, self.source_pods.revision if self.source_pods else 0

    @property
    def object(self) -> Object | None:
        """The RobotWorkload itself; None if it is gone."""
        return self.workloads.items.get(self.workload)

    @property
    def gate_object(self) -> Object | None:
        """The workload's gate object, as last seen or committed; None if there is none."""
        return self.gates.items.get(names.gate(self.workload))

    @property
    def gate_record(self) -> GateRecord | None:
        """The record of the workload's gate, as last seen or committed; None if there is no gate object."""
        if (gate := self.gate_object) is None:
            return None
        known, record = self._gate_record
        if known is gate and record is not None and record.version == gate["metadata"]["resourceVersion"]:
            return record  # every evaluation asks several times
        record = GateRecord.of(gate)
        self._gate_record = (gate, record)
        return record

    def fenced(self, record: GateRecord, now: float) -> bool:
        """Return whether a user has fenced the robot by this record of the gate, and may not have ended the pause yet. ``now`` is in Unix
        seconds."""
        item, spec = self.object, self.spec
        if not record.fenced:
            return False
        if item is None or spec is None or item["metadata"].get("generation", 0) < record.fenced:
            return True
        return spec.pause is not None and spec.pause.in_force(now)

    @property
    def retired(self) -> bool:
        """Whether the workload is deleted or being deleted, so that the monitor recovers nothing."""
        item = self.object
        return item is None or bool(item["metadata"].get("deletionTimestamp"))

    @property
    def spec(self) -> RobotWorkloadSpec | None:
        """The workload's spec in force: the last valid one if the present one is invalid. None if the workload is gone."""
        read = (self.workloads.revision, self._workload_trees.revision)
        if self._spec[0] != read:
            item, spec = self.object, None
            if item is not None:
                spec = self._spec[1]
                try:
                    workload_spec = RobotWorkloadSpec.model_validate(item["spec"])
                    if spec is None or self._followable(item, workload_spec):
                        spec = workload_spec
                    else:
                        # A pause applies even if the rest of the spec is invalid.
                        spec = spec.model_copy(update={"pause": workload_spec.pause})
                except ValidationError as error:
                    _logger.error("RobotWorkload %s cannot be read, keeping its last spec: %s", self.workload, error)
            self._spec = (read, spec)
        return self._spec[1]

    def _followable(self, item: Object, spec: RobotWorkloadSpec) -> bool:
        """Return whether the workload's new spec can be followed already."""
        problem: str | None = "it has long trees that the operator has not accepted"
        if not long_trees.unaccepted(item):
            trees = long_trees.procedures_of(spec)
            if not self._has_read(self._workload_trees, item, trees):
                return False
            problem = unloadable(trees)
        if problem is not None:
            _logger.error("RobotWorkload %s cannot be followed, keeping its last spec: %s", self.workload, problem)
        return problem is None

    def _has_read(self, ahead: long_trees.ReadAhead, item: Object, trees: long_trees.Trees) -> bool:
        return self._group is None or ahead.has_read(_version(item), trees, self._group)

    @property
    def settings(self) -> WorkloadSettings | None:
        """The settings that the operator resolved for this monitor; the last valid ones if their ConfigMap was deleted or changed."""
        if self._settings[0] != self.settings_maps.revision:
            item = self.settings_maps.items.get(names.settings(self.workload))
            found = self._settings[1]
            if item is not None:
                try:
                    found = WorkloadSettings.model_validate_json(item["data"]["settings.json"])
                except (ValidationError, KeyError) as error:
                    _logger.error(
                        "ConfigMap %s cannot be read, keeping the last settings: %s",
                        names.settings(self.workload),
                        error,
                    )
            self._settings = (self.settings_maps.revision, found)
        return self._settings[1]

    @property
    def policy(self) -> FailurePolicySpec | None:
        """The policy in force: the one that the workload refers to, or the last valid one if that is missing or invalid.

        If the policy leaves its strategies to the operator, or has situations, it contains the strategies that the operator put in
        force for this workload. If there is no earlier policy, a policy with a recovery that does not load is used nevertheless: that
        strategy fails, but the workload is monitored.
        """
        written_policy, settings = self._written_policy(), self.settings
        if written_policy is None or not written_policy.varies:
            self._followed = (written_policy, settings, written_policy)
        elif self._followed[0] is not written_policy or self._followed[1] is not settings:
            before = self._followed[2]
            found = following(written_policy, settings.strategies if settings is not None else None)
            if found is None:
                _logger.error(
                    "the operator has not chosen strategies for this policy yet, so the earlier ones stay in use: see the condition "
                    "StrategiesChosen"
                )
            # The object stays the same as long as its content is equal, so that readers can compare by identity.
            self._followed = (written_policy, settings, before if found is None or found == before else found)
        return self._followed[2]

    def _written_policy(self) -> FailurePolicySpec | None:
        """Return the last valid policy, as the user wrote it."""
        spec = self.spec
        self._read_policy(self.policies.items.get(spec.failure_policy_ref.name) if spec else None)
        return self._policy

    def _read_policy(self, item: Object | None) -> None:
        if item is None or (read := (_version(item), self._policy_trees.revision)) == self._policy_version:
            return
        self._policy_version = read
        found = self._followable_policy(item)
        if isinstance(found, FailurePolicySpec):
            self._policy = found
        elif found is not None:
            _logger.error("FailurePolicy %s %s, keeping the last one", item["metadata"]["name"], found)

    def _followable_policy(self, item: Object) -> FailurePolicySpec | str | None:
        """Return the spec of a policy, or why it cannot be followed; None if its trees are still being read."""
        first = self._policy is None
        if not first and long_trees.unaccepted(item):
            return "has long trees that the operator has not accepted"
        try:
            spec = in_force(FailurePolicySpec.model_validate(item["spec"]), item.get("status"))
        except ValidationError as error:
            return f"cannot be read: {error}"
        if spec is None:
            return "has no health tree yet (see its Accepted condition)"
        if first:
            return spec
        if not self._has_read(self._policy_trees, item, long_trees.of_policy(spec)):
            return None
        problem = unloadable(spec.recoveries)
        return spec if problem is None else f"cannot be followed: {problem}"

    def unclaimed(self, pool: str) -> Unclaimed:
        """Return the unclaimed pods of a shared pool."""
        return self._unclaimed.setdefault(pool, Unclaimed(self.client, self.namespace, pool))

    @property
    def stocked(self) -> Sequence[str]:
        """The shared pools that this workload could claim from, according to the operator's last settings."""
        found: list[str] = ((self.object or {}).get("status") or {}).get("stocked") or []
        return found

    def all_pods(self) -> list[Object]:
        """Return the pods of this workload, including pods of the controller in ``workloadRef`` that have no label yet."""
        pods = dict(self.source_pods.items) if self.source_pods else {}
        return list((pods | self.claimed_pods.items | self.pods.items).values())

    def follow_claimed(self) -> None:
        """Watch the pods that the workload has claimed, from now on."""
        if self._claimed_watch is None and self._group is not None:
            self._claimed_watch = self._group.create_task(self.claimed_pods.run())

    def put(self, pod: Object) -> None:
        """Enter a pod of the workload as an answer of the API server shows it."""
        claimed = (pod["metadata"].get("labels") or {}).get(names.CLAIMED_BY)
        (self.claimed_pods if claimed else self.pods).put(pod)

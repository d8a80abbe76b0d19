"""The workload's pods as instances, and the operations on them: claim, retire, replace, label."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import AbstractAsyncContextManager
from functools import partial

from understudy.api import names
from understudy.api.protocol.agent_messages import OLDEST_PROTOCOL, PROTOCOL
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.api.whole_numbers import whole_number
from understudy.failover.interfaces import ClaimLost, Instance, NotAvailable
from understudy.kube import claims
from understudy.kube.apply import controller_of, released
from understudy.kube.client import EVICTION, FAILURES, NETWORK_POLICIES, PODS, REPLICA_SETS, ApiError, Client, Object
from understudy.kube.gates import pool_pod_policies
from understudy.kube.repeated_requests import TRY_WITHIN, answered
from understudy.kube.watched_collection import any_changed
from understudy.monitor.crash_points import CrashPoints
from understudy.monitor.notices import Notices, PodClaimed
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.trees.core.observations import PodCondition

_logger = logging.getLogger(__name__)

CRASH_LOOP = "CrashLoopBackOff"
"""The kubelet's reason if it delays the start of a container that ended repeatedly."""

LIST_WITHIN = 1.0
"""Seconds without an answer to a list after which the API server is asked for something small."""

ASK_PERIOD = 0.25
"""Seconds between two of these requests."""

GONE = (404, 409, 422)
"""Status of the answers to a write that names the UID of a pod, if no pod has that name or another one has it."""

SHORTEST_GRACE = 1
"""Grace period in seconds for a pod that still reaches the robot. With 0 its object would be gone at once, whether it has ended or not."""

STATEFUL_SET_GRACE = 1
"""Grace period in seconds for a failed pod of a StatefulSet. Its replacement has the same name and waits until it is gone."""


def instance_of(pod: Object) -> Instance:
    """Convert a pod to an instance."""
    metadata, status = pod["metadata"], pod.get("status", {})
    labels = metadata.get("labels") or {}
    conditions = {c["type"]: c["status"] for c in status.get("conditions") or []}
    reasons = {c["type"]: c.get("reason") for c in status.get("conditions") or []}
    containers = [c for c in status.get("containerStatuses") or [] if c.get("name") != names.AGENT_CONTAINER]
    terminating = bool(metadata.get("deletionTimestamp"))
    agent = next((c for c in pod["spec"]["containers"] if c["name"] == names.AGENT_CONTAINER), None)
    return Instance(
        name=metadata["name"],
        uid=metadata["uid"],
        ip=status.get("podIP", ""),
        shares_address=bool(pod["spec"].get("hostNetwork")),
        pool=claims.pool_of(pod),
        running=status.get("phase") == "Running",
        ready=conditions.get("Ready") == "True",
        held=claims.is_held(labels),
        terminating=terminating,
        node=pod["spec"].get("nodeName") or "",
        has_agent=agent is not None,
        agent_protocol=_protocol(agent) if agent is not None else PROTOCOL,
        agent_port=_port(agent) if agent is not None else names.AGENT_PORT,
        claim=(metadata.get("annotations") or {}).get(names.CLAIM, ""),
        template_hash=labels.get(names.TEMPLATE_HASH, ""),
        created=metadata.get("creationTimestamp", ""),
        restarts=sum(c.get("restartCount", 0) for c in containers),
        crashing=any(((c.get("state") or {}).get("waiting") or {}).get("reason") == CRASH_LOOP for c in containers),
        evicted=terminating and reasons.get("DisruptionTarget") == EVICTION,
        conditions=tuple(
            PodCondition(c["type"], c["status"], c.get("reason") or "") for c in status.get("conditions") or []
        ),
        owned=(controller_of(pod) or {}).get("kind") == "RobotWorkload",
    )


def _protocol(agent: Object) -> int:
    """Return the version of the protocol that an agent knows at least, by its container.

    The environment of a container cannot be changed after its pod was created, so nobody can claim that an agent is older than it is.
    """
    stated = next((e.get("value") for e in agent.get("env") or [] if e["name"] == names.AGENT_PROTOCOL_VARIABLE), None)
    if stated is None:
        return OLDEST_PROTOCOL
    return min(whole_number(stated or "") or PROTOCOL, PROTOCOL)


def _port(agent: Object) -> int:
    """Return the port of an agent's control channel. Only in the network of a node it is not the usual one."""
    listed = agent.get("ports") or []
    return next((p["containerPort"] for p in listed if p.get("name") == names.AGENT_PORT_NAME), names.AGENT_PORT)


def is_stray(pod: Object, settings: WorkloadSettings) -> bool:
    """Whether a pod is this workload's but does not have its label. A pod that a pool owns is unclaimed, and drives no robot."""
    if claims.workload_of(pod["metadata"].get("labels") or {}) == settings.workload:
        return False
    if (owner := controller_of(pod)) is None:
        return released(pod) == settings.workload
    kind, name = owner.get("kind"), owner.get("name", "")
    if settings.source_kind == "Deployment" and kind == "ReplicaSet":
        kind, name = "Deployment", name.rpartition("-")[0]
    return owner.get("uid") == settings.uid or (kind, name) == (settings.source_kind, settings.source_name)


def _ends(pod: Object) -> bool:
    """Whether a pod has ended or is being deleted."""
    ended = (pod.get("status") or {}).get("phase") in ("Succeeded", "Failed")
    return ended or bool(pod["metadata"].get("deletionTimestamp"))


class PodControl:
    """Implements :class:`understudy.failover.interfaces.Instances` over the watched pods."""

    def __init__(self, client: Client, view: ClusterView, crash_points: CrashPoints, notices: Notices) -> None:
        self._client, self._view, self._crash_points, self._notices = client, view, crash_points, notices
        self._instances: list[Instance] = []
        self._revision: tuple[int, ...] | None = None

    @property
    def _settings(self) -> WorkloadSettings:
        settings = self._view.settings
        assert settings is not None, "the cluster view has started, so there are settings"
        return settings

    @property
    def _template_hashes(self) -> dict[str, str]:
        """For each pool, the template hash that its pods must have to be claimed; empty if any pod may be claimed."""
        return {choice.name: choice.template_hash for choice in self._settings.pools}

    def of_workload(self) -> Sequence[Instance]:
        """Return every instance of this workload, including terminating ones."""
        if self._revision != self._view.pods_revision:
            self._revision = self._view.pods_revision
            self._instances = [instance_of(pod) for pod in self._view.all_pods()]
        return self._instances

    def find(self, uid: str) -> Instance | None:
        """Return the instance of this workload with a UID; None if there is none."""
        return next((i for i in self.of_workload() if i.uid == uid), None)

    def unclaimed(self, pool: str) -> Sequence[Instance]:
        """Return the pods of a shared pool that are ready, have its present template and belong to nobody, oldest first. Only
        pods that were requested before are known (:meth:`refresh_unclaimed`).
        """
        current = self._template_hashes
        if pool not in current:
            return []
        held = (instance_of(pod) for pod in self._view.unclaimed(pool).items.values())
        fitting = [
            i
            for i in held
            if i.pool == pool
            and i.held
            and i.ready
            and i.usable
            and (not current[pool] or not i.template_hash or i.template_hash == current[pool])
        ]
        return sorted(fitting, key=lambda i: (i.created, i.name))

    async def refresh_unclaimed(self, pool: str, *, part: bool = False) -> None:
        """List the unclaimed pods of a shared pool, or only the part of them that this workload prefers. Raises NotAvailable."""
        asked = claims.part(self._settings.uid) if part else ""
        asking = asyncio.create_task(self._ask_for_the_gate())
        try:
            await self._view.unclaimed(pool).refresh(asked, self._template_hashes.get(pool, ""))
        except ApiError as error:
            raise NotAvailable(f"the API server refuses to list the pods of FallbackPool {pool}: {error}") from error
        finally:
            asking.cancel()

    async def _ask_for_the_gate(self) -> None:
        """Ask the API server for the gate again and again, so that a list without an answer is not taken for an outage (ApiContact)."""
        await asyncio.sleep(LIST_WITHIN)
        while True:
            with contextlib.suppress(*FAILURES):
                async with asyncio.timeout(LIST_WITHIN):
                    await self._client.get(
                        self._view.gate_kind.resource, self._view.namespace, names.gate(self._view.workload)
                    )
            await asyncio.sleep(ASK_PERIOD)

    def followed(self, pool: str) -> AbstractAsyncContextManager[None]:
        """Watch the unclaimed pods of a shared pool while the context is open."""
        return self._view.unclaimed(pool).followed()

    def stocked(self, pool: str) -> bool:
        """Return whether a shared pool has a pod that this workload could claim, according to the operator's last report."""
        return pool in self._view.stocked

    async def claim(self, instance: Instance, claim: str) -> Instance:
        """Make an unclaimed pod an instance of this workload. Raises ClaimLost."""
        pod = self._view.unclaimed(instance.pool).items.get(instance.name)
        if pod is None or pod["metadata"]["uid"] != instance.uid:
            raise ClaimLost(instance.name)
        self._crash_points.step("before claim")
        started_at = time.monotonic()
        try:
            claimed = await claims.claim(
                self._client, pod, workload=self._view.workload, workload_uid=self._settings.uid, claim=claim
            )
        except ApiError as error:
            if error.status in (403, 404, 409, 422):
                _logger.info("claim of %s lost: %s", instance.name, error.message)
                self._notices.add(PodClaimed("Lost", time.monotonic() - started_at))
                raise ClaimLost(instance.name) from error
            raise
        self._notices.add(PodClaimed("Won", time.monotonic() - started_at))
        self._view.follow_claimed()
        self._view.put(claimed)
        self._crash_points.step("after claim")
        await self._connect(instance.name)
        return instance_of(claimed)

    async def _connect(self, claimed: str) -> None:
        """Name a claimed pod in the policy of claimed pods. If that fails, the operator does it."""
        chosen = sorted({*claims.claimed(self._view.all_pods()), claimed})
        body = {"spec": {"podSelector": pool_pod_policies.claimed_selector(self._view.workload, chosen)}}
        try:
            async with asyncio.timeout(TRY_WITHIN):
                await self._client.patch(
                    NETWORK_POLICIES, self._view.namespace, names.claimed(self._view.workload), body
                )
        except FAILURES as error:
            _logger.warning(
                "NetworkPolicy %s does not name %s yet: %r", names.claimed(self._view.workload), claimed, error
            )

    async def retire(self, instance: Instance) -> None:
        """Delete a failed pod. If no pool provides standbys, its ReplicaSet is scaled to zero, so that it does not create a new pod."""
        self._crash_points.step("before retire")
        settings = self._settings
        wanted = any(pool.level.has_standbys for pool in settings.pools)
        if instance.from_source and settings.source_kind == "ReplicaSet" and not wanted:
            await self._scale(0)
        else:
            await self._delete(instance)

    async def end(self, instance: Instance) -> None:
        """Delete a pod that still reaches the robot, with the shortest grace period, also if it is being deleted already."""
        self._crash_points.step("before retire")
        await self._delete(instance, SHORTEST_GRACE)

    async def replace(self, failed: Sequence[Instance]) -> None:
        """Delete failed pods and have the workload's own controller run a new one.

        Each request is repeated until the API server answers; the caller bounds the time. Raises ApiError if the API server refuses.
        """
        self._crash_points.step("before replace")
        left = [i for i in self.of_workload() if i.from_source and i.usable and i.uid not in {f.uid for f in failed}]
        if self._settings.source_kind == "ReplicaSet" and not left:
            await answered(partial(self._scale, 1))
        for instance in failed:
            if not instance.terminating:
                await answered(partial(self._delete, instance))
        self._crash_points.step("after replace")

    async def wait(self, predicate: Callable[[Instance], bool]) -> Instance:
        """Wait until instances of this workload satisfy the predicate, and return the newest of them."""
        while True:
            fitting = [i for i in self.of_workload() if predicate(i)]
            if fitting:
                return max(fitting, key=lambda i: (i.created, i.name))
            await any_changed(self._view.pod_watches)

    async def label(self, instance: Instance) -> None:
        """Give a pod of this workload the labels with which the gate selects it."""
        pod = next((p for p in self._view.all_pods() if p["metadata"]["uid"] == instance.uid), None)
        if pod is not None:
            await self._put_labels(pod)

    async def regain(self, name: str, uid: str) -> None:
        """Give a pod that is not listed its labels back, if it exists and runs, belongs to this workload, and lacks its label.

        Waits while the API server does not answer.
        """
        try:
            await answered(partial(self._restore_labels, name, uid))
        except ApiError as error:
            if not error.not_found:
                _logger.warning("could not restore the label %s of %s: %s", names.WORKLOAD, name, error)

    async def look_at(self, instance: Instance) -> None:
        """Read a pod, because its watch may be late or half-open. Nothing changes if the API server does not answer."""
        name, uid = instance.name, instance.uid
        try:
            async with asyncio.timeout(TRY_WITHIN):
                pod = await self._written(name, uid, self._client.get(PODS, self._view.namespace, name))
        except FAILURES as error:
            _logger.info("pod %s could not be read: %r", name, error)
            return
        if pod is not None and pod["metadata"]["uid"] == uid:
            self._view.put(pod)
        else:
            self._doubt(name, uid)

    async def _restore_labels(self, name: str, uid: str) -> None:
        pod = await self._client.get(PODS, self._view.namespace, name)
        if pod["metadata"]["uid"] != uid or _ends(pod) or not is_stray(pod, self._settings):
            return
        await self._put_labels(pod)
        words = f"pod {name} had lost the label {names.WORKLOAD}, which the gate needs: somebody had changed it"
        _logger.warning("restored the labels: %s", words)
        self._notices.event("Warning", "LabelsRestored", words)

    async def _put_labels(self, pod: Object) -> None:
        """Write these labels to a pod that lacks one, also if the pod is not watched because of that."""
        name, uid = pod["metadata"]["name"], pod["metadata"]["uid"]
        labels, wanted = pod["metadata"].get("labels") or {}, claims.instance_labels(pod, self._view.workload)
        if any(labels.get(key) != value for key, value in wanted.items()):
            body = {"metadata": {"uid": uid, "labels": wanted}}
            labelled = await self._written(name, uid, self._client.patch(PODS, self._view.namespace, name, body))
            if labelled is not None:
                self._view.put(labelled)

    async def _delete(self, instance: Instance, grace: int | None = None) -> None:
        if grace is None and self._settings.source_kind == "StatefulSet":
            grace = STATEFUL_SET_GRACE
        name, uid = instance.name, instance.uid
        deletion = self._client.delete(PODS, self._view.namespace, name, uid=uid, grace_seconds=grace)
        await self._written(name, uid, deletion)

    async def _written(self, name: str, uid: str, request: Awaitable[Object | None]) -> Object | None:
        """Return the answer to a write to a pod of this workload, None if there is no such pod. Raises what the request raises.

        The watches must report what the answer shows. Otherwise the pods are listed again.
        """
        try:
            pod = await request
        except ApiError as error:
            if error.status in GONE:
                self._doubt(name, uid)
            raise
        if pod is None:
            self._doubt(name, uid)
        else:
            for watch in self._view.pod_watches:
                watch.expect(pod)
        return pod

    def _doubt(self, name: str, uid: str) -> None:
        for watch in self._view.pod_watches:
            watch.doubt(name, uid)

    async def _scale(self, replicas: int) -> None:
        await self._client.patch(
            REPLICA_SETS,
            self._view.namespace,
            self._settings.source_name,
            {"spec": {"replicas": replicas}},
            subresource="scale",
        )

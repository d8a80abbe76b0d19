"""Decides whether an instance that was cut off and frozen by its agent (agent/permit.py) may act again, and which
addresses can show an instance that it is not cut off.

Once the instance is connected again, the network policies on its node may be outdated for a while. Its agent therefore
keeps it frozen until this monitor confirms that it is still active or a standby.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import time
from collections.abc import Collection, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import Any, Literal

from understudy.api import names
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.failover.interfaces import GateState, Instance, NotVerified
from understudy.failover.progress import Progress
from understudy.kube import claims
from understudy.kube.agent_client import AgentGone, AgentRefused
from understudy.kube.client import FAILURES, PODS, Object
from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.notices import Notices
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.wakeups import Wakeups
from understudy.ros.rmw import MIDDLEWARE
from understudy.ros.runtime.graph_node import Graph

_logger = logging.getLogger(__name__)

REFRESH = 10.0
"""Seconds between two checks of which addresses can answer an instance."""

PERIOD = 1.0
"""Seconds between two checks of the instances while none of them reports anything."""

REMEMBERED = 1000
"""Number of replaced pods that are remembered."""

SAY_AGAIN = 0.5
"""Seconds after which an order is sent again if the agent did not follow it."""

CATCH_UP = 1.0
"""Seconds that the node of a reconnected instance has to apply the present policies. An instance that is not active gets its order only
then: an outdated policy might let it through, and the robot might follow it.
"""

MOST_OTHERS = 3
"""Maximum number of pods besides the robots whose addresses an agent receives. Each is on another node than the
instance."""

Word = Literal["Go", "Stay"]


def word(instance: Instance, state: GateState, replaced: Collection[str], recovering: Progress | None) -> Word:
    """Return whether an instance that was cut off may act again (``Go``) or stays frozen (``Stay``).

    ``replaced`` has the UIDs of the pods that failed in earlier recoveries. During a recovery the active instance stays
    active until the gate names another. But if the robot already follows a standby, that instance must not take the
    robot back.
    """
    failed = {pod.uid for pod in recovering.failed} if recovering is not None else set()
    if instance.terminating:
        return "Stay"
    if instance.uid == state.active_uid:
        lost = recovering is not None and recovering.taken_over is not None and instance.uid in failed
        return "Stay" if lost else "Go"
    return "Stay" if instance.uid in failed or instance.uid in replaced else "Go"


def witnesses(
    instance: Instance, pods: Sequence[Object], *, workload: str, readers: Collection[bytes], robots: Sequence[str]
) -> list[str]:
    """Return addresses that prove to an instance that it is not cut off, if one of them answers.

    The robots come first, on any node, because an instance that reaches its robot may drive it: pods on whose hosts (the
    first four bytes of a GID) there are readers of the outputs, and single addresses outside the cluster (CIDRs). Then pods
    on other nodes. Pods of the same workload are left out because they do not answer each other; the agent knows the
    address of the monitor already.
    """
    found = [str(net.network_address) for net in map(ipaddress.ip_network, robots) if net.num_addresses == 1]
    node = next((_node(pod) for pod in pods if pod["metadata"]["uid"] == instance.uid), "")
    others: dict[str, str] = {}
    for pod in sorted(pods, key=lambda pod: (pod["metadata"].get("creationTimestamp") or "", pod["metadata"]["name"])):
        labels, ip = pod["metadata"].get("labels") or {}, pod.get("status", {}).get("podIP", "")
        if not ip or pod["status"].get("phase") != "Running" or pod["metadata"].get("deletionTimestamp"):
            continue
        if workload in (claims.workload_of(labels), labels.get(names.MONITORED)) or claims.is_held(labels):
            continue
        if _host(ip) in readers:
            found.append(ip)
        elif node and _node(pod) != node and not pod["spec"].get("hostNetwork"):
            others.setdefault(ip, _node(pod))
    return list(dict.fromkeys([*found, *_apart(others)]))


def _apart(others: dict[str, str]) -> list[str]:
    """Return up to MOST_OTHERS of these addresses, on as many different nodes as possible."""
    first = {node: ip for ip, node in reversed(others.items())}
    return [*first.values(), *(ip for ip in others if ip not in first.values())][:MOST_OTHERS]


def _node(pod: Object) -> str:
    found: str = pod["spec"].get("nodeName") or ""
    return found


def _host(ip: str) -> bytes:
    try:
        return MIDDLEWARE.host_at(ip)
    except ValueError:
        return b""


class Permits:
    """The permits of one workload's instances. Idle unless the workload has a reflex: only then do agents freeze
    instances."""

    def __init__(
        self,
        cluster: Cluster,
        agents: AgentConnections,
        graph: Graph,
        current: CurrentRecovery,
        wakeups: Wakeups,
        notices: Notices,
    ) -> None:
        """``graph`` is the robot's ROS graph: any reader of the outputs in it may answer an instance."""
        self._cluster, self._agents, self._graph = cluster, agents, graph
        self._current, self._wake, self._notices = current, wakeups.permits, notices
        self._pods: list[Object] = []
        self._readers: frozenset[bytes] = frozenset()
        self._witnesses: dict[str, list[str]] = {}
        self._refreshing: asyncio.Task[None] | None = None
        self._refresh_at = 0.0
        self._replaced: dict[str, None] = {}
        self._back: dict[str, float] = {}
        """When each instance that is frozen after a cut-off was first connected again, by UID."""
        self._sent: dict[str, tuple[Any, float]] = {}
        self._requests: dict[str, asyncio.Task[None]] = {}
        self._reported: set[tuple[str, float, Word]] = set()

    async def run(self) -> None:
        """Keep the permits until cancelled."""
        while True:
            self._wake.clear()
            spec = self._cluster.view.spec
            if spec is not None and spec.gate.readers_choose and self._cluster.gate.exists:
                self._refresh(spec)
                self._renew(spec)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(SAY_AGAIN if self._back else PERIOD):
                    await self._wake.wait()

    def _refresh(self, spec: RobotWorkloadSpec) -> None:
        """List the pods every REFRESH seconds, in the background: an unreachable API server must not delay an order."""
        if time.monotonic() < self._refresh_at or (self._refreshing is not None and not self._refreshing.done()):
            return

        async def refresh() -> None:
            try:
                self._pods = (await self._cluster.view.client.list(PODS, self._cluster.view.namespace))["items"]
            except FAILURES as error:
                _logger.debug("could not list the pods that can answer an instance that is cut off: %r", error)
                self._refresh_at = time.monotonic() + PERIOD
                return
            self._refresh_at = time.monotonic() + REFRESH
            topics = [output.topic for output in spec.outputs if output.topic]
            found = [endpoint for topic in topics for endpoint in self._graph.subscribers(topic)]
            self._readers = frozenset(MIDDLEWARE.host_of(endpoint.gid) for endpoint in found)
            self._witnesses.clear()

        self._refreshing = asyncio.create_task(refresh())

    def _renew(self, spec: RobotWorkloadSpec) -> None:
        state, recovering = self._cluster.gate.state, self._current.progress
        committed = state.recovery
        # A recovery that has not committed has not replaced a pod.
        under_way = recovering if committed and recovering and committed.id == recovering.id else None
        for progress in filter(None, (committed, under_way)):
            for pod in progress.replaced:
                # A pod that is cut off may be missing from lists and come back late, so only the oldest are forgotten.
                self._replaced.pop(pod.uid, None)
                self._replaced[pod.uid] = None
        while len(self._replaced) > REMEMBERED:
            del self._replaced[next(iter(self._replaced))]
        instances = {i.uid: i for i in self._cluster.pods.of_workload() if i.has_agent and not i.held}
        self._sent = {uid: sent for uid, sent in self._sent.items() if uid in instances}
        self._back = {uid: since for uid, since in self._back.items() if uid in instances}
        self._reported = {reported for reported in self._reported if reported[0] in instances}
        for uid, instance in instances.items():
            if (status := self._agents.status(instance)) is None:
                self._back.pop(uid, None)
                continue
            if uid in self._requests:
                continue
            body: dict[str, Any] = {"witnesses": self._witnesses_of(instance, spec)}
            if status.cut_off is None:
                self._back.pop(uid, None)
            elif (decision := self._word_for(instance, state, recovering)) is not None:
                body["word"] = decision
                self._report(instance, status.cut_off, decision)
            wanted = (self._agents.session(instance), body)
            sent, at = self._sent.get(uid, (None, 0.0))
            if sent != wanted or ("word" in body and time.monotonic() - at >= SAY_AGAIN):
                self._sent[uid] = (wanted, time.monotonic())
                # One task per agent: an agent that does not answer must not delay the others.
                self._requests[uid] = task = asyncio.create_task(self._request(instance, body))
                task.add_done_callback(partial(self._done, uid))

    def _word_for(self, instance: Instance, state: GateState, recovering: Progress | None) -> Word | None:
        """Return the order for a frozen instance that is connected again; None while its node may still apply old
        policies."""
        now = time.monotonic()
        caught_up = now - self._back.setdefault(instance.uid, now) >= CATCH_UP
        found = word(instance, state, self._replaced, recovering)
        return found if found == "Stay" or caught_up or instance.uid == state.active_uid else None

    def _done(self, uid: str, task: asyncio.Task[None]) -> None:
        self._requests.pop(uid, None)
        self._wake.set()

    def _witnesses_of(self, instance: Instance, spec: RobotWorkloadSpec) -> list[str]:
        if instance.uid not in self._witnesses:
            self._witnesses[instance.uid] = witnesses(
                instance,
                self._pods,
                workload=self._cluster.view.workload,
                readers=self._readers,
                robots=spec.gate.robots,
            )
        return self._witnesses[instance.uid]

    async def _request(self, instance: Instance, body: dict[str, Any]) -> None:
        try:
            await self._agents.renew_permit(instance, body)
        except (AgentGone, NotVerified) as error:
            _logger.info("%s: %s", instance.name, error)
            self._sent.pop(instance.uid, None)
        except AgentRefused as error:
            _logger.warning("%s", error)

    def _report(self, instance: Instance, since: float, word: Word) -> None:
        if (instance.uid, since, word) in self._reported:
            return
        self._reported.add((instance.uid, since, word))
        when = datetime.fromtimestamp(since, UTC).strftime("%H:%M:%S UTC")
        then = "it runs again" if word == "Go" else "it stays frozen, because another instance has replaced it"
        self._notices.event(
            "Normal" if word == "Go" else "Warning",
            "InstanceCutOff",
            f"the agent of {instance.name} froze the application at {when}, because nobody answered the agent; {then}",
        )

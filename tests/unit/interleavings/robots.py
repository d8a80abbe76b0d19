"""Nodes and robots: pods come up, break down and end, and what they send goes through the gate as the network has it by now."""

from __future__ import annotations

import asyncio
import functools
import math
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from tests.unit.interleavings import gates
from tests.unit.interleavings.apiserver import EPOCH, ApiServer, Place, stamp
from tests.unit.interleavings.network import Network
from tests.unit.interleavings.nodes import Nodes
from tests.unit.interleavings.pod_agents import Commanded, PodAgent, Publish
from tests.unit.interleavings.pods import PERIOD, REFERRED, Luck, Running
from tests.unit.interleavings.scheduling import Process, VirtualLoop
from understudy.agent.restoration.task_goals import TaskGoals
from understudy.api import names
from understudy.api.protocol.kept_state import KeptState
from understudy.kube import claims
from understudy.kube.apply import controller_of
from understudy.kube.client import Object

BY = "the cluster"
NODES = ("a", "b", "c")


@dataclass
class Robots:
    """All nodes, pods' processes and robots."""

    loop: VirtualLoop
    server: ApiServer
    network: Network
    choices: random.Random
    world: Process
    running: dict[str, Running] = field(default_factory=dict)
    """By UID."""
    luck: Luck = field(default_factory=Luck)
    let_through: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """By workload, the instances that the network lets through by now."""
    activated: bool = False
    """Whether an application sends only once a procedure has brought it to driving."""
    clocks_differ: bool = False
    """Whether the clock of a monitor was set, so that its records are of another clock than the world."""
    nodes: Nodes = field(default_factory=Nodes)
    changed: Callable[[str], None] = lambda robot: None
    """Called when what reaches a robot has changed."""
    noted: Callable[[str], None] = lambda text: None
    agents_of: dict[str, PodAgent] = field(default_factory=dict)
    """The agents that run, by UID of their pods."""
    commanded: Commanded = lambda found, op, epoch, by: None
    commanded_safely: Callable[[str], None] = lambda robot: None
    """Called with each safe command that a robot receives."""
    restored: Callable[[Running, KeptState], None] = lambda found, state: None
    """Called with the state that an agent is given to restore."""
    started: Callable[[str, Running], None] = lambda workload, found: None
    """Called when a workload's monitor starts the held processes of a pod."""
    goals: Callable[[Running, Publish], TaskGoals | None] = lambda found, publish: None
    """Makes the goals of a pod's agent, if there are tasks."""
    places: Callable[[], Sequence[str]] = lambda: NODES
    """The nodes that take new pods: all, as where a template tolerates everything."""
    _waiting: dict[str, list[asyncio.Future[None]]] = field(default_factory=dict)
    _addresses: int = 0

    def adopt(self, running: Mapping[str, Running], let_through: Mapping[str, tuple[str, ...]]) -> None:
        """Go on with the pods of an earlier run."""
        self.running = {uid: replace(found, memory=replace(found.memory)) for uid, found in running.items()}
        self.let_through = dict(let_through)
        self._addresses = 10 * len(running)
        for uid in self.running:
            self.run_agent(uid)

    @property
    def now(self) -> float:
        return EPOCH + self.loop.time()

    def later(self, seconds: float, work: Callable[..., None], *args: object) -> None:
        self.loop.call_later(seconds, work, *args, context=self.world.context)

    def between(self, least: float, most: float) -> float:
        return least + (most - least) * self.choices.random()

    # -- what the API server tells ----------------------------------------------------------------------------------

    def see(self, plural: str, old: Object | None, new: Object | None) -> None:
        """A write was made."""
        if plural == "pods":
            self._pod(old, new)
        elif plural == "networkpolicies":
            item = new or old
            assert item is not None
            if gates.is_gate(plural, item):
                name = item["metadata"]["name"]
                self.later(self.between(0.001, 0.02), self._enforce, name.removesuffix("-gate"))
        elif plural == "replicasets" and new is not None:
            self.later(self.between(0.005, 0.1), self._replicate, _place(new))
        elif plural == "statefulsets" and new is not None:
            self.later(self.between(0.005, 0.1), self._number, _place(new))

    def _pod(self, old: Object | None, new: Object | None) -> None:
        item = new or old
        assert item is not None
        uid = item["metadata"]["uid"]
        if old is None:
            self.later(self.between(0.02, 0.1), self._run, uid, _place(item))
        elif new is None:
            if (found := self.running.get(uid)) is not None:
                found.exists = False
                self.route(found.robot)
                # One that was ended already has nothing left; one that was deleted by force lives on for a moment.
                self.later(self.between(0.02, 0.4), self._end, uid)
        elif "deletionTimestamp" in new["metadata"] and "deletionTimestamp" not in old["metadata"]:
            found = self.running.get(uid)
            begins = found is not None and not self.nodes.is_forgotten(found.node)
            self.later(self.between(0.02, 1.0), functools.partial(self._end, uid, begun=begins))
        elif uid in self.running and _labels(old) != _labels(new):
            self.later(self.between(0.001, 0.02), self.route, self.running[uid].robot)
        owner = controller_of(item)
        if owner is not None and owner["kind"] in ("ReplicaSet", "StatefulSet"):
            place = (item["metadata"]["namespace"], owner["name"])
            work = self._replicate if owner["kind"] == "ReplicaSet" else self._number
            self.later(self.between(0.005, 0.1), work, place)

    # -- what Kubernetes does ---------------------------------------------------------------------------------------

    def _replicate(self, place: Place) -> None:
        """What the ReplicaSets' own controller does; it is taken to see everything at once."""
        replicas = self.server.get("replicasets", place)
        if replicas is None:
            return
        uid = replicas["metadata"]["uid"]
        mine = [
            pod
            for pod in self.server.items["pods"].values()
            if (owner := controller_of(pod)) is not None
            and owner["uid"] == uid
            and "deletionTimestamp" not in pod["metadata"]
            and (pod.get("status") or {}).get("phase") not in ("Failed", "Succeeded")
        ]
        wanted = replicas["spec"]["replicas"]
        for _ in range(wanted - len(mine)):
            self._addresses += 1
            self._make(replicas, f"{place[1]}-r{self._addresses:03}")
        for pod in sorted(mine, key=lambda pod: pod["metadata"]["name"])[: max(0, len(mine) - wanted)]:
            self.delete(pod)

    def _number(self, place: Place) -> None:
        """What the StatefulSets' own controller does: a pod's successor has its name, and waits for it to be gone."""
        numbered = self.server.get("statefulsets", place)
        if numbered is None:
            return
        name = f"{place[1]}-0"
        pod = self.server.get("pods", (place[0], name))
        if pod is None:
            self._make(numbered, name)
        elif (pod.get("status") or {}).get("phase") in ("Failed", "Succeeded"):
            self.delete(pod)

    def _make(self, owner: Object, name: str) -> None:
        template, metadata = owner["spec"]["template"], owner["metadata"]
        reference = {"apiVersion": "apps/v1", "kind": owner["kind"], "name": metadata["name"], "uid": metadata["uid"]}
        references = [{**reference, "controller": True}]
        body = {"metadata": {**template["metadata"], "name": name, "ownerReferences": references}}
        path = f"/api/v1/namespaces/{metadata['namespace']}/pods"
        self.server.request("POST", path, None, {**body, "spec": template["spec"]}, "", BY)

    def delete(self, pod: Object, *, by: str = BY, force: bool = False) -> None:
        """Delete a pod, as anybody may."""
        metadata = pod["metadata"]
        if self.server.get("pods", _place(pod)) is None:
            return
        options: Object = {"preconditions": {"uid": metadata["uid"]}}
        if force:
            options["gracePeriodSeconds"] = 0
        path = f"/api/v1/namespaces/{metadata['namespace']}/pods/{metadata['name']}"
        self.server.request("DELETE", path, None, options, "", by)

    def status(self, uid: str, phase: str, ready: bool, reason: str = "") -> None:
        """The kubelet says how a pod is."""
        found = self.running.get(uid)
        if found is None or not found.exists or self._kubelet_waits(uid, self.status, uid, phase, ready, reason):
            return

        def change(pod: Object) -> Object:
            has_ended = (pod.get("status") or {}).get("phase") in (
                "Failed",
                "Succeeded",
            )  # for good: a later report is an older one
            if pod["metadata"]["uid"] != uid or has_ended:
                return pod
            waiting = {"waiting": {"reason": reason}} if reason else {"running": {}}
            conditions = [{"type": "Ready", "status": "True" if ready else "False"}]
            container = {"name": "app", "restartCount": found.restarts, "state": waiting}
            status = {
                "phase": phase,
                "podIP": found.ip,
                "conditions": conditions + [c for c in _conditions(pod) if c["type"] != "Ready"],
                "containerStatuses": [container],
            }
            return {**pod, "spec": {**pod["spec"], "nodeName": found.node}, "status": status}

        self.server.update("pods", found.place, change, BY)

    def _run(self, uid: str, place: Place) -> None:
        """A node takes a new pod."""
        pod = self.server.get("pods", place)
        if pod is None or pod["metadata"]["uid"] != uid or "deletionTimestamp" in pod["metadata"]:
            return
        labels = _labels(pod)
        places = self._accepting(pod)
        if not places:
            self.later(1.0, self._run, uid, place)
            return
        self._addresses += 1
        node = self.choices.choice(places)
        found = Running(
            uid=uid,
            name=place[1],
            place=place,
            node=node,
            robot=claims.workload_of(labels) or labels.get(REFERRED, ""),
            held=claims.is_held(labels),
            ip=f"10.0.{self._addresses // 250}.{self._addresses % 250 + 1}",
            broken=(broken := self.choices.random() < self.luck.broken),
            harmed=broken or self.nodes.is_late(node),
            owner=claims.workload_of(labels),
            secret=_secret(pod),
            phase=self.choices.random(),
        )
        self.running[uid] = found
        slow = self.choices.random() < self.luck.slow
        self.later(self.between(0.1, 0.6) if not slow else self.between(1, 5), self._up, uid)

    def _accepting(self, pod: Object) -> list[str]:
        """The nodes on which the scheduler may place a pod: those without the instances that it must be apart from."""
        apart = (pod["spec"].get("affinity") or {}).get("podAntiAffinity") or {}
        terms = apart.get("requiredDuringSchedulingIgnoredDuringExecution") or []
        others = {term["labelSelector"]["matchLabels"][names.INSTANCE] for term in terms}
        taken = {found.node for found in self.running.values() if found.exists and found.name in others}
        return [node for node in self.places() if node not in taken and not self.nodes.is_forgotten(node)]

    def _kubelet_waits(self, uid: str, work: Callable[..., None], *args: object) -> bool:
        """Whether a pod's kubelet does something only once the API server has its node again."""
        found = self.running.get(uid)
        return found is not None and self.nodes.put_off(found.node, functools.partial(work, *args))

    def _up(self, uid: str) -> None:
        found = self.running.get(uid)
        # A kubelet that has lost the API server cannot mount a pod's Secret, so it starts no new pod.
        if found is None or found.ended or self._kubelet_waits(uid, self._up, uid):
            return
        found.up, found.up_at = True, self.now
        self.run_agent(uid)
        self.status(uid, "Running", ready=found.held)
        if not found.held:
            self.later(self.between(0.1, 0.8), self._send, uid)

    def start(self, uid: str, workload: str) -> None:
        """An agent starts the held processes of a claimed pod."""
        found = self.running.get(uid)
        if found is None or found.ended or not found.held:
            return
        found.held, found.robot, found.up_at = False, workload, self.now
        self.look(uid)
        self.later(self.between(0.1, 0.8), self._send, uid)

    def bring(self, uid: str, brought: str) -> None:
        """A procedure has brought a pod's processes to where they belong."""
        found = self.running.get(uid)
        if found is None or found.ended or not found.up:
            return
        found.brought = brought
        if self.activated and brought.startswith("up:"):
            self.later(self.between(0.01, 0.2), self._send, uid)
        elif found.stands_by:
            self.status(uid, "Running", ready=True)
        self.look(uid)

    def disturb(self, uid: str) -> None:
        """A procedure begins: what its application does until then, it stops."""
        found = self.running.get(uid)
        if found is None or found.ended:
            return
        found.disturbed, found.brought = found.sends, ""
        self._silence(found)

    def calm(self, uid: str) -> None:
        """A procedure has ended: its application goes on."""
        found = self.running.get(uid)
        if found is not None and found.disturbed:
            found.disturbed = False
            self.later(self.between(0.01, 0.2), self._send, uid)

    def _silence(self, found: Running) -> None:
        """It sends nothing more."""
        found.harmed = True
        if found.sends:
            found.sends, found.silent_since = False, self.now
        self.route(found.robot)
        self.look(found.uid)

    # -- agents -----------------------------------------------------------------------------------------------------

    def run_agent(self, uid: str) -> None:
        """A pod's agent starts, and knows what an earlier one left."""
        found = self.running[uid]
        if not found.secret or found.ended or not found.up or uid in self.agents_of:
            return
        process = self.loop.process(f"agent of {found.name}")
        self.agents_of[uid] = agent = PodAgent(self, found, process)
        self.loop.start(process, agent.run())

    def end_agent(self, uid: str, *, silently: bool = False) -> None:
        """A pod's agent ends. Nobody learns of it if its node is gone with it."""
        if (agent := self.agents_of.pop(uid, None)) is not None:
            agent.process.kill()
            self.running[uid].harmed = True
            if not silently:
                self.network.tcp.ended(agent.process)

    def look(self, uid: str) -> None:
        """A pod's agent sees that something has changed."""
        if (agent := self.agents_of.get(uid)) is not None:
            self.loop.call_soon(agent.look, context=agent.process.context)

    def look_later(self, uid: str, seconds: float) -> None:
        """A pod's agent looks again."""
        self.later(seconds, self.look, uid)

    def _send(self, uid: str) -> None:
        found = self.running.get(uid)
        if found is None or found.ended or found.broken or found.sends or not found.up:
            return
        if self.activated and not found.brought.startswith("up:"):
            return
        found.sends, found.sends_since = True, self.now
        self.status(uid, "Running", ready=True)
        self.route(found.robot)
        self.look(uid)

    def _end(self, uid: str, *, begun: bool = False) -> None:
        """A pod's processes end; what is left of its object goes a moment later. ``begun``: its kubelet has begun to end them."""
        found = self.running.get(uid)
        if found is None or (not begun and self._kubelet_waits(uid, self._end, uid)):
            return
        found.ended, found.up, found.sends = True, False, False
        self.end_agent(uid)
        self.route(found.robot)
        self.later(self.between(0.01, 0.1), self._vanish, uid)

    def _vanish(self, uid: str) -> None:
        """The kubelet removes what is left of a pod's object."""
        if not self._kubelet_waits(uid, self._forget, uid):
            self._forget(uid)

    def _forget(self, uid: str) -> None:
        found = self.running[uid]
        pod = self.server.get("pods", found.place)
        if pod is not None and pod["metadata"]["uid"] == uid:
            self.server.write("pods", found.place, None, BY)

    # -- what goes wrong --------------------------------------------------------------------------------------------

    def freeze(self, uid: str) -> None:
        """Its application stops and to Kubernetes still runs."""
        found = self.running.get(uid)
        if found is not None:
            found.broken = found.frozen = True
            self._silence(found)

    def pause(self, uid: str) -> None:
        """Its application sends nothing for a while, and goes on as if nothing had been."""
        found = self.running.get(uid)
        if found is not None and found.sends:
            self._silence(found)
            self.later(self.between(0.6, 6.0), self._go_on, uid)

    def slow_down(self, uid: str) -> None:
        """Its application sends less often from now on: it has failed, and goes on sending."""
        found = self.running.get(uid)
        if found is not None and not found.ended:
            found.heard_last = found.last_arrival(self.now) or -1.0
            found.well_since, found.harmed = math.inf, True
            found.period, found.through_since = self.choices.choice([0.3, 0.7, 1.6]), self.now
            self.route(found.robot)

    def _go_on(self, uid: str) -> None:
        found = self.running.get(uid)
        if found is not None and not (found.broken or found.ended or found.sends) and found.up:
            self.noted(f"pod {found.name}: goes on")
            found.sends, found.sends_since = True, self.now
            found.well_since = self.now if found.period == PERIOD else math.inf
            self.route(found.robot)
            self.look(uid)

    def crash(self, uid: str) -> None:
        """A container of it ends and is started again, or ends again and again."""
        found = self.running.get(uid)
        if found is None or found.ended:
            return
        found.restarts, found.brought, found.well_since = found.restarts + 1, "", math.inf
        found.broken = self.choices.random() < 0.4
        self._silence(found)
        self.status(uid, "Running", ready=False, reason="CrashLoopBackOff" if found.broken else "")
        if not found.held:
            self.later(self.between(0.5, 3.0), self._send, uid)

    def fail(self, uid: str) -> None:
        """Its node ends it for good: phase Failed."""
        found = self.running.get(uid)
        if found is None or found.ended:
            return
        found.ended, found.up, found.sends = True, False, False
        self.end_agent(uid)
        self.route(found.robot)
        self.status(uid, "Failed", ready=False)

    def heartbeat(self, uid: str) -> None:
        """The kubelet writes something that doesn't matter: versions grow."""
        found = self.running.get(uid)
        if found is None or self._kubelet_waits(uid, self.heartbeat, uid):
            return
        beat = {"type": "ContainersReady", "status": "True", "lastProbeTime": f"{self.loop.time():.3f}"}

        def change(pod: Object) -> Object:
            others = [c for c in _conditions(pod) if c["type"] != "ContainersReady"]
            return {**pod, "status": {**(pod.get("status") or {}), "conditions": [*others, beat]}}

        self.server.update("pods", found.place, change, BY)

    def lose(self, node: str) -> None:
        """A node is gone: its processes end at once, Kubernetes notices late and evicts."""
        for found in [f for f in self.running.values() if f.node == node and not f.ended]:
            found.up = found.sends = False
            found.ended = True
            self.network.unreachable.add(found.ip)
            self.end_agent(found.uid, silently=True)
            self.route(found.robot)
            self.later(3.0, self.status, found.uid, "Running", False)
            self.later(6.0, self._evict, found.uid)

    def harm(self, node: str) -> None:
        """What runs on a node may count as failed from now on."""
        for found in self.running.values():
            found.harmed |= found.node == node

    def forget(self, node: str, *, deletes: bool) -> None:
        """The API server loses a node whose pods live on. Kubernetes evicts them; ``deletes``: somebody deletes their objects."""
        self.nodes.forget(node)
        self.harm(node)
        for found in [f for f in self.running.values() if f.node == node and not f.ended]:
            self.later(6.0, self._evict_lost, found.uid, deletes)

    def _evict_lost(self, uid: str, deletes: bool) -> None:
        found = self.running[uid]
        if not self.nodes.is_forgotten(found.node) or not found.exists:
            return
        self._evict(uid, deletes=deletes)

    def recall(self, node: str) -> None:
        """The API server has a node again."""
        for work in self.nodes.recall(node):
            self.later(self.between(0.02, 0.4), work)
        self.reroute()

    def heal(self, node: str) -> None:
        """A node's network enforces all gates as they are now."""
        self.nodes.heal(node)
        self.reroute()

    def reroute(self) -> None:
        """What reaches any robot may be something else now."""
        for robot in sorted({found.robot for found in self.running.values() if found.robot}):
            self.route(robot)

    def _evict(self, uid: str, *, deletes: bool = True) -> None:
        found = self.running[uid]

        def change(pod: Object) -> Object:
            if pod["metadata"]["uid"] != uid or "deletionTimestamp" in pod["metadata"]:
                return pod
            condition = {"type": "DisruptionTarget", "status": "True", "reason": "DeletionByTaintManager"}
            status = {**(pod.get("status") or {}), "conditions": [*_conditions(pod), condition]}
            metadata = {**pod["metadata"], "deletionTimestamp": stamp(self.now)}
            return {**pod, "metadata": metadata, "status": status}

        self.server.update("pods", found.place, change, BY)
        if deletes:
            self.later(4.0, self._forget, uid)

    def drain(self, node: str) -> None:
        """A node's pods are evicted, in order."""
        for found in [f for f in self.running.values() if f.node == node and f.exists]:
            pod = self.server.get("pods", found.place)
            if pod is not None and pod["metadata"]["uid"] == found.uid:
                self.delete(pod)

    # -- what reaches the robots ------------------------------------------------------------------------------------

    def _enforce(self, workload: str) -> None:
        """The network acts by a gate as it is now."""
        policy = gates.find(self.server, workload)
        before = self.let_through.get(workload, ())
        self.let_through[workload] = gates.let_through(policy) if policy is not None else ()
        for node, lag in self.nodes.changes(workload, before).items():
            self.later(lag, self._catch_up_late, node, workload)
        self.route(workload)

    def _catch_up_late(self, node: str, workload: str) -> None:
        self.nodes.catch_up(node, workload)
        self.route(workload)

    def route(self, robot: str) -> None:
        """What reaches a robot may be something else now."""
        if robot:
            self._let_flow(robot)
            self._tell(robot)

    def _let_flow(self, robot: str) -> None:
        """What reaches a robot, as pods and gates are by now."""
        allowed = self.let_through.get(robot, ())
        for found in self.running.values():
            if found.robot != robot:
                continue
            routed = found.up and self._selected(found, robot, allowed)
            found.routed_at = (found.routed_at or self.now) if routed else None
            through = found.sends and routed
            if through and not found.through:
                found.through_since = self.now
                self.later(found.next_sample(self.now) - self.now, self._tell, robot)
            elif found.through and not through:
                found.heard_last = found.last_arrival(self.now) or -1.0
            found.through = through

    def _tell(self, robot: str) -> None:
        """What reaches a robot may have changed."""
        self.changed(robot)
        for future in self._waiting.pop(robot, []):
            if not future.done():
                future.set_result(None)

    def _selected(self, found: Running, robot: str, allowed: tuple[str, ...]) -> bool:
        if not found.exists:
            return found.sends  # no policy holds back what isn't there
        pod = self.server.get("pods", found.place)
        labels = _labels(pod) if pod is not None else {}
        if not {names.WORKLOAD, names.HELD, REFERRED} & labels.keys():
            return True  # no policy selects it
        allowed = self.nodes.let_through(found.node, robot, allowed)
        return labels.get(names.WORKLOAD) in (robot, names.UNCLAIMED) and labels.get(names.INSTANCE) in allowed

    async def wait(self, robot: str) -> None:
        """Wait until what reaches a robot may have changed."""
        future: asyncio.Future[None] = self.loop.create_future()
        self._waiting.setdefault(robot, []).append(future)
        await future


def _place(item: Object) -> Place:
    return item["metadata"]["namespace"], item["metadata"]["name"]


def _labels(item: Object) -> dict[str, str]:
    return item["metadata"].get("labels") or {}


def _secret(pod: Object) -> str:
    """The Secret with the token of a pod's agent; empty if it has none."""
    found = [volume["secret"]["secretName"] for volume in pod["spec"].get("volumes") or [] if "secret" in volume]
    return found[0] if found else ""


def _conditions(pod: Object) -> list[Object]:
    found: list[Object] = (pod.get("status") or {}).get("conditions") or []
    return found

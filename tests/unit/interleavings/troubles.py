"""What goes wrong in a run, and when."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from tests.unit.interleavings import apiserver, gates
from tests.unit.interleavings.actors import NAMESPACE, Monitor
from tests.unit.interleavings.apiserver import EPOCH
from tests.unit.interleavings.network import Weather
from tests.unit.interleavings.pods import Luck
from tests.unit.interleavings.robots import NODES
from tests.unit.interleavings.scheduling import Process
from tests.unit.interleavings.simulated_cluster import SimulatedCluster
from understudy.api import names
from understudy.api.kinds.switchover_spec import request
from understudy.controller.observed import kube_objects
from understudy.kube import apply
from understudy.kube.client import Object

TROUBLE = (4.0, 14.0)
"""Seconds, at least and at most, for which things go wrong."""
LONG, LONGER = 0.5, 90.0
"""How often a monitor that was replaced lives on for minutes, and for how many seconds more at most."""
FORCED = 0.3
"""How often the pod of a monitor that was replaced is deleted by force."""
NOTICES = 0.1
"""Seconds in which an operator that gets a processor again notices that another one leads."""
TROUBLES = {
    "one_fails": 6,
    "all_fail": 3,
    "understudy_fails": 3,
    "monitor_dies": 4,
    "monitor_dies_at_a_step": 5,
    "second_monitor": 2,
    "operator_dies": 3,
    "operator_is_ended": 1,
    "somebody_stalls": 3,
    "somebody_is_cut_off": 2,
    "monitor_is_replaced": 2,
    "monitor_reaches_no_pod": 2,
    "agent_restarts": 2,
    "monitor_is_denied": 2,
    "watch_falls_silent": 2,
    "decision_is_late": 1,
    "api_server_is_away": 3,
    "monitor_watch_is_half_open": 2,
    "clock_is_set": 1,
    "kubelets_write": 4,
    "pool_is_resized": 3,
    "template_changes": 2,
    "something_is_deleted": 1,
    "labels_are_edited": 2,
    "somebody_pauses": 1,
    "somebody_fences": 2,
    "node": 1,
    "node_enforces_late": 2,
    "node_is_deaf": 2,
    "node_is_forgotten": 2,
}
"""What goes wrong, and how often in comparison."""


FAILURES = ("freezes", "crashes", "fails", "deleted", "deleted by force", "stops for a while", "slows down")
"""How an instance fails. One that stops for a while goes on later, and one that slows down goes on sending."""


WATCHED = ("pods", "gates", "robotworkloads")
"""What a monitor learns from watches that may be half-open."""

OURS = (names.WORKLOAD, names.INSTANCE, names.POOL, names.COMPONENT, names.CLAIMED_BY, names.HELD)
"""Labels of instances."""

STEPS = (-60.0, -5.0, -0.7, 0.7, 5.0, 60.0)
"""How many seconds a clock is set forward, or back."""


class Troubles(SimulatedCluster):
    """A cluster in which something goes wrong for a while."""

    causes: Mapping[str, int] = TROUBLES
    """What may go wrong, and how often in comparison."""
    _lasts = 0.0
    """When it ends."""

    @property
    def gate_plural(self) -> str:
        """The plural of the gate objects."""
        return "leases" if self.scene.muxed else "networkpolicies"

    def _plan_trouble(self) -> float:
        """Have things go wrong for a while; until when."""
        choices = self.choices
        bad = choices.choice(self.scene.weather)
        # Not before the operator has listed everything, which it does again and again where any of it fails.
        self.later(0.5, setattr, self.network, "weather", Weather.of(bad))
        failing = choices.choice([0.0, 0.2, 0.5])
        self.robots.luck = Luck(broken=choices.choice([0.0, 0.0, 0.1, 0.3]), failing=failing)
        self.note(f"weather {bad}, {self.robots.luck}")
        lasts = TROUBLE[0] + (TROUBLE[1] - TROUBLE[0]) * choices.random()
        causes = self.causes
        troubles = {name: weight for name, weight in causes.items() if name in (self.scene.troubles or causes)}
        chosen = choices.choices(list(troubles), list(troubles.values()), k=choices.randint(2, 9))
        if not {"monitor_is_replaced", "node_is_forgotten"}.isdisjoint(chosen) and choices.random() < LONG:
            lasts += LONGER * choices.random()
        self._lasts = self.loop.time() + lasts
        for name in chosen:
            self.later(1 + choices.random() * lasts, getattr(self, f"_{name}"))
        return lasts

    def _active(self, workload: str) -> str:
        gate = gates.record(self.server, workload)
        return gate.active_uid if gate is not None else ""

    def _break(self, uid: str, how: str) -> None:
        found = self.robots.running.get(uid)
        if found is None or not found.exists:
            return
        self.note(f"pod {found.name}: {how}")
        pod = self.server.get("pods", found.place)
        if how in ("deleted", "deleted by force"):
            if pod is not None and pod["metadata"]["uid"] == uid:
                self.robots.delete(pod, by="somebody", force=how != "deleted")
        else:
            {
                "freezes": self.robots.freeze,
                "crashes": self.robots.crash,
                "fails": self.robots.fail,
                "stops for a while": self.robots.pause,
                "slows down": self.robots.slow_down,
            }[how](uid)
            if found.broken and uid in {self._active(workload) for workload in self.workloads}:
                self.invariants.failed[uid] = self.robots.now

    def _one_fails(self) -> None:
        self._break(self._active(self.choices.choice(self.workloads)), self.choices.choice(FAILURES))

    def _all_fail(self) -> None:
        how = self.choices.choice(["freezes", "deleted"])
        for workload in self.workloads:
            self._break(self._active(workload), how)

    def _understudy_fails(self) -> None:
        in_control = {self._active(workload) for workload in self.workloads}
        others = [uid for uid, found in self.robots.running.items() if uid not in in_control and found.exists]
        if others:
            how = self.choices.choice(["freezes", "fails", "deleted", "deleted by force"])
            self._break(self.choices.choice(sorted(others)), how)

    def _monitor_dies(self) -> None:
        if self.monitors:
            self.kill(self.choices.choice(self.monitors).process)

    def _monitor_dies_at_a_step(self) -> None:
        if self.monitors:
            monitor = self.choices.choice(self.monitors)
            monitor.fuse.left = self.choices.randint(0, 12)
            self._break(self._active(monitor.workload), self.choices.choice(["freezes", "deleted"]))

    def _second_monitor(self) -> None:
        """As when a node is lost with a monitor that lives on: its Deployment makes another one."""
        workload = self.choices.choice(self.workloads)
        old = next((m for m in self.monitors if m.workload == workload), None)
        self.start_monitor(workload, f"other-{next(self._ids)}")
        if old is not None:
            self.later(self.choices.random() * 8, self.kill, old.process)
            self._may_be_forced(old)

    def _monitor_is_replaced(self) -> None:
        """It loses the API server for long, and not its pods. Its Deployment makes another one, and the active pod fails."""
        if not self.monitors:
            return
        old, seconds = self.choices.choice(self.monitors), 10 + self.choices.random() * (self._lasts - self.loop.time())
        self.note(f"{old.process} is cut off from the API server for {seconds:.1f} s, and another one replaces it")
        self.network.cut_off.add(old.process)
        self.later(seconds, self.network.cut_off.discard, old.process)
        self.later(self.choices.random() * 4, self._replace_monitor, old.workload)
        self._may_be_forced(old)
        fails = self.choices.choice(["freezes", "crashes", "deleted"])
        self.later(self.choices.random() * 8, lambda: self._break(self._active(old.workload), fails))

    def _may_be_forced(self, monitor: Monitor) -> None:
        """Somebody may delete the pod of a monitor by force, while its process lives on."""
        if self.choices.random() < FORCED:
            self.later(self.choices.random() * 10, self.delete_monitor, monitor.pod.name)

    def _replace_monitor(self, workload: str) -> None:
        if not self._calm:
            self.start_monitor(workload, f"other-{next(self._ids)}")

    def _monitor_reaches_no_pod(self) -> None:
        if not self.monitors:
            return
        process, seconds = self.choices.choice(self.monitors).process, self.choices.choice([4, 12, 60])
        self.note(f"{process} reaches no pod for {seconds} s")
        self.network.set_apart([process], True)
        for node in NODES:
            self.robots.harm(node)
        self.later(seconds, self.network.set_apart, [process], False)

    def _agent_restarts(self) -> None:
        """As when it runs out of memory: its pod and the application go on."""
        if self.robots.agents_of:
            uid = self.choices.choice(sorted(self.robots.agents_of))
            self.note(f"the agent of {self.robots.running[uid].name} is restarted")
            self.robots.end_agent(uid)
            self.later(0.2 + 2 * self.choices.random(), self.robots.run_agent, uid)

    def _operator_dies(self) -> None:
        if self.operators:
            self.kill(self.choices.choice(self.operators).process)

    def _operator_is_ended(self) -> None:
        """End the leading operator as an upgrade does: it gives up its leadership, and the other one acts immediately."""
        if self.operators:
            operator = self.choices.choice(self.operators)
            self.note(f"{operator.process} is to end")
            self.loop.call_soon(operator.end, context=operator.process.context)

    def _anybody(self) -> Process | None:
        found = [actor.process for actor in (*self.monitors, *self.operators)]
        return self.choices.choice(found) if found else None

    def _somebody_stalls(self) -> None:
        if (process := self._anybody()) is None:
            return
        # An operator for so long that the other one takes over, and that one has yet to notice.
        longest = 8 if any(o.process is process for o in self.operators) else self.choices.choice([3, 3, 20])
        seconds = self.choices.random() * longest
        self.note(f"{process} gets no processor for {seconds:.1f} s")
        self._stalled.add(process)
        self.later(seconds + NOTICES, self._stalled.discard, process)
        self.loop.stall(process, seconds, self.world)

    def _somebody_is_cut_off(self) -> None:
        if (process := self._anybody()) is None:
            return
        seconds = self.choices.random() * 12
        self.note(f"{process} is cut off for {seconds:.1f} s")
        self.network.cut_off.add(process)
        self.later(seconds, self.network.cut_off.discard, process)

    def _monitor_is_denied(self) -> None:
        """The API server denies what it is asked for, which nobody asks for again by themselves: what is under way stops there."""
        if not self.monitors:
            return
        process, seconds = self.choices.choice(self.monitors).process, 1 + self.choices.random() * 8
        self.note(f"{process} is denied every second write for {seconds:.1f} s")
        self.network.denied.add(process)
        self.later(seconds, self.network.denied.discard, process)

    def _watch_falls_silent(self) -> None:
        if self.operators:
            operator = self.choices.choice(self.operators)
            plural = self.choices.choice(["pods", self.gate_plural, "robotworkloads", "fallbackpools"])
            self.note(f"{operator.process}: the watch of {plural} falls silent")
            operator.silent.add(plural)

    def _api_server_is_away(self) -> None:
        """Nobody reaches it for a while, and mostly an instance fails meanwhile."""
        everybody, seconds = (
            [actor.process for actor in (*self.monitors, *self.operators)],
            self.choices.choice([4, 8, 60]),
        )
        self.note(f"nobody reaches the API server for {seconds} s")
        self.network.cut_off.update(everybody)
        self.later(seconds, self.network.cut_off.difference_update, everybody)
        if self.choices.random() < 0.7:
            workload, how = self.choices.choice(self.workloads), self.choices.choice(FAILURES)
            self.later(self.choices.random() * seconds, lambda: self._break(self._active(workload), how))

    def _decision_is_late(self) -> None:
        """An instance stops for a while, and is well again before its monitor reaches the API server."""
        if not self.monitors:
            return
        monitor, seconds = self.choices.choice(self.monitors), 6 + self.choices.random() * 12
        self.note(f"{monitor.process} is cut off from the API server for {seconds:.1f} s")
        self.network.cut_off.add(monitor.process)
        self.later(seconds, self.network.cut_off.discard, monitor.process)
        self.later(0.1, lambda: self._break(self._active(monitor.workload), "stops for a while"))

    def _monitor_watch_is_half_open(self) -> None:
        if self.monitors:
            process, plural = self.choices.choice(self.monitors).process, self.choices.choice(WATCHED)
            plural = self.gate_plural if plural == "gates" else plural
            self.note(f"{process}: the watch of {plural} is half-open")
            self.network.fall_silent(process, plural)

    def _clock_is_set(self) -> None:
        """The clock of a monitor's node is set forward or back."""
        if self.monitors:
            process, step = self.choices.choice(self.monitors).process, self.choices.choice(STEPS)
            self.note(f"the clock of {process} is set by {step} s")
            self.robots.clocks_differ = True
            process.clock_steps.append((self.robots.now, process.clock_steps[-1][1] + step))

    def _somebody_asks(self) -> None:
        """For a switchover."""
        workload = self.choices.choice(self.workloads)
        asked = request(self.choices.choice(["failover", "failover", "failback"]), EPOCH + self.loop.time())
        self.note(f"somebody asks for a {asked.split()[0]} of {workload}")
        body = {"metadata": {"annotations": {names.SWITCHOVER: asked}}}
        self.server.update(
            "robotworkloads", (NAMESPACE, workload), lambda item: apiserver.merged(item, body), "somebody"
        )

    def _somebody_pauses(self) -> None:
        self._pause(self.pauses.pause)

    def _somebody_fences(self) -> None:
        self._pause(self.pauses.fence)

    def _pause(self, how: Callable[[str], None]) -> None:
        workload = self.choices.choice(self.workloads)
        if not self.pauses.is_paused(workload):
            how(workload)
            self.later(self.choices.choice([3, 10, 30]) * self.choices.random(), self.pauses.resume, workload)

    def _kubelets_write(self) -> None:
        for uid in sorted(self.robots.running):
            self.later(self.choices.random(), self.robots.heartbeat, uid)

    def _pool_is_resized(self) -> None:
        """By somebody: free pods are deleted while they may be claimed."""
        place, item = self.choices.choice(sorted(self.server.items["fallbackpools"].items()))
        field_, sizes = ("replicas", (0, 1, 2, 3)) if "replicas" in item["spec"] else ("perWorkload", (1, 2))
        size = self.choices.choice(sizes)
        self.note(f"pool {place[1]} is to have {size} pods")
        self.server.update(
            "fallbackpools", place, lambda pool: apiserver.merged(pool, {"spec": {field_: size}}), "somebody"
        )

    def _template_changes(self) -> None:
        """Somebody gives a pool or a workload another image: its pods are replaced while they may be needed."""
        found = [
            (plural, place)
            for plural in ("fallbackpools", "robotworkloads")
            for place, item in sorted(self.server.items[plural].items())
            if "template" in item["spec"]
        ]
        if not found:
            return
        plural, place = self.choices.choice(found)
        image = f"app:{next(self._ids) + 1}"
        self.note(f"{plural} {place[1]} is to run {image}")

        def change(item: Object) -> Object:
            (container,) = item["spec"]["template"]["spec"]["containers"]
            containers = [{**container, "image": image}]
            return apiserver.merged(item, {"spec": {"template": {"spec": {"containers": containers}}}})

        self.server.update(plural, place, change, "somebody")

    def _something_is_deleted(self) -> None:
        """By somebody: what the operator makes again."""
        found = [
            (plural, place)
            for plural in (self.gate_plural, "replicasets", "configmaps")
            for place, item in sorted(self.server.items[plural].items())
            if kube_objects.MANAGED_BY.items() <= kube_objects.labels(item).items()
        ]
        plural, place = self.choices.choice(found)
        self.note(f"{plural} {place[1]}: deleted by somebody")
        self.server.write(plural, place, None, "somebody")
        if place[1].endswith("-gate"):
            self.invariants.failed.clear()  # with its gate goes the record of what has failed
        for pod_place, pod in sorted(self.server.items["pods"].items()):
            owner = apply.controller_of(pod)
            if (
                plural == "replicasets"
                and owner is not None
                and (owner["kind"], owner["name"]) == ("ReplicaSet", place[1])
            ):
                self.robots.delete(pod, by=f"the garbage collector, of {pod_place[1]}")

    def _labels_are_edited(self) -> None:
        """By somebody: labels that the policies of a gate select by, and that show whose a pod is."""
        found = [one for one in self.robots.running.values() if one.exists and one.robot and not one.held]
        if not found:
            return
        running = self.choices.choice(sorted(found, key=lambda one: one.uid))
        pod = self.server.get("pods", running.place)
        active = self.robots.running.get(self._active(running.robot))
        if pod is None or pod["metadata"]["uid"] != running.uid or "deletionTimestamp" in pod["metadata"]:
            return
        edits: list[dict[str, str | None]] = [{names.INSTANCE: None}]
        edits += [{names.INSTANCE: active.name}] if active is not None else []
        owner = apply.controller_of(pod)
        if owner is not None and owner["kind"] == "RobotWorkload":  # others release a pod whose labels have changed
            edits += [{names.WORKLOAD: None}, {names.CLAIMED_BY: None}, {names.POOL: None}, dict.fromkeys(OURS)]
        edit = self.choices.choice(edits)
        self.note(f"somebody edits labels of {running.name}: {edit}")
        running.harmed = True
        self.invariants.tampered(pod)
        self.server.update(
            "pods", running.place, lambda item: apiserver.merged(item, {"metadata": {"labels": edit}}), "somebody"
        )

    def _node(self) -> None:
        node = self.choices.choice(NODES)
        if self.choices.random() < 0.5:
            self.note(f"node {node} is drained")
            self.robots.drain(node)
        else:
            self.note(f"node {node} is lost")
            self.robots.lose(node)

    def _node_of(self, workload: str) -> str:
        """The node of whom a gate lets through, or any."""
        found = self.robots.running.get(self._active(workload))
        return found.node if found is not None else self.choices.choice(NODES)

    def _node_enforces_late(self) -> None:
        node, lag = self._node_of(workload := self.choices.choice(self.workloads)), self.choices.choice([0.3, 1.5, 6.0])
        self._falls_behind(node, lag, workload)

    def _node_is_deaf(self) -> None:
        """As when its policy agent has died: who was let through there stays so."""
        self._falls_behind(self._node_of(workload := self.choices.choice(self.workloads)), math.inf, workload)

    def _falls_behind(self, node: str, lag: float, workload: str) -> None:
        if self.robots.nodes.is_late(node):
            return
        lasts = 4 + self.choices.random() * 20
        self.note(f"node {node} enforces gates {lag} s late, for {lasts:.1f} s")
        self.robots.nodes.lags[node] = lag
        self.robots.harm(node)
        self.later(lasts, self.robots.heal, node)
        self.later(
            self.choices.random() * 3, lambda: self._break(self._active(workload), self.choices.choice(FAILURES[-2:]))
        )

    def _node_is_forgotten(self) -> None:
        """Its pods live on. Mostly control goes elsewhere meanwhile."""
        node = self._node_of(workload := self.choices.choice(self.workloads))
        if any(self.robots.nodes.is_late(other) for other in NODES):
            return
        seconds, deletes = self.choices.choice([5, 12, 60]), self.choices.random() < 0.5
        self.note(f"the API server loses node {node} for {seconds} s; its pods live on")
        self.robots.forget(node, deletes=deletes)
        self.later(seconds, self.robots.recall, node)
        if self.choices.random() < 0.7:
            self.later(
                self.choices.random() * 10,
                lambda: self._break(self._active(workload), self.choices.choice(FAILURES[-2:])),
            )

    def _end_of_trouble(self) -> None:
        self.note("from here on nothing goes wrong any more")
        self.network.weather, self.robots.luck = Weather(), Luck(slow=0.0)
        self.network.cut_off.clear()
        self.network.set_apart(list(self.network.apart), False)
        self.network.denied.clear()
        for node in NODES:
            self.robots.recall(node)
        for monitor in self.monitors:
            monitor.fuse.left = None
        # Of two monitors of one workload its Deployment ends the older one.
        for workload in self.workloads:
            for monitor in [m for m in self.monitors if m.workload == workload][:-1]:
                self.kill(monitor.process)
        for workload in self.workloads:
            self.pauses.resume(workload)
        self._calm = True

"""Watches the topics in the robot's ROS graph, and evaluates the policy's health tree with them."""

from __future__ import annotations

import asyncio
import itertools
import logging
import math
import time
from collections.abc import Collection, Sequence
from dataclasses import replace

from understudy.api.kinds.failure_policy import FailurePolicySpec, Monitoring
from understudy.api.kinds.robot_workload import Output, RobotWorkloadSpec
from understudy.clock import CLOCK
from understudy.failover.interfaces import Gate, Instance, Instances
from understudy.failover.pinned import PinnedPod
from understudy.kube.gates.mux_reports import MuxReports
from understudy.monitor.observe.objects.resource_meter import ResourceMeter
from understudy.monitor.observe.robot.context_detection import ContextDetection, SituationState
from understudy.monitor.observe.robot.degraded_tree import BusyReason, DegradedTrees
from understudy.monitor.observe.robot.known_senders import (
    REMEMBERED,
    Caller,
    KnownSender,
    KnownSenders,
    OutputSender,
    host_at,
)
from understudy.ros.observe.offered_qos import offers
from understudy.ros.observe.sample_rings import SampleRing
from understudy.ros.observe.topic_watch import TopicWatch
from understudy.ros.observe.writer_instances import WriterInstances
from understudy.ros.rmw import MIDDLEWARE
from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
from understudy.ros.runtime.graph_node import Graph
from understudy.ros.runtime.interface_types import TypeNotInstalled, interface_class, message_fields
from understudy.trees.core.health_tree import HealthTree, Verdict, WatchedTopic
from understudy.trees.core.observations import Observations, PodState, TopicRecord
from understudy.trees.core.snapshots import Shown, Snapshot, snapshot, states
from understudy.trees.languages.notations import load_monitoring
from understudy.trees.source.problems import TreeError

_logger = logging.getLogger(__name__)

CHECK_PERIOD = 0.002
"""Seconds between checks while a switch is being verified."""

HELD_BACK_PERIOD = 0.05
"""Seconds between checks while a planned switchover waits until the mux hears the understudy."""

LINK, MISSED = 0.2, 1.0
"""Seconds that a sample needs to the robot, and how much earlier the last one of the mux is than the last one here if some are missing."""

POD_CHECK_PERIOD = 0.1
"""Seconds after which the state of the active pod is passed to the trees again."""


class HealthObserver:
    """Receives the topics of the health tree, and evaluates the tree."""

    def __init__(
        self, meter: ResourceMeter | None = None, address: str = "", forwarding: MuxReports | None = None
    ) -> None:
        """``meter`` measures CPU and memory of the active pod; without it, no leaf can judge them. ``address`` is the IP of this pod.
        With ``forwarding``, a mux reports what reaches the robot; without it, this process receives what the robot receives."""
        self._forwarding, self._address = forwarding, address
        self.graph = Graph("understudy_monitor")
        self.coming = ArrivalWakeups()
        """Reports messages that must be evaluated when they arrive."""
        self._watching = TopicWatch(self.graph, arrivals=self.coming)
        self._tree: HealthTree | None = None
        self._loaded: tuple[Monitoring, list[Output]] | None = None
        self._outputs: list[Output] = []
        self._problems: list[str] = []
        self._degraded_trees = DegradedTrees()
        self._context_detection = ContextDetection()
        self._aside: set[str] = set()
        """Topics that only degraded trees and situations need."""
        self._senders = KnownSenders()
        self._pod: Instance | None = None
        self._asked: WatchedTopic | None = None
        """What trees need to know about the object of the active pod; None for nothing."""
        self._meter = meter
        self.own_host = host_at(address)
        """What identifies this pod in GIDs; empty if its address does not tell."""
        self.addresses: dict[str, str] = {}
        """IPs by pod name, of the instances to which samples are attributed: those that exist or that are gone and may still send."""

    def follow(self, policy: FailurePolicySpec, spec: RobotWorkloadSpec | None) -> None:
        """Watch the topics that this policy and this workload need. If a tree does not load, the last one stays in force."""
        outputs = spec.outputs if spec else self._outputs
        again = self._degraded_trees.follow(policy, spec) | self._context_detection.follow(policy)
        if self._loaded == (policy.monitoring, outputs):
            if again:
                self._watch(spec)
            return
        self._loaded = (policy.monitoring, outputs)
        self._outputs = outputs
        self._problems = []
        try:
            self._tree = load_monitoring(policy.monitoring, fields=message_fields)
            self._tree.begin(time.time())
        except TreeError as error:
            _logger.error("the policy's health tree does not load; the last valid one stays in use: %s", error)
            self._problems.append(
                f"The policy's health tree does not load. The monitor uses the last valid one until it is corrected: {error.in_short()}."
            )
        for index, output in enumerate(outputs):
            try:
                interface_class(output.type)
            except TypeNotInstalled as error:
                self._problems.append(f"outputs[{index}].type: {error}.")
        self._watch(spec)

    def _watch(self, spec: RobotWorkloadSpec | None) -> None:
        """Watch the topics that the trees and a reflex need, each once."""
        types = {output.topic: output.type for output in self._outputs if output.topic}
        wanted = {topic.name: topic for topic in (self._tree.topics if self._tree is not None else [])}
        self._aside = set()
        for need in [*self._degraded_trees.topics, *self._context_detection.topics]:
            known = wanted.get(need.name)
            if need.subscribed and (known is None or not known.subscribed):
                self._aside.add(need.name)
            elif known is not None and known.subscribed:
                need = replace(need, type=known.type)  # the health tree's type: its subscription must not change
            wanted[need.name] = known.joined(need) if known is not None else need
        self._asked = next((topic for topic in wanted.values() if topic.pod), None)
        if spec is not None:
            # Which instances publish each output matters even if no tree judges the output: only one may.
            for name, type_ in types.items():
                if message_fields(type_) is not None:
                    need = WatchedTopic(name, type_, 0.0, None)
                    wanted[name] = wanted[name].joined(need) if name in wanted else need
        self._watching.follow(
            topic if topic.type else replace(topic, type=types.get(topic.name)) for topic in wanted.values()
        )

    @property
    def observations(self) -> Observations:
        """The received messages, for health trees."""
        return self._watching

    @property
    def records(self) -> dict[str, TopicRecord]:
        """For each topic that the health tree judges, the record of the messages that count for the active instance."""
        judged = self._tree.judged if self._tree is not None else []
        found = {topic.name: self._watching.topic(topic.name) for topic in judged if topic.subscribed}
        return {name: record for name, record in found.items() if record is not None}

    @property
    def problems(self) -> list[str]:
        """Why something cannot be watched, and how to correct it: one text per problem."""
        unmetered = self._meter.problems if self._meter is not None else []
        watched = [*self._watching.problems, *self._watching.sources.problems()]
        blind = [f"{one}." for one in self._tree.blind] if self._tree is not None else []
        return [
            *self._problems,
            *self._degraded_trees.problems,
            *self._context_detection.problems,
            *watched,
            *unmetered,
            *blind,
        ]

    @property
    def waiting(self) -> list[str]:
        """Topics that can be watched only once somebody publishes them, each with the reason."""
        return self._watching.waiting

    @property
    def summary(self) -> str:
        """A sentence that lists the watched topics."""
        topics = [topic.name for topic in self._tree.judged] if self._tree else []
        return f"Watching {', '.join(topics) or 'nothing'}."

    def snapshot(self) -> Snapshot | None:
        """Return the health tree as of its last evaluation; None if none is loaded."""
        return snapshot(self._tree, self._watching, time.time()) if self._tree is not None else None

    @property
    def states(self) -> Sequence[Shown]:
        """The state of each node of the health tree at its last evaluation."""
        return states(self._tree) if self._tree is not None else ()

    def record(self, ring: SampleRing | None) -> None:
        """Also keep the messages in a ring from now on, as the robot receives them; None stops this.

        With a mux, this process also receives the standbys, and the robot does not.
        """
        self._watching.record(ring, only_counted=self._forwarding is not None)

    def offered(self, topic: str) -> str:
        """Return the QoS that the publishers of a topic offer now, in the format of recordings."""
        return offers(qos for _, qos in self.graph.offers(topic))

    @property
    def output_topics(self) -> list[str]:
        """The outputs that are topics. Only one instance may publish them, also if the health tree does not watch them."""
        return list(dict.fromkeys(output.topic for output in self._outputs if output.topic))

    @property
    def gated(self) -> list[str]:
        """Gated topics that the health tree watches."""
        outputs = set(self.output_topics)
        judged = self._tree.judged if self._tree else []
        return [topic.name for topic in judged if topic.subscribed and topic.name in outputs]

    @property
    def expected(self) -> list[str]:
        """The gated topics that the active instance must publish now. A robot without a goal may stand still."""
        if self._tree is None:
            return []
        now = time.time()
        counting = self._tree.counting(self._watching, now=now, since=now)
        return [topic for topic in self.gated if topic in counting]

    @property
    def sees_nobody(self) -> bool:
        """Whether discovery has reported no node, and no writer of an output or of a judged topic: not every DDS process has a node."""
        judged = (topic.name for topic in (self._tree.judged if self._tree is not None else []) if topic.subscribed)
        topics = {*self.output_topics, *judged}
        return self.graph.is_alone and not any(self.graph.publisher_count(topic) for topic in topics)

    @property
    def never_silent(self) -> list[str]:
        """The outputs that are topics, except those that the active instance need not publish now."""
        idle = set(self.gated).difference(self.expected)
        return [topic for topic in self.output_topics if topic not in idle]

    def drain(self, instances: Sequence[Instance], active: str, pinned: Sequence[PinnedPod] = ()) -> None:
        """Read the messages that have arrived, and attribute them to the instances that exist or may still send.

        ``pinned`` are those that the gate let through of late.
        """
        # The address of a node is that of its other processes too. A mux tells such instances apart by their writers.
        addressed = [one for one in instances if not one.shares_address]
        self._senders.update(addressed, pinned, self._last_at, time.time())
        self.addresses = {name: sender.ip for name, sender in self._senders.named().items() if sender.attributed}
        self._watching.attribute(self.addresses, active)
        self._watching.drain()
        self._update_pod_state(instances, active)
        unwatchable = self._watching.unwatchable
        if self._tree is not None:
            self._tree.leave_out(unwatchable - self._aside)
        self._degraded_trees.leave_out(unwatchable)
        self._context_detection.leave_out(unwatchable)

    def _last_at(self, ip: str) -> float | None:
        """Return when an output was last heard from an address; None if never."""
        host = host_at(ip)
        topics = self.output_topics
        found = [record.last for topic in topics if (record := self._watching.records(topic).get(host)) is not None]
        return max((last for last in found if last is not None), default=None)

    def known_senders(self) -> Sequence[KnownSender]:
        """Return the instances that exist, and those that are gone and may still send."""
        return self._senders.all()

    def output_senders(self) -> Sequence[OutputSender]:
        """Return who reached the robot on each output that is a topic of late, and when last. This pod is left out."""
        if self._forwarding is not None:
            return [OutputSender(*_parted(text), "", (), time.time()) for text in self._forwarding.strangers]
        hosts = self._senders_by_host()
        unrecognized = hosts.pop(b"", [])
        found: list[OutputSender] = []
        for topic in self.output_topics:
            records = self._watching.records(topic)
            intervals = {host: record.interval for host, record in records.items()}
            usual = min(intervals.values(), default=math.inf)
            for host, record in records.items():
                if record.last is None or host == self.own_host or time.time() - record.last > REMEMBERED:
                    continue
                senders = hosts.get(host, [])
                name = senders[0].name if senders else self._nodes_at(host, topic)
                uid = senders[0].uid if senders else ""
                may_be = tuple(one.uid for one in senders or unrecognized)
                interval = intervals[host] if math.isfinite(intervals[host]) else usual
                found.append(OutputSender(topic, name, uid, may_be, record.last, host, interval))
        return found

    def _senders_by_host(self) -> dict[bytes, list[KnownSender]]:
        """Return the known instances by what identifies their host in GIDs. Those that exist come first."""
        hosts: dict[bytes, list[KnownSender]] = {}
        for sender in sorted(self._senders.all(), key=lambda one: not one.listed):
            hosts.setdefault(host_at(sender.ip), []).append(sender)
        return hosts

    def callers(self) -> Sequence[Caller]:
        """Return which instances have a client of an output that is a service or an action, by discovery.

        One that serves the output itself is left out: the robot calls it. None can with a mux, which forwards the calls of one instance.
        """
        if self._forwarding is not None:
            return []
        hosts = self._senders_by_host()
        hosts.pop(b"", None)
        found: list[Caller] = []
        for output in self._outputs:
            calling = {MIDDLEWARE.host_of(end.gid) for end in self.graph.clients(output)} & hosts.keys()
            if calling:
                calling -= {MIDDLEWARE.host_of(end.gid) for end in self.graph.servers_of(output)}
            found += [Caller(output.name, tuple(one.uid for one in hosts[host])) for host in sorted(calling)]
        return found

    def _nodes_at(self, host: bytes, topic: str) -> str:
        """Return the nodes of a host that publish a topic, as text."""
        there = [end.node for end in self.graph.publishers(topic) if MIDDLEWARE.host_of(end.gid) == host and end.node]
        return ", ".join(sorted(set(there))) or "an unnamed node"

    def _update_pod_state(self, instances: Sequence[Instance], active: str) -> None:
        """Pass the state of the active pod's object to the trees, if one of them needs it."""
        watching, before, wanted = self._watching, self._pod, self._asked
        self._pod = next((i for i in instances if i.name == active), None) if wanted is not None else None
        if self._meter is not None:
            self._meter.want(active if wanted is not None and wanted.usage else "")
        if self._pod is None:
            watching.pod_state = None
            return
        now, last = time.time(), watching.pod_state
        if last is None or self._pod is not before or abs(now - last.received) >= POD_CHECK_PERIOD:
            usage = self._meter.usage if self._meter is not None else None
            watching.pod_state = PodState(now, self._pod.conditions, self._pod.restarts, usage)

    def verdict(self, *, now: float, since: float) -> Verdict:
        """Return the health tree's verdict on the active instance. Times are Unix seconds."""
        if self._tree is None:
            return Verdict("Starting", "the policy has no health tree that loads", "", None)
        return self._tree.evaluate(self._watching, now=now, since=since)

    def expect_samples(self, *, since: float, heard_from: float) -> None:
        """Judge the instance that is watched since a time as one that had sent before, and can be heard from another time on.

        This holds until another health tree is in use. Times are Unix seconds.
        """
        if self._tree is not None:
            self._tree.expect_samples(since=since, heard_from=heard_from)

    async def follow_writers(self) -> None:
        """Attribute the samples on outputs to instances by their writers, until cancelled. Only a mux needs it."""
        found = WriterInstances(self._address)
        await found.follow(
            lambda: tuple(self.graph.publisher_count(topic) for topic in self.output_topics),
            lambda: {end.gid for topic in self.output_topics for end in self.graph.publishers(topic)},
            lambda: self._watching.attribute_writers(found.names),
        )

    def discovered(self, instance: Instance) -> bool | None:
        """Return whether discovery has found an endpoint of an output on an instance's host; None if that cannot be known.

        Readers of topics do not count: they are the robot's. It cannot be known without an IPv4 address, or before the outputs are known.
        """
        host = host_at(instance.ip)
        if not host or not self._outputs or instance.shares_address:
            return None
        return any(MIDDLEWARE.host_of(end.gid) == host for one in self._outputs for end in self.graph.endpoints(one))

    def others_discovered(self, instance: Instance) -> bool:
        """Return whether discovery has found an endpoint of an output, such as the robot's reader, on a host that is neither the instance's
        nor this monitor's. True if this monitor's own host is not known."""
        if not self.own_host:
            return True
        known = {b"", self.own_host, host_at(instance.ip)}
        ends = (end for one in self._outputs for end in self.graph.endpoints(one))
        readers = (end for topic in self.output_topics for end in self.graph.subscribers(topic))
        return any(MIDDLEWARE.host_of(end.gid) not in known for end in itertools.chain(ends, readers))

    @property
    def hears_nobody(self) -> bool:
        """Whether this monitor has not received a single message, although it watches topics that the robot publishes."""
        robots = self._robot_topics
        return bool(robots) and not any(self._watching.records(topic) for topic in robots.union(self.output_topics))

    @property
    def unheard(self) -> str:
        """A topic of the robot that made the health tree fail at its last evaluation, and of which this monitor has never received a
        message; empty if there is none."""
        failing = self._tree.failing if self._tree is not None else ()
        return next((topic for topic in self.awaited if topic in failing), "")

    @property
    def awaited(self) -> list[str]:
        """The topics that the robot publishes, that are judged, and of which this monitor has never received a message."""
        return sorted(topic for topic in self._robot_topics if not self._watching.records(topic))

    @property
    def _robot_topics(self) -> set[str]:
        """The topics that the health tree judges and that the robot publishes."""
        judged = self._tree.judged if self._tree is not None else []
        return {topic.name for topic in judged if topic.subscribed}.difference(self.output_topics)

    def degraded_verdict(self, *, now: float, since: float) -> Verdict:
        """Return the verdict of the tree of ``spec.degraded`` on the active instance. Times are Unix seconds."""
        return self._degraded_trees.verdict(self._watching, now=now, since=since)

    def busy(self, *, now: float, since: float) -> BusyReason | None:
        """Return why the robot does not count as idle for the policy's reschedule; None if it does. Times are Unix seconds."""
        return self._degraded_trees.busy(self._watching, now=now, since=since)

    def situations(self, goals: Collection[str], *, now: float, since: float) -> dict[str, SituationState]:
        """Return the state of each situation of the policy, by name. ``goals`` are the actions that have goals. Times are Unix seconds."""
        return self._context_detection.states(self._watching, goals, now=now, since=since)

    def deadline(self, *, now: float, since: float) -> float | None:
        """Return when the verdict could get worse if no further message arrives; None if it cannot."""
        return self._tree.deadline(self._watching, now=now, since=since) if self._tree else None

    def last_from(self, pod: str) -> float | None:
        """Return when a gated topic was last received from a pod; None if never."""
        times = [last for topic in self.gated if (last := self._watching.last_from(topic, pod)) is not None]
        return max(times, default=None)

    def last_well(self, pod: str) -> float | None:
        """Return when the outputs that count now were last received from a pod; None if never, or if none of them counts."""
        times = [last for topic in self.expected if (last := self._watching.last_from(topic, pod)) is not None]
        return max(times, default=None)

    def unreached(self, pod: str) -> str:
        """Return an expected topic of a pod that this monitor receives, and the mux at the robot does not; empty if there is none."""
        found = self._forwarding.latest if self._forwarding is not None else None
        if self._forwarding is None or found is None or self._forwarding.is_silent:
            return ""
        reported = CLOCK.to_system(found.at) - LINK
        for topic in self.expected:
            received = next((at for at in reversed(self.arrivals(topic, pod)) if at <= reported), -math.inf)
            if received - CLOCK.to_system(self._forwarding.last_heard(pod, topic)) > MISSED:
                return topic
        return ""

    @property
    def drove_on_board(self) -> bool:
        """Whether an instance on board drives the robot, or did a moment ago: the active instance could not reach it."""
        return self._forwarding is not None and self._forwarding.drove_on_board

    def arrivals(self, topic: str, pod: str) -> Sequence[float]:
        """Return when a topic was recently received from a pod, in Unix seconds."""
        return self._watching.arrivals(topic, pod)

    def new_process(self, pod: str, *, since: float) -> bool:
        """Return whether a writer of a gated topic in a pod was first heard at or after a time (Unix seconds), as after a restart."""
        return any(self._watching.newest_writer(topic, pod) >= since for topic in self.gated)

    def processes(self, pod: str) -> frozenset[bytes]:
        """Return what identifies the processes of a pod from which gated topics were received."""
        return frozenset[bytes]().union(*(self._watching.processes(topic, pod) for topic in self.gated))

    def ambiguous(self, pod: str) -> bool:
        """Return whether a pod's samples cannot be distinguished from those of another instance."""
        return any(pod in names for names in self._watching.sources.ambiguous)

    def outputs(self, fleet: Instances, gate: Gate) -> GatedReaders:
        """Return what reaches the robot in the form that the failover protocol uses."""
        if self._forwarding is not None:
            return ForwardedOutputs(self, self._watching, fleet, gate, self._forwarding)
        return GatedReaders(self, self._watching, fleet, gate)


class GatedReaders:
    """Implements :class:`understudy.failover.interfaces.Outputs`. Times are of the process's clock."""

    def __init__(self, observer: HealthObserver, watching: TopicWatch, fleet: Instances, gate: Gate) -> None:
        self._observer, self._watching, self._fleet, self._gate = observer, watching, fleet, gate

    @property
    def expected(self) -> Sequence[str]:
        """The gated topics that the active instance must publish now."""
        return self._observer.expected

    @property
    def blind(self) -> bool:
        """Whether discovery has reported nobody to this monitor."""
        return self._observer.sees_nobody

    async def first_from(self, instance: Instance, *, since: float) -> float | None:
        """Wait for a sample of each expected topic from the instance, received after ``since``. Returns when the first arrived.

        Returns None if no topic is expected, or none any more: a task may end, and with it the need for its topics.
        """
        while True:
            self._drain()
            if not self.expected:
                return None
            if (first := self._heard_from(instance, since)) is not None:
                return first
            await asyncio.sleep(CHECK_PERIOD)

    async def heard_held_back(self, instance: Instance) -> None:
        """Return at once: a NetworkPolicy lets everything through as soon as the gate is open."""

    def _heard_from(self, instance: Instance, since: float) -> float | None:
        """Return when the first sample of the instance arrived after ``since``; None if one of each expected topic has not."""
        # If two pods cannot be distinguished, a sample that passes the gate is from the pod that the gate names.
        ambiguous = any(instance.name in names for names in self._watching.sources.ambiguous)
        system = CLOCK.to_system(since)
        found = [self._first(topic, instance.name, system, ambiguous) for topic in self.expected]
        if not all(time is not None for time in found):
            return None
        return CLOCK.of_system(min(time for time in found if time is not None))

    def _first(self, topic: str, pod: str, since: float, ambiguous: bool) -> float | None:
        if not ambiguous:
            return self._watching.first_from(topic, pod, since=since)
        record = self._watching.topic(topic)
        return record.last if record is not None and record.last is not None and record.last >= since else None

    def last_from_others(self, instance: Instance) -> tuple[float, str]:
        """Return when a sample of another instance last passed the gate, and from which pod. The time is 0 if never."""
        self._drain()
        topics, name = self._observer.output_topics, instance.name
        found = [last for topic in topics if (last := self._watching.last_from_others(topic, name)) is not None]
        if not found:
            return 0.0, ""
        last_sample, pod = max(found)
        return CLOCK.of_system(last_sample), pod

    def heard(self) -> Sequence[tuple[float, float]]:
        """Return when a sample last arrived on an output from each sender but this pod, and the seconds that usually pass between two.

        A monitor that has lost the API server does not know each instance that drives. If this pod's own samples cannot be recognized,
        because its address is an IPv6 address, only those of known instances count.
        """
        self._drain()
        own_is_known = self._observer.own_host != b""
        senders = (one for one in self._observer.output_senders() if one.uid or own_is_known)
        return [(CLOCK.of_system(one.last), one.interval) for one in senders]

    def switched_to(self, instance: Instance) -> str:
        """Return nothing: only what the gate names reaches the robot, or the readers of the robot switch, which is seen as a leak."""
        return ""

    def period_of_others(self, instance: Instance) -> float:
        """Return the longest usual time in seconds between two samples of another instance on one topic; 0 if none was heard of late."""
        self._drain()
        topics, name = self._observer.output_topics, instance.name
        return max((self._watching.period_of_others(topic, name) for topic in topics), default=0.0)

    def _drain(self) -> None:
        state = self._gate.state
        self._observer.drain(self._fleet.of_workload(), state.active, state.pinned)


class ForwardedOutputs(GatedReaders):
    """The same with a mux: what it forwards reaches the robot, and nothing else."""

    def __init__(
        self, observer: HealthObserver, watching: TopicWatch, fleet: Instances, gate: Gate, reports: MuxReports
    ) -> None:
        super().__init__(observer, watching, fleet, gate)
        self._reports = reports

    async def first_from(self, instance: Instance, *, since: float) -> float | None:
        """Wait until the mux has forwarded a sample of each expected topic from the instance, received after ``since``.

        Returns when it forwarded the first one; None if no topic is expected, or none any more. While no mux reports, for example because
        the robot is switched off, what the instance sends has to do: another instance would reach the robot no better.
        """
        while True:
            self._drain()
            if not self.expected:
                return None
            first = self._heard_from if self._reports.is_silent else self._forwarded_from
            if (found := first(instance, since)) is not None:
                return found
            await asyncio.sleep(CHECK_PERIOD)

    def _forwarded_from(self, instance: Instance, since: float) -> float | None:
        forwarded, heard = self._reports.forwarded(instance.name), self._reports.heard()
        acknowledged = self._reports.last(instance.uid)
        # Before it knows the order, it may have switched to this instance by itself, and from it to another one since.
        if forwarded is None or acknowledged is None or CLOCK.of_system(acknowledged) < since:
            return None
        if not all(heard.get(topic, -math.inf) >= since for topic in self.expected):
            return None
        return max(since, forwarded.forwarding_since)

    async def heard_held_back(self, instance: Instance) -> None:
        """Wait until the mux hears each expected topic of an instance that it does not forward: it knows the writers then.

        Returns at once while no mux reports.
        """
        while not self._reports.is_silent and not self._reports.hears(instance.name, self.expected):
            self._drain()
            await asyncio.sleep(HELD_BACK_PERIOD)

    def last_from_others(self, instance: Instance) -> tuple[float, str]:
        """Return that no sample of another instance is forwarded."""
        return 0.0, ""

    def switched_to(self, instance: Instance) -> str:
        """Return to which other instance the mux has switched by itself, as its answer to the present order reports."""
        return self._reports.switched_from(instance.name, instance.uid)

    def period_of_others(self, instance: Instance) -> float:
        """Return 0, as no sample of another instance is awaited."""
        return 0.0

    def heard(self) -> Sequence[tuple[float, float]]:
        """Return when the mux last heard the instance that it forwards, on each output."""
        return [(at, math.inf) for at in self._reports.heard().values()]


def _parted(stranger: str) -> tuple[str, str]:
    """Return the output and the node of a writer in a report of a mux."""
    output, _, node = stranger.partition(" by ")
    return output, node

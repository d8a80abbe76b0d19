"""Evaluates the policy's health tree on the instance from inside its pod.

The outputs of an executing standby do not reach the monitor, and every reader of the same name matches those of the
active pod. So the health of a standby can be determined only here. For an output, only samples of writers on this host
count (the pod's network namespace, see Middleware.host_of). For everything else all samples count, since instances of
one workload are isolated from each other.

ROS is imported when it is first needed. A held agent imports it earlier, as soon as it runs.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from understudy.agent.output_topics import Output
from understudy.api import names
from understudy.api.protocol.agent_messages import OutputCount
from understudy.clock import CLOCK
from understudy.ros.runtime.lean_imports import import_in_turn, import_rclpy

if TYPE_CHECKING:
    from understudy.ros.actions.calling_node import GraphLocation
    from understudy.ros.observe.topic_watch import TopicWatch
    from understudy.ros.runtime.graph_node import Graph
    from understudy.trees.core.health_tree import HealthTree, Verdict, WatchedTopic
    from understudy.trees.core.observations import (
        PodState,
        TopicRecord,
    )

_logger = logging.getLogger(__name__)

STARTING_PERIOD = 0.02
"""Seconds between evaluations while the instance starts: its start is part of the time of a recovery."""

STARTING_FOR = 60.0
"""Seconds after which an instance that is still not up is evaluated as seldom as any other."""

PERIOD = 0.2
"""Seconds between evaluations otherwise. Deadlines of the tree cause further ones."""

PRESENCE_PERIOD = 2.0
"""Seconds between checks that the application's endpoints still exist, once they have existed."""

OWN_GID = 5.0
"""Seconds within which the agent's node must see its own publisher."""

OURS = "/understudy_"
"""Prefix of the names of this process's own nodes."""

RETRY = 5.0
"""Seconds before joining the ROS graph is tried again."""


@dataclass(frozen=True)
class HealthPlan:
    """The monitor's settings for evaluating the instance."""

    tree: HealthTree
    outputs: Sequence[Output]
    managed: bool = False
    """Whether procedures bring its nodes up. Then its processes count as up with their first node, and not only with
    their first output, which may need a procedure."""

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> HealthPlan:
        """Read a ``configure`` request. Raises ValueError with everything that is wrong with it."""
        import_in_turn("understudy.trees.languages.notations")
        from understudy.trees.languages.notations import load_health
        from understudy.trees.source.problems import TreeError

        grace = body.get("grace", 30.0)
        if not isinstance(grace, int | float) or isinstance(grace, bool) or not 0 <= grace < float("inf"):
            raise ValueError(f"grace {grace!r}: expected a number of seconds")
        try:
            outputs = [Output.from_wire(output) for output in body.get("outputs", [])]
            tree = load_health(body.get("form", "yaml"), body.get("tree", {}), grace=float(grace))
            return cls(tree, outputs, bool(body.get("managed")))
        except (TreeError, TypeError) as error:
            raise ValueError(str(error)) from error

    def topics(self) -> list[WatchedTopic]:
        """Return the topics to watch. The outputs give the types that the tree leaves open."""
        types = {output.topic: output.type for output in self.outputs if output.topic}
        return [dataclasses.replace(topic, type=topic.type or types.get(topic.name)) for topic in self.tree.topics]


@dataclass
class InstanceJudgement:
    """The state of the instance. Times are Unix seconds.

    A ready instance also has a reason if part of the tree cannot be evaluated, for example because a type is not
    installed.
    """

    ready: bool = False
    reason: str = "not evaluated yet"
    process_up_at: float | None = None
    ready_at: float | None = None
    outputs: dict[str, OutputCount] = field(default_factory=dict)


class _OwnOutputs:
    """Observations in which an output counts only if it comes from this host."""

    in_control = False
    """The agent does not know whether its instance is active. If it is not, the robot follows another instance."""

    def __init__(self, watching: TopicWatch, outputs: Sequence[Output], host: bytes) -> None:
        self._watching, self._host = watching, host
        self._topics = {output.topic for output in outputs if output.topic}
        self.own, self.publishers, self.node = watching.own, watching.publishers, watching.node
        self.lifecycle, self.parameter = watching.lifecycle, watching.parameter

    def topic(self, name: str) -> TopicRecord | None:
        if name not in self._topics:
            return self._watching.topic(name)
        return self._watching.records(name).get(self._host)

    def task(self, name: str) -> float | None:
        """Return since when this instance has a goal: only its own goals give it work."""
        from understudy.ros.rmw import MIDDLEWARE

        times = [since for gid, since in self._watching.active(name).items() if MIDDLEWARE.host_of(gid) == self._host]
        return min(times, default=None)

    def pod(self) -> PodState | None:
        """Return None: the cluster's view of the pod is not visible from inside it."""
        return None

    def counts(self) -> dict[str, OutputCount]:
        """Return the counts of the watched outputs."""
        found: dict[str, OutputCount] = {}
        for name in sorted(self._topics):
            if self._watching.topic(name) is not None:
                record = self._watching.records(name).get(self._host)
                found[name] = OutputCount(record.count, record.last) if record else OutputCount()
        return found


class InstanceHealth:
    """Evaluates the instance until cancelled, and keeps the result in ``judgement``."""

    def __init__(
        self,
        pod: str,
        *,
        on_change: Callable[[], None],
        on_writers: Callable[[Iterable[bytes]], object] = lambda gids: None,
    ) -> None:
        """``on_change`` is called when anything but the counts of the outputs changes.

        ``on_writers`` is called now and then with the GIDs of this pod's writers of outputs.
        """
        self.judgement = InstanceJudgement()
        self._node_name = "understudy_agent_" + names.in_ros(pod)
        self._on_change = on_change
        self._on_writers = on_writers
        self._plan: HealthPlan | None = None
        self._new_plan = asyncio.Event()
        self._keep_ready = False
        self._since = 0.0
        self._presence_checked_at = 0.0
        self._present = False
        self._joined: tuple[Graph, TopicWatch, bytes] | None = None
        self._own: _OwnOutputs | None = None
        self._also: dict[str, tuple[WatchedTopic, ...]] = {}
        self._also_since = 0.0

    def place(self) -> GraphLocation | None:
        """Return the location of this process in the ROS graph; None while it has not joined."""
        from understudy.ros.actions.calling_node import GraphLocation

        if self._joined is None:
            return None
        graph, _, host = self._joined
        return GraphLocation(graph.node.context, host)

    def watch(self, purpose: str, topics: Sequence[WatchedTopic]) -> None:
        """Watch further topics, for trees with this purpose. They replace the earlier topics of the same purpose."""
        if tuple(topics) == self._also.get(purpose, ()):
            return
        self._also[purpose] = tuple(topics)
        self._also_since = time.time()
        self._follow()

    def verdict(self, tree: HealthTree) -> Verdict:
        """Return the verdict of a tree, whose topics must be watched, on this instance."""
        from understudy.trees.core.health_tree import Verdict

        if self._own is None or self._joined is None:
            return Verdict("Starting", "the agent has not joined the ROS graph yet", "", None)
        watching = self._joined[1]
        watching.drain()
        tree.leave_out(watching.unwatchable)
        if tree.root is None:
            return Verdict("Failed", "; ".join(watching.problems), "", None)
        now = time.time()
        self._also_since = min(self._also_since, now)  # the clock may have been set back
        return tree.evaluate(self._own, now=now, since=self._also_since)

    def _follow(self) -> None:
        """Watch the topics of the plan and of all other trees."""
        if self._joined is None or self._plan is None:
            return
        watching = self._joined[1]
        found: dict[str, WatchedTopic] = {}
        types = {output.topic: output.type for output in self._plan.outputs if output.topic}
        for topic in [*self._plan.topics(), *(topic for topics in self._also.values() for topic in topics)]:
            joined = found.get(topic.name, topic).joined(topic)
            found[topic.name] = dataclasses.replace(joined, type=joined.type or types.get(topic.name))
        watching.follow(found.values())

    def resume(self, process_up_at: float | None, ready_at: float | None) -> None:
        """Continue from what an earlier agent of this pod observed."""
        self.judgement.process_up_at, self.judgement.ready_at = process_up_at, ready_at

    def configure(self, plan: HealthPlan) -> None:
        """Evaluate by this plan from now on. A ready instance stays ready until the new tree fails."""
        self._plan = plan
        self._keep_ready = self.judgement.ready
        self._new_plan.set()

    async def run(self) -> None:
        """Join the ROS graph that the process's environment names, and evaluate the instance."""
        self._set_readiness(False, "joining the ROS graph")
        while True:
            try:
                graph, watching, host = await asyncio.to_thread(_join, self._node_name)
            except Exception as error:
                _logger.exception("joining the ROS graph")
                self._set_readiness(False, f"cannot join the ROS graph: {error}")
                await asyncio.sleep(RETRY)
                continue
            try:
                self._joined = graph, watching, host
                await self._observe(graph, watching, host)
            except Exception as error:
                _logger.exception("observing the instance")
                self._set_readiness(False, f"evaluating the instance failed: {error!r}")
                await asyncio.sleep(RETRY)
            finally:
                self._joined = self._own = None
                watching.close()
                graph.close()

    async def _observe(self, graph: Graph, watching: TopicWatch, host: bytes) -> None:
        if self._plan is None:
            self._set_readiness(False, "waiting for the monitor's health tree")
            await self._new_plan.wait()
        self._new_plan.set()
        joined = time.monotonic()
        while True:
            plan = self._plan
            assert plan is not None, "it was waited for"
            if self._new_plan.is_set():
                self._new_plan.clear()
                self._follow()
                own = self._own = _OwnOutputs(watching, plan.outputs, host)
                self._since = time.time()
            watching.drain()
            plan.tree.leave_out(watching.unwatchable)
            now = time.time()
            if self._since > now:  # the clock was set back: until that time nothing would count
                self._since, self._keep_ready = now, self.judgement.ready
            self._judge(graph, watching, host, plan, own, now)
            young = self.judgement.ready_at is None and time.monotonic() - joined < STARTING_FOR
            rest = STARTING_PERIOD if young else PERIOD
            deadline = plan.tree.deadline(own, now=now, since=self._since)
            if deadline is not None:
                rest = min(rest, max(0.0, deadline - time.time()))
            await self._pause(rest)

    async def _pause(self, rest: float) -> None:
        """Wait, but return at once if there is a new plan."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(rest):
                await self._new_plan.wait()

    def _judge(
        self, graph: Graph, watching: TopicWatch, host: bytes, plan: HealthPlan, own: _OwnOutputs, now: float
    ) -> None:
        judgement = self.judgement
        self._update_presence(graph, host, plan)
        up = self._present or (plan.managed and judgement.process_up_at is None and _application(graph, host))
        if up and judgement.process_up_at is None:
            judgement.process_up_at = CLOCK.now()
            self._on_change()
        verdict = plan.tree.evaluate(own, now=now, since=self._since)
        judgement.outputs = own.counts()
        if not self._present:
            outputs = ", ".join(output.name for output in plan.outputs)
            self._set_readiness(False, f"nothing in this pod publishes or serves {outputs}")
        elif verdict.state == "Healthy":
            self._keep_ready = False
            if judgement.ready_at is None:
                judgement.ready_at = CLOCK.now()
            self._set_readiness(True, "; ".join(watching.problems))
        elif verdict.state == "Starting" and self._keep_ready:
            self._set_readiness(True, "; ".join(watching.problems))
        else:
            self._keep_ready = False
            self._set_readiness(False, "; ".join([verdict.reason, *watching.problems, *watching.waiting]))

    def _update_presence(self, graph: Graph, host: bytes, plan: HealthPlan) -> None:
        """Check whether this pod's application has an endpoint for an output. Once it has had one, check seldom."""
        from understudy.ros.rmw import MIDDLEWARE

        now = time.monotonic()
        if self._present and now < self._presence_checked_at + PRESENCE_PERIOD:
            return
        self._presence_checked_at = now
        found = [
            (output, end)
            for output in plan.outputs
            for end in graph.endpoints(output)
            if MIDDLEWARE.host_of(end.gid) == host
        ]
        self._present = bool(found)
        self._on_writers(end.gid for output, end in found if output.topic)

    def _set_readiness(self, ready: bool, reason: str) -> None:
        judgement = self.judgement
        if (judgement.ready, judgement.reason) != (ready, reason):
            if judgement.ready != ready:
                _logger.info("ready" if ready else "not ready: %s", *([] if ready else [reason]))
            judgement.ready, judgement.reason = ready, reason
            self._on_change()


def _application(graph: Graph, host: bytes) -> bool:
    """Whether a node of the application exists: one on this host that is not one of Understudy's."""
    from understudy.ros.rmw import MIDDLEWARE

    nodes = graph.publishers("/parameter_events")
    return any(MIDDLEWARE.host_of(node.gid) == host and node.node and not node.node.startswith(OURS) for node in nodes)


def _join(node_name: str) -> tuple[Graph, TopicWatch, bytes]:
    """Create this process's node. Returns it with the part of a GID that identifies writers of this host.

    That part is read from the node's own publisher, so it is right for any addresses of the pod. Blocks for about a
    second.
    """
    import_rclpy()
    from understudy.ros.observe.topic_watch import TopicWatch
    from understudy.ros.rmw import MIDDLEWARE
    from understudy.ros.runtime.graph_node import Graph

    graph = Graph(node_name)
    try:
        end = time.monotonic() + OWN_GID
        while time.monotonic() < end:
            for endpoint in graph.publishers("/parameter_events"):
                if endpoint.node == f"/{node_name}":
                    host = MIDDLEWARE.host_of(endpoint.gid)
                    return graph, TopicWatch(graph, host), host
            time.sleep(0.01)
        raise TimeoutError(f"the agent's ROS node did not discover its own publisher within {OWN_GID:g} s")
    except BaseException:
        graph.close()
        raise

"""The action proxies as processes in the monitors' pods. Their real code runs over endpoints of the model."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tests.unit.interleavings.scheduling import Process, current
from tests.unit.interleavings.tcp import Tcp
from understudy.action_proxy import process as proxy_process
from understudy.action_proxy import proxy as serving
from understudy.action_proxy import succession
from understudy.agent.restoration import task_goals
from understudy.process import http_pages
from understudy.ros.actions.action_endpoints import RequestHandlers
from understudy.ros.runtime.service_exchange import RequestId


@dataclass(frozen=True)
class Answer:
    """What a proxy answers to a client."""

    request: RequestId
    accepted: bool | None = None
    """Whether it accepts a goal; None in other answers."""
    status: int | None = None
    """With which status a goal has ended; None in other answers."""


@dataclass(eq=False)
class Pod:
    """The pod of a monitor and of its proxy."""

    workload: str
    name: str
    folder: Path
    """Of the proxy; it lasts as long as the pod."""
    socket: Path
    process: Process | None = None
    """The proxy's; None while its container waits for its next start."""


class Node:
    """Stands in for :class:`understudy.ros.runtime.served_node.ServedNode`."""

    silent_for = 0.0

    def __init__(self, name: str) -> None:
        return

    async def close(self) -> None:
        return


class Page:
    """Stands in for the server of the health page."""

    def close(self) -> None:
        return


async def _no_page(*_: Any) -> Page:
    return Page()


@dataclass(eq=False)
class Server:
    """Stands in for :class:`understudy.ros.actions.action_endpoints.ActionServer`."""

    endpoints: Endpoints
    handlers: RequestHandlers
    process: Process

    async def open(self) -> None:
        self.endpoints.servers.append(self)

    async def close(self) -> None:
        self.endpoints.servers.remove(self)

    def answer_goal(self, request: RequestId, accepted: bool, stamp: int) -> None:
        self.endpoints.answer(self, Answer(request, accepted=accepted))

    def answer_result(self, request: RequestId, status: int, result: bytes) -> None:
        self.endpoints.answer(self, Answer(request, status=status))

    def answer_cancel(self, request: RequestId, code: int, goals: Sequence[tuple[str, int]]) -> None:
        return

    def publish_status(self, goals: object) -> None:
        return

    def publish_feedback(self, feedback: bytes) -> None:
        return


@dataclass(eq=False)
class Topic:
    """Stands in for :class:`understudy.ros.runtime.text_topic.TextTopic`."""

    endpoints: Endpoints
    name: str
    on_received: Callable[[str], None]
    process: Process

    async def open(self) -> None:
        self.endpoints.topics.append(self)

    def publish(self, text: str) -> None:
        for other in self.endpoints.topics:
            if other.name == self.name:
                self.endpoints.deliver(self.process, other.process, other.on_received, text)


@dataclass
class Endpoints:
    """The part of the ROS graphs in which proxies and clients are."""

    tcp: Tcp
    reaches: Callable[[Process], bool]
    """Whether a proxy reaches others than the containers of its pod."""
    answered: Callable[[Answer], None]
    """Called in the world's process with what a client receives."""
    servers: list[Server] = field(default_factory=list)
    topics: list[Topic] = field(default_factory=list)
    pods: dict[str, Pod] = field(default_factory=dict)
    """By name."""

    def serving(self, workload: str) -> list[Server]:
        """Return the servers of a workload's action that clients can reach."""
        mine = {pod.process for pod in self.pods.values() if pod.workload == workload}
        return [one for one in self.servers if one.process in mine and one.process.alive and self.reaches(one.process)]

    def answer(self, server: Server, answer: Answer) -> None:
        """Pass an answer on to its client."""
        if self.reaches(server.process):
            self.tcp.later(self.tcp.delay(), self.answered, answer)

    def deliver(self, by: Process, to: Process, work: Callable[..., None], *args: Any) -> None:
        """Have a proxy receive something."""
        if not (self.reaches(by) and self.reaches(to)):
            return

        def arrive() -> None:
            if to.alive:
                self.tcp.loop.call_soon(work, *args, context=to.context)

        self.tcp.later(self.tcp.delay(), arrive)

    def ended(self, process: Process) -> None:
        """A proxy has ended, and its endpoints with it."""
        self.servers = [one for one in self.servers if one.process is not process]
        self.topics = [one for one in self.topics if one.process is not process]

    # -- what proxies have instead of ROS ---------------------------------------------------------------------------

    def patches(self) -> Iterator[tuple[Any, str, Any]]:
        """What has to be so for the time of a run: targets, attributes and their values."""
        numbers = itertools.count(1)
        yield proxy_process, "ServedNode", Node
        yield proxy_process, "LastingCopy", lambda path: None
        yield http_pages, "serve", _no_page
        yield serving, "ActionServer", self._server
        yield serving, "ActionType", SimpleNamespace(of=lambda name: None)
        yield succession, "TextTopic", self._topic
        yield succession, "_since_boot", self.tcp.loop.time
        yield succession, "boot_id", lambda: "boot"
        yield succession, "secrets", SimpleNamespace(token_hex=lambda size: f"pod-{next(numbers):04}")
        yield task_goals, "_type", lambda name: None

    def _server(self, node: Node, action: str, type_: object, handlers: RequestHandlers) -> Server:
        return Server(self, handlers, _own())

    def _topic(self, node: Node, name: str, on_received: Callable[[str], None]) -> Topic:
        return Topic(self, name, on_received, _own())


def _own() -> Process:
    process = current()
    assert process is not None
    return process


async def run(pod: Pod, namespace: str) -> None:
    """As the proxy's container does, until another proxy has replaced this one."""
    (pod.folder / proxy_process.OWN).mkdir(parents=True, exist_ok=True)
    await proxy_process._run(namespace, pod.workload, pod.folder, pod.socket, 0)
    await asyncio.sleep(0)

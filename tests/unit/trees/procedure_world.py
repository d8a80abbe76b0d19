"""Procedures and the instances that they run on, for tests."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from typing import Any

from understudy.trees.core.health_tree import HealthTree, Verdict
from understudy.trees.core.observations import RecordedObservations, TopicRecord

LONG = 20.0
"""Seconds for what ends by itself."""


class Instance:
    """An instance whose nodes and services are said by the test."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self.states: dict[str, str] = {}
        self.answers: dict[str, list[dict[str, Any]]] = {}
        self.never: set[str] = set()
        self.parameters: dict[str, Any] = {}
        self.record: TopicRecord | None = None
        self.nodes: set[str] = set()
        self.cancelled: list[str] = []
        self.since = asyncio.get_running_loop().time()

    async def _step(self, what: str, name: str) -> None:
        self.done.append(f"{what} {name}")
        if name in self.never:
            try:
                await asyncio.Event().wait()
            except asyncio.CancelledError:
                self.cancelled.append(name)
                raise
        await asyncio.sleep(0)

    async def call(
        self, service: str, type_name: str, request: Mapping[str, Any], within: float, *, repeat: float | None = None
    ) -> dict[str, Any]:
        await self._step("call" if repeat is None else f"call every {repeat:g} s", service)
        answers = self.answers.get(service, [{}])
        return answers.pop(0) if len(answers) > 1 else answers[0]

    async def service_present(self, service: str) -> bool:
        return service in self.nodes

    async def node_present(self, node: str) -> bool:
        return node in self.nodes

    async def lifecycle_state(self, node: str, within: float) -> str:
        return self.states.get(node, "unconfigured")

    async def bring_to(self, node: str, state: str, within: float) -> None:
        await self._step(state, node)
        self.states[node] = state

    async def get_parameters(self, node: str, names: Sequence[str], within: float) -> dict[str, Any]:
        return {name: self.parameters[name] for name in names}

    async def set_parameters(self, node: str, values: Mapping[str, Any], within: float) -> None:
        self.parameters |= values
        await self._step("set", node)

    async def publish(self, topic: str, type_name: str, message: Mapping[str, Any], within: float) -> None:
        await self._step("publish", topic)

    async def wait_sample(self, topic: str, type_name: str, within: float) -> object:
        await self._step("sample", topic)
        return None

    async def restore_state(self, only: Sequence[str] | None, within: float) -> None:
        await self._step("restore", ",".join(only) if only else "all")

    async def resend_goals(self, within: float) -> None:
        await self._step("resend", "goals")

    def health(self, tree: HealthTree) -> Verdict:
        now = asyncio.get_running_loop().time()
        topics = {"/scan": self.record} if self.record else {}
        return tree.evaluate(RecordedObservations(topics), now=now, since=self.since)

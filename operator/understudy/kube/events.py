"""Kubernetes Events that increase a count instead of flooding the API server.

Repeating a message raises the count of its Event. Many different messages for one reason become one Event. A token
bucket limits the Events about one object (the rules of client-go's EventCorrelator). Events inform people, and nothing
depends on them: a failure to write one raises no error.
"""

from __future__ import annotations

import logging
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Literal, TypeVar

from understudy.api.plain_text import one_line
from understudy.kube.client import EVENTS, FAILURES, ApiError, Client, Object

_logger = logging.getLogger(__name__)

_K = TypeVar("_K")
_V = TypeVar("_V")

SIMILAR_MOST = 10
"""Different messages of one reason for one object within SIMILAR_SECONDS before they are combined into one."""
SIMILAR_SECONDS = 600.0
BURST = 25.0
"""Writes about one object that are possible at once; afterwards one every REFILL_SECONDS."""
REFILL_SECONDS = 60.0
COUNT_SECONDS = 5.0
"""Minimum seconds between two writes of a count. Repetitions in between are counted and written later."""
REMEMBERED_MOST = 4096
MESSAGE_MOST = 1024
"""Longest message that the API server accepts, in characters."""


def reference(target: Mapping[str, Any]) -> Object:
    """Return the ObjectReference of an object (or of a reference to one), for ``involvedObject``."""
    if "metadata" not in target:
        return dict(target)
    metadata = target["metadata"]
    found = {
        "apiVersion": target.get("apiVersion", ""),
        "kind": target.get("kind", ""),
        "name": metadata["name"],
        "namespace": metadata.get("namespace", ""),
        "uid": metadata.get("uid", ""),
    }
    return {key: value for key, value in found.items() if value}


@dataclass
class _Reported:
    name: str = ""
    first: str = ""
    count: int = 0
    written: float = float("-inf")


@dataclass
class _MessageCount:
    since: float
    messages: set[str] = field(default_factory=set)


@dataclass
class _Bucket:
    tokens: float
    at: float


class Recorder:
    """Writes Events as one component."""

    def __init__(
        self, client: Client, component: str, instance: str, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """``component`` is for example ``understudy-operator``; ``instance`` is the pod that reports."""
        self._client, self._component, self._instance, self._clock = client, component, instance, clock
        self._reported: OrderedDict[tuple[str, ...], _Reported] = OrderedDict()
        self._similar: OrderedDict[tuple[str, ...], _MessageCount] = OrderedDict()
        self._buckets: OrderedDict[str, _Bucket] = OrderedDict()

    async def warning(self, target: Mapping[str, Any], reason: str, message: str) -> None:
        """Report something that needs attention, about an object or an ObjectReference."""
        await self._report(reference(target), "Warning", reason, message)

    async def normal(self, target: Mapping[str, Any], reason: str, message: str) -> None:
        """Report a normal event, about an object or an ObjectReference."""
        await self._report(reference(target), "Normal", reason, message)

    async def _report(self, about: Object, kind: Literal["Warning", "Normal"], reason: str, message: str) -> None:
        now = self._clock()
        message = one_line(message, MESSAGE_MOST)
        subject = (about.get("uid", ""), about.get("namespace", ""), about.get("kind", ""), about.get("name", ""))
        common = (*subject, kind, reason)
        if self._too_many(common, message, now):
            key: tuple[str, ...] = common
            message = f"(combined from similar events) {message}"[:MESSAGE_MOST]
        else:
            key = (*common, message)
        last = _remember(self._reported, key, _Reported)
        last.count += 1
        if now - last.written < COUNT_SECONDS or not self._allowed("/".join(subject), now):
            return
        last.written = now
        try:
            await self._write(last, about, kind, reason, message)
        except FAILURES as error:
            _logger.info("event %s about %s %s not written: %s", reason, subject[2], subject[3], error)

    def _too_many(self, common: tuple[str, ...], message: str, now: float) -> bool:
        similar = _remember(self._similar, common, lambda: _MessageCount(now))
        if now - similar.since > SIMILAR_SECONDS:
            similar.since, similar.messages = now, set()
        if message in similar.messages:
            return False
        if len(similar.messages) >= SIMILAR_MOST:
            return True
        similar.messages.add(message)
        return False

    def _allowed(self, subject: str, now: float) -> bool:
        bucket = _remember(self._buckets, subject, lambda: _Bucket(BURST, now))
        bucket.tokens = min(BURST, bucket.tokens + (now - bucket.at) / REFILL_SECONDS)
        bucket.at = now
        if bucket.tokens < 1:
            return False
        bucket.tokens -= 1
        return True

    async def _write(self, last: _Reported, about: Object, kind: str, reason: str, message: str) -> None:
        namespace = about.get("namespace") or "default"
        stamp = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        if last.name:
            change = {"count": last.count, "lastTimestamp": stamp, "message": message}
            try:
                await self._client.patch(EVENTS, namespace, last.name, change)
                return
            except ApiError as error:
                if not error.not_found:
                    raise
            last.count = 1  # the API server deletes events after an hour: this is a new one
        last.name, last.first = f"{about['name']}.{time.time_ns():x}{secrets.token_hex(2)}", stamp
        try:
            await self._client.create(EVENTS, namespace, self._event(last, about, namespace, kind, reason, message))
        except BaseException:
            last.name = ""
            raise

    def _event(self, last: _Reported, about: Object, namespace: str, kind: str, reason: str, message: str) -> Object:
        return {
            "apiVersion": "v1",
            "kind": "Event",
            "metadata": {"name": last.name, "namespace": namespace},
            "involvedObject": about,
            "type": kind,
            "reason": reason,
            "message": message,
            "count": last.count,
            "firstTimestamp": last.first,
            "lastTimestamp": last.first,
            "source": {"component": self._component},
            "reportingComponent": self._component,
            "reportingInstance": self._instance[:128],
        }


def _remember(known: OrderedDict[_K, _V], key: _K, make: Callable[[], _V]) -> _V:
    if key not in known:
        known[key] = make()
        if len(known) > REMEMBERED_MOST:
            known.popitem(last=False)
    known.move_to_end(key)
    return known[key]

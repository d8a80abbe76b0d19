"""Ends a proxy that another one has replaced, so that clients do not have two servers of one action for long.

A monitor's pod may outlive its deletion, on a node that counts as lost. Kubernetes starts another pod then, whose proxy serves the same
actions. A client takes the first answer, and the replaced proxy may answer that a goal is unknown, because agents refuse its requests.
Neither Kubernetes nor the operator can end a process on a node that they cannot reach. So the proxies of a workload announce themselves to
each other in the ROS graph, where their clients are too, and each one ends that another one replaces. After the node's return, discovery
may take longer than the API server's first answer. From that answer, the monitor learns that their pod was deleted.

A proxy that was replaced starts again, and serves once it has heard none for a while that replaces it: the other one may have been removed,
or the own monitor has learned of a later switch.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import secrets
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from understudy.api.protocol.agent_messages import GateEpoch
from understudy.clock import boot_id
from understudy.ros.runtime.served_node import ServedNode
from understudy.ros.runtime.text_topic import TextTopic

_logger = logging.getLogger(__name__)

PERIOD = 0.5
"""Seconds between two announcements."""

REPLACED_AFTER = 3
"""Announcements in a row after which another proxy replaces this one. A single one may be early: at a switch, the monitors of two proxies
learn the new epoch at different times."""

GONE_AFTER = 5.0
"""Seconds without an announcement of a proxy that replaces it after which a replaced proxy serves again."""

LONGEST = 512
"""Most characters of an announcement; so few cannot be nested too deeply for Python."""

OLD = 1e7
"""The age in seconds of a pod whose node has booted since. Such a pod is rather the one that was replaced."""

_SAME_AGE = 1.0
"""Seconds that two equal ages may seem to differ because of the network."""


@dataclass(frozen=True)
class Announcement:
    """One proxy, as it announces itself."""

    gate: GateEpoch
    """As the proxy's monitor reported it last."""
    age: float
    """Seconds since the pod's first proxy started. It is no time of day, because the clocks of two nodes may differ."""
    pod: str
    """Identifies the pod."""

    def replaces(self, other: Announcement) -> bool:
        """Whether the other proxy ends: this one knows a later switch of the same gate, or else this one's pod is newer."""
        if self.gate.workload_uid == other.gate.workload_uid and self.gate.number != other.gate.number:
            return self.gate.number > other.gate.number
        if abs(self.age - other.age) > _SAME_AGE:
            return self.age < other.age
        return self.pod > other.pod

    def to_wire(self) -> str:
        """Return the announcement as JSON."""
        return json.dumps([self.gate.workload_uid, self.gate.number, self.age, self.pod])

    @classmethod
    def from_wire(cls, text: str) -> Announcement:
        """Read the JSON. Raises ValueError if it is invalid."""
        # Any participant of the DDS domain can send it.
        match json.loads(text) if len(text) <= LONGEST else None:
            case [str(workload), int(number), float(age), str(pod)] if math.isfinite(age):
                return cls(GateEpoch(workload, number), age, pod)
        raise ValueError(f"not an announcement of an action proxy: {text[:80]}")


class Succession:
    """What one proxy knows of the others. Times are seconds since the node booted."""

    def __init__(self, folder: Path, now: float, boot: str) -> None:
        """``folder`` lasts as long as the pod; ``boot`` identifies the boot of the node."""
        self._mark = folder / "replaced"
        self._pod, self._started = _identity(folder / "pod.json", now, boot)
        self._heard = now
        self._greater: Counter[str] = Counter()

    def own(self, gate: GateEpoch, now: float) -> Announcement:
        """Return the announcement of this proxy."""
        return Announcement(gate, max(0.0, now - self._started), self._pod)

    def hear(self, other: Announcement, gate: GateEpoch | None, now: float) -> None:
        """Note an announcement. ``gate`` is what the own monitor reported; None if it has not, so that only the age counts."""
        if other.pod == self._pod:
            return
        is_greater = other.replaces(self.own(other.gate if gate is None else gate, now))
        if is_greater:
            self._greater[other.pod] += 1
            self._heard = now
        else:
            del self._greater[other.pod]  # a Counter has no error for those that it does not contain

    @property
    def is_replaced(self) -> bool:
        """Whether another proxy has replaced this one."""
        return max(self._greater.values(), default=0) >= REPLACED_AFTER

    def may_serve(self, now: float) -> bool:
        """Whether no proxy of this pod was replaced, or none that replaces it was heard for a while."""
        return not self._mark.exists() or now - self._heard >= GONE_AFTER

    def end(self) -> None:
        """Record for the pod's next process that this one was replaced."""
        with contextlib.suppress(OSError):  # the next process then serves until it hears the other one
            self._mark.touch()

    def serve(self) -> None:
        """Record that this proxy serves. Another one replaces it only by what it announces from now on."""
        self._greater.clear()
        with contextlib.suppress(OSError):
            self._mark.unlink(missing_ok=True)


def _identity(path: Path, now: float, boot: str) -> tuple[str, float]:
    """Return the identity of the pod, which its first proxy draws, and when that proxy started: long ago if the node has booted since."""
    pod, started = secrets.token_hex(8), now
    with contextlib.suppress(OSError, ValueError):
        match json.loads(path.read_text()):
            case [str(known), float(since), str(then)]:
                pod, started = known, since if then == boot else now - OLD
    with contextlib.suppress(OSError):  # the next process then counts as that of a newer pod
        path.write_text(json.dumps([pod, started, boot]))
    return pod, started


def _since_boot() -> float:
    """Return seconds since the node booted, with the time in which it slept. All containers of a node have the same."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class OtherProxies:
    """Announces a proxy to the others of its workload, and listens to them."""

    def __init__(self, served: ServedNode, workload: str, folder: Path) -> None:
        """``workload`` is its namespace and name. Raises TypeNotInstalled."""
        self._succession = Succession(folder, _since_boot(), boot_id())
        self._topic = TextTopic(served, f"/_understudy/tasks/of_{workload}", self._hear)
        self._gate: Callable[[], GateEpoch | None] = lambda: None

    async def until_serving(self, gate: Callable[[], GateEpoch | None], deleted: Callable[[], bool]) -> None:
        """Wait until this proxy may serve. ``gate`` returns what the monitor has reported, or None; ``deleted`` whether it reports that the
        pod was deleted."""
        self._gate = gate
        await self._topic.open()
        waits = False
        while deleted() or not self._succession.may_serve(_since_boot()):
            if not waits:
                _logger.info("another action proxy serves: this one waits until it is gone")
            waits = True
            await asyncio.sleep(PERIOD)
        self._succession.serve()

    async def until_replaced(self, gate: Callable[[], GateEpoch | None], deleted: Callable[[], bool]) -> None:
        """Announce this proxy until another one has replaced it, or its pod was deleted. ``gate`` returns None while not everything is
        served."""
        self._gate = gate
        while not self._succession.is_replaced and not deleted():
            if (present := gate()) is not None:
                self._topic.publish(self._succession.own(present, _since_boot()).to_wire())
            await asyncio.sleep(PERIOD)
        self._succession.end()
        _logger.warning("another action proxy has replaced this one, which ends")

    def _hear(self, text: str) -> None:
        with contextlib.suppress(ValueError):
            self._succession.hear(Announcement.from_wire(text), self._gate(), _since_boot())

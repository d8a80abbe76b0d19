"""The instances that samples are attributed to: those that exist, and those that are gone and may still send.

A process may outlive its pod's object. An instance that the gate once let through stays known until it was silent for long enough, also
after a restart of the monitor; any other one for a minute.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from understudy.clock import ClockSteps
from understudy.failover.interfaces import Instance
from understudy.failover.pinned import PinnedPod
from understudy.ros.rmw import MIDDLEWARE

REMEMBERED = 60.0
"""Seconds for which all samples are attributed to an instance that is gone, after its object was last seen or an output of it was heard.
After that, samples of other topics are not: its address may belong to another pod by then."""

SILENT_FOR = 600.0
"""Seconds of silence after which an instance that the gate let through, and that is gone, is no longer watched for."""


def host_at(address: str) -> bytes:
    """Return what identifies the writers of a host in their GIDs; empty if its address does not tell, as an IPv6 address."""
    try:
        return MIDDLEWARE.host_at(address)
    except ValueError:
        return b""


@dataclass
class KnownSender:
    """An instance. Times are Unix seconds."""

    name: str
    uid: str
    ip: str
    seen: float
    """When its object was last seen or an output of it was heard, or when this process first read that it was let through."""
    listed: bool
    """Whether its object exists."""
    pinned: bool = False
    """Whether the gate let it through."""
    attributed: bool = True
    """Whether all its samples are attributed to it, and not only those of outputs."""


@dataclass(frozen=True)
class OutputSender:
    """Who sent on an output."""

    topic: str
    name: str
    """The instance; or the nodes, if it is none."""
    uid: str
    """The UID of the instance; empty if the sender is none."""
    may_be: tuple[str, ...]
    """The UIDs of the instances that it may be: several if they cannot be distinguished. If it is none that is recognized: those with an
    IPv6 address."""
    last: float
    """When its last sample arrived, in Unix seconds."""
    host: bytes = b""
    """What identifies its host in GIDs."""
    interval: float = math.inf
    """Seconds that usually pass between two of its samples; infinite if that is not known.

    With fewer than three samples, that of another sender of this output: the instances of a workload send alike.
    """


@dataclass(frozen=True)
class Caller:
    """Who has a client of an output that is a service or an action. It could call, and nothing shows whether it does."""

    output: str
    may_be: tuple[str, ...]
    """The UIDs of the instances that it may be, as for :class:`OutputSender`."""


class KnownSenders:
    """The known instances of one workload."""

    def __init__(self) -> None:
        self._known: dict[str, KnownSender] = {}
        self._steps = ClockSteps()
        self._released: set[str] = set()
        """UIDs of pinned instances that were silent for long enough."""

    def update(
        self,
        instances: Sequence[Instance],
        pinned: Sequence[PinnedPod],
        heard: Callable[[str], float | None],
        now: float,
    ) -> None:
        """Follow the instances that exist and those that were let through.

        ``heard`` returns when an output was last heard from an IP (Unix seconds).
        """
        before, self._known = self._known, {}
        if step := self._steps.taken():
            for sender in before.values():
                sender.seen += step
        for instance in instances:
            if instance.ip:
                self._known[instance.uid] = KnownSender(instance.name, instance.uid, instance.ip, now, listed=True)
        taken = {sender.ip for sender in self._known.values()}
        pins = {pod.uid: pod for pod in pinned}
        self._released &= pins.keys()
        for uid, pod in pins.items():
            if uid in self._known:
                self._known[uid].pinned = True
            elif uid not in before and uid not in self._released:
                before[uid] = KnownSender(pod.name, uid, pod.ip, now, listed=False, attributed=False)
        for uid, sender in before.items():
            if uid in self._known:
                continue
            is_pinned = uid in pins
            is_replaced = sender.ip in taken  # what is heard from there is the successor's
            last_heard = heard(sender.ip) if not is_replaced else None
            # If the clock was just set, the time of a sample may still be of the clock before.
            sender.seen = max(sender.seen, min(last_heard or 0.0, now))
            silent = now - sender.seen
            if silent >= (SILENT_FOR if is_pinned and not is_replaced else REMEMBERED):
                self._released |= {uid} if is_pinned else set()
                continue
            sender.listed, sender.pinned = False, is_pinned
            sender.attributed = silent < REMEMBERED and (sender.attributed or last_heard is not None)
            self._known[uid] = sender

    def all(self) -> Sequence[KnownSender]:
        """Return the known instances."""
        return list(self._known.values())

    def named(self) -> Mapping[str, KnownSender]:
        """Return the known instances by name. One that is gone does not have the name of a successor, as in a StatefulSet."""
        found: dict[str, KnownSender] = {}
        for sender in sorted(self._known.values(), key=lambda one: (not one.listed, -one.seen)):
            found[sender.name if sender.name not in found else f"{sender.name} ({sender.uid})"] = sender
        return found

"""Judges, for as long as the workload lives, whether an instance reaches the robot that the gate does not let through.

The signs are samples on all outputs that are topics, by their senders' addresses, and packets that pass the gate, by the senders' UIDs.
Instances whose pods are being deleted or are gone count too: their processes may live on. If the packets of a former driver would not
count, discovery shows whether it could still call a service or an action (possible_senders.py).
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

from understudy.clock import ClockSteps
from understudy.failover.interfaces import Gate, Instance
from understudy.failover.pinned import PinnedPod
from understudy.kube.gates.base import Proof
from understudy.monitor.judge.possible_senders import PossibleSender, PossibleSenders
from understudy.monitor.notices import ConditionReport, LeaksCounted, Notices
from understudy.monitor.observe.robot.known_senders import Caller, KnownSender, OutputSender

LASTS = 1.0
"""Seconds between the first and the last sign of a sender after which it counts. The network may take that long to enforce a change."""

QUIET = 5.0
"""Seconds of silence after which a sender no longer reaches the robot; longer for one that sends less often. Agents probe once a second."""

PAUSES = 3.0
"""Pauses between two signs in a row without any after which a sender has ended, if that is longer than QUIET. Somebody who edits labels and
the gate lets an instance through for a moment, again and again: that is not one leak that lasts."""

MEMORY = 60.0
"""Seconds for which a sign is remembered, so that a slow sender counts too."""

LISTEN = 2.0
"""Seconds that a monitor listens before it opens a closed gate, if it is new or was cut off. Agents probe once a second."""

CUT_OFF = 1.0
"""Seconds without an answer of the API server after which this monitor's network may be down, and then its silence says nothing."""

PROBED = 1.0
"""Seconds between two test packets of an agent."""

PERIOD = 0.2
"""Seconds between two updates."""

CONDITION = "SoleDriver"

NO_GATE: ConditionReport = (
    "Unknown",
    "NoGate",
    "The gate object does not exist, so nothing says which instance may drive. The operator creates it again.",
)

UNKNOWN_SENDER = "UnknownSender"
"""The reason of conditions while a sender reaches the robot that is no known instance."""

PROBES = "test packets"


@dataclass(frozen=True)
class Sign:
    """A sign that somebody reaches the robot. Times are Unix seconds."""

    name: str
    """The instance; or the node, for a sender that is no known instance."""
    uid: str
    """The UID of its pod; empty for a sender that cannot be attributed."""
    via: str
    """The topic, or PROBES."""
    last: float
    is_former: bool = False
    """Whether the gate let it through before, or its pod is being deleted or is gone: a further deletion may not end it."""
    host: bytes = b""
    """What identifies its host in the GIDs of its samples, for a sender that cannot be attributed."""
    pod_uid: str = ""
    """The UID in its packets, for a sender that cannot be attributed."""
    interval: float = math.inf
    """Seconds that usually pass between two of them; infinite if that is not known."""


@dataclass(frozen=True)
class Track:
    """The signs of one sender since it is not let through."""

    sign: Sign
    first: float
    gap: float = 0.0
    """The longest time between two of them."""
    least: float = math.inf
    """The shortest time between two of them that is known; infinite if none is."""

    @classmethod
    def begin(cls, sign: Sign) -> Track:
        """Return the track of a sender's first sign."""
        return cls(sign, sign.last, least=sign.interval)

    @property
    def period(self) -> float:
        """Seconds in which a sender is heard again that has not ended. One that sends so often and paused for long had ended."""
        return min(self.gap, PAUSES * self.least)

    @property
    def lasts(self) -> bool:
        """Whether there were signs for longer than the network may need to enforce a change."""
        return self.sign.last - self.first >= LASTS

    def is_heard(self, now: float) -> bool:
        """Whether the sender still reaches the robot."""
        return now - self.sign.last < max(QUIET, 2 * self.period)

    def goes_on(self, now: float) -> bool:
        """Whether the sender was heard so recently that it has probably not ended."""
        return now - self.sign.last < max(LASTS, 2 * self.period)

    def was_over(self, again: float) -> bool:
        """Whether the sender had ended when it was heard again: it was silent for much longer than one that sends so often."""
        return again - self.sign.last >= max(QUIET, PAUSES * self.least)

    def with_sign(self, sign: Sign) -> Track:
        """Return the track with one more sign, or with the same one again."""
        gap = sign.last - self.sign.last
        least = min(self.least, sign.interval, gap if gap > 0 else math.inf)
        return replace(self, sign=sign, gap=max(self.gap, gap), least=least)

    def moved(self, step: float) -> Track:
        """Return this track after the clock was set by ``step`` seconds."""
        return replace(self, sign=replace(self.sign, last=self.sign.last + step), first=self.first + step)


Tracks = Mapping[tuple[str, str], Track]
"""The tracks by UID (or name) and by how the sender reaches the robot."""


def tracked(
    before: Tracks,
    signs: Sequence[Sign],
    fenced: Mapping[str, float],
    *,
    let_through: Collection[str],
    now: float,
    switched: float = 0.0,
) -> Tracks:
    """Return the tracks with these signs of senders that are not let through.

    ``fenced`` has the time at which the gate stopped letting an instance through, by UID; ``let_through`` the UIDs of those it names, and
    ``switched`` since when it names them.
    """
    found = {
        key: one
        for key, one in before.items()
        if one.sign.uid not in let_through
        and 0 <= now - one.sign.last < MEMORY
        and fenced.get(one.sign.uid, 0.0) < one.sign.last
    }
    for sign in signs:
        if sign.uid in let_through or not fenced.get(sign.uid, 0.0) < sign.last <= now or now - sign.last >= MEMORY:
            continue
        key = (sign.uid or sign.name, sign.via)
        known = found.get(key) or _as_stranger(found, sign, switched)
        found[key] = Track.begin(sign) if known is None or known.was_over(sign.last) else known.with_sign(sign)
    return found


def _as_stranger(tracks: dict[tuple[str, str], Track], sign: Sign, switched: float) -> Track | None:
    """Remove and return the track of an instance from the time when it was unknown, as a pod is that this monitor's watch has not shown.

    Until the gate was switched, it may have been let through: by its name, or by another monitor.
    """
    key = next((key for key, one in tracks.items() if sign.uid and one.sign.pod_uid == sign.uid), None)
    found = tracks.pop(key) if key is not None else None
    if found is None or found.sign.last < switched:
        return None
    return replace(found, first=max(found.first, switched))


@dataclass(frozen=True)
class Leak:
    """An instance that reaches the robot although the gate does not let it through."""

    name: str
    uid: str
    is_former: bool
    """As for :class:`Sign`."""
    first: float
    """When it was first heard, in Unix seconds."""
    goes_on: bool
    """Whether it was heard so recently that it has probably not ended."""
    silent: float = field(compare=False)
    """Seconds since it was last heard."""


def leaks(tracks: Tracks, now: float) -> tuple[Leak, ...]:
    """Return the instances that reach the robot and are not let through, by name."""
    heard = [one for one in tracks.values() if one.sign.uid and one.lasts and one.is_heard(now)]
    still = {one.sign.uid for one in heard if one.goes_on(now)}
    last: dict[str, float] = {}
    for one in heard:
        last[one.sign.uid] = max(last.get(one.sign.uid, -math.inf), one.sign.last)
    found = {
        one.sign.uid: Leak(
            one.sign.name, one.sign.uid, one.sign.is_former, one.first, one.sign.uid in still, now - last[one.sign.uid]
        )
        for one in sorted(heard, key=lambda one: -one.first)
    }
    return tuple(sorted(found.values(), key=lambda leak: leak.name))


def strangers(tracks: Tracks, now: float) -> tuple[str, ...]:
    """Return the senders that reach the robot and are no known instances, each with how it does."""
    heard = (one.sign for one in tracks.values() if not one.sign.uid and one.lasts and one.is_heard(now))
    return tuple(sorted(f"{sign.via} by {sign.name}" for sign in heard))


def judge(tracks: Tracks, active: str, now: float, possible: Sequence[PossibleSender] = ()) -> ConditionReport:
    """Return status, reason and message of the condition SoleDriver. ``active`` is the pod that the gate names, or empty."""
    heard = [one for one in tracks.values() if one.lasts and one.is_heard(now)]
    if found := leaks(tracks, now):
        ways = {leak.uid: sorted(one.sign.via for one in heard if one.sign.uid == leak.uid) for leak in found}
        listed = "; ".join(f"{leak.name} by {', '.join(ways[leak.uid])}" for leak in found)
        return (
            "False",
            "SeveralDrivers" if active else "FormerDriver",
            f"Instances reach the robot although the gate does not let them through: {listed}. "
            + (f"The gate lets through {active}." if active else "The gate is closed until they are silent."),
        )
    texts: list[str] = []
    unknown = strangers(tracks, now)
    if unknown:
        texts.append(
            f"A sender that is no known instance of this workload reaches the robot: {'; '.join(unknown)}. It is a second driver, unless "
            "it is a tool."
        )
    if possible:
        listed = "; ".join(f"{', '.join(one.outputs)} by {one.name}" for one in possible)
        texts.append(
            f"Discovery still finds instances that the gate does not let through, and that may call the robot: {listed}. This monitor "
            "knows no agent that sends test packets for them, so nothing shows whether the gate holds them back."
        )
    if texts:
        return "Unknown", UNKNOWN_SENDER if unknown else "PossibleSender", " ".join(texts)
    return "True", "NoOtherSender", "The monitor hears nobody whom the gate does not let through."


class Outputs(Protocol):
    """The samples on the outputs, as far as a sole driver depends on them."""

    def output_senders(self) -> Sequence[OutputSender]:
        """Return who sent on each output that is a topic, and when last."""

    def known_senders(self) -> Sequence[KnownSender]:
        """Return the instances that exist, and those that are gone and may still send."""

    def callers(self) -> Sequence[Caller]:
        """Return which instances have a client of an output that is a service or an action."""


class SoleDriver:
    """Judges and reports whether one workload has a sole driver. Times are Unix seconds."""

    def __init__(self, gate: Gate, probes: Proof, outputs: Outputs, notices: Notices) -> None:
        self._gate, self._probes, self._outputs, self._notices = gate, probes, outputs, notices
        self._tracks: Tracks = {}
        self._possible = PossibleSenders(probes, outputs)
        self._fenced: dict[str, float] = {}
        self._through: frozenset[str] = frozenset()
        self._names: frozenset[str] = frozenset()
        """The names of those that the gate lets through: it selects pods by name."""
        self._epoch = 0
        self._switched = self._updated = 0.0
        self._steps = ClockSteps()
        self._listening_since = time.monotonic()
        self.leaks: Sequence[Leak] = ()
        """The instances that reach the robot and are not let through."""
        self.strangers: Sequence[str] = ()
        """As :func:`strangers`, as of the last update."""
        self.rightful = ""
        """The UID of the instance for which the gate was closed because of a leak; empty if it was not."""

    def update(self, instances: Sequence[Instance], now: float) -> None:
        """Take the signs up to now, and report what they mean, also during a recovery.

        A planned switchover leaves the workload Healthy, which it is not while somebody else drives it too.
        """
        is_other = self.track(instances, now)
        found = leaks(self._tracks, now)
        changed, self.leaks = found != self.leaks, found
        self.strangers = strangers(self._tracks, now)
        if changed:
            self._notices.add(LeaksCounted(len(found)))
            is_other = True
        if is_other:
            self.report(now)
        if (found or self.strangers) and self._notices.status.health == "Healthy":
            self._notices.set(health="Degraded")

    def track(self, instances: Sequence[Instance], now: float) -> bool:
        """Take the signs up to now, at most every PERIOD seconds. Returns whether the gate has changed."""
        self._follow_clock()
        since = self._gate.unanswered_since
        if since is not None and asyncio.get_running_loop().time() - since >= CUT_OFF:
            self._listening_since = time.monotonic()
        state = self._gate.state
        through = frozenset(uid for uid in (state.active_uid, state.admitted_uid) if uid)
        is_other = through != self._through
        if is_other:
            self.rightful = "" if through else self.rightful
            names = frozenset(name for name in (state.active, state.admitted) if name)
            # The successor of a pod that is gone may have its name, as in a StatefulSet, and was let through too.
            was_let_through = self._through | {i.uid for i in instances if i.name in self._names - names}
            if (
                state.epoch > self._epoch + 1
            ):  # other monitors have switched the gate several times, and this one did not see for whom
                was_let_through |= {pod.uid for pod in state.pinned}
            self._epoch, self._switched = state.epoch, now
            self._fenced |= dict.fromkeys(was_let_through - through, now)
            self._through, self._names = through, names
            there = {i.uid for i in instances} | {one.uid for one in self._outputs.known_senders()}
            self._fenced = {uid: at for uid, at in self._fenced.items() if uid not in through and uid in there}
        elif 0 <= now - self._updated < PERIOD:
            return False
        self._updated = now
        known = {one.uid: one for one in self._outputs.known_senders()}
        leaving = {i.uid for i in instances if i.terminating}
        gone = leaving | {uid for uid, one in known.items() if not one.listed}
        drove = self._fenced.keys() | {uid for uid, one in known.items() if one.pinned}
        self._possible.update([one for uid, one in known.items() if uid in drove], gone, through, now)
        signs = self._signs(instances, known, drove | gone, now)
        self._tracks = tracked(self._tracks, signs, self._fenced, let_through=through, now=now, switched=self._switched)
        return is_other

    def _follow_clock(self) -> None:
        """Move all times if the clock was set."""
        if step := self._steps.taken():
            self._updated += step
            self._switched += step
            self._fenced = {uid: at + step for uid, at in self._fenced.items()}
            self._tracks = {key: one.moved(step) for key, one in self._tracks.items()}
            self._possible.shift(step)

    def _signs(
        self, instances: Sequence[Instance], known: Mapping[str, KnownSender], former: Collection[str], now: float
    ) -> list[Sign]:
        found = [
            Sign(
                one.name,
                one.uid,
                one.topic,
                one.last,
                one.uid in former,
                b"" if one.uid else one.host,
                interval=one.interval,
            )
            for one in self._outputs.output_senders()
            if self._through.isdisjoint(one.may_be)
        ]
        names = {uid: one.name for uid, one in known.items()} | {i.uid: i.name for i in instances}
        passed = {
            uid: self._probes.last(uid) for uid in {*names, *self._probes.heard_since(now - MEMORY)} - self._through
        }
        for uid, last in passed.items():
            if last is not None and uid in names:
                found.append(Sign(names[uid], uid, PROBES, last, uid in former, interval=PROBED))
            elif last is not None:
                found.append(Sign(f"the pod with UID {uid}", "", PROBES, last, pod_uid=uid, interval=PROBED))
        return found

    def passing(self, now: float) -> Sequence[str]:
        """Return the instances whose test packets still pass the gate, for longer than the network may need to enforce a change."""
        tracks = (one for one in self._tracks.values() if one.sign.uid and one.sign.via == PROBES)
        return sorted(one.sign.name for one in tracks if one.lasts and one.goes_on(now))

    def may_be_driven(self, now: float) -> bool:
        """Return whether an instance that drove before may still drive, so that the gate must not open for another one.

        It was heard of late, or this monitor has not listened for long enough since it can hear it, or its pod is gone and discovery may
        still forget its clients.
        """
        is_deaf = self._gate.unanswered_since is not None or time.monotonic() - self._listening_since < LISTEN
        if is_deaf and any(pod.uid != self.rightful for pod in self._gate.state.pinned):
            return True
        signs = (one.sign for one in self._tracks.values() if one.is_heard(now))
        if any(sign.uid and sign.is_former and sign.uid != self.rightful for sign in signs):
            return True
        return self._possible.may_drive(now, self.rightful)

    def identities(self) -> tuple[PinnedPod, ...]:
        """Return by what a new monitor recognizes the instances that leak, whether the gate ever let them through or not."""
        known = {one.uid: one for one in self._outputs.known_senders()}
        return tuple(
            PinnedPod(name=leak.name, uid=leak.uid, ip=known[leak.uid].ip) for leak in self.leaks if leak.uid in known
        )

    def verified(self, at: float) -> None:
        """Note that the active instance was the only known one that drove at a time: what was heard of others before has ended."""
        self._tracks = {key: one for key, one in self._tracks.items() if one.sign.last > at or not one.sign.uid}

    def close_for(self, active_uid: str) -> None:
        """Note that the gate is being closed for this instance because of a leak, so that it opens for it again first."""
        self.rightful = active_uid

    def unknown(self, now: float) -> tuple[set[bytes], set[str]]:
        """Return the hosts and the pods' UIDs of senders that are no known instances."""
        signs = [one.sign for one in self._tracks.values() if not one.sign.uid and one.is_heard(now)]
        return {sign.host for sign in signs if sign.host}, {sign.pod_uid for sign in signs if sign.pod_uid}

    def report(self, now: float) -> None:
        """Report the judgement."""
        judged = NO_GATE
        if self._gate.exists:
            judged = judge(self._tracks, self._gate.state.active, now, self._possible.lasting(now))
        if self._notices.condition(CONDITION, *judged) and judged[0] != "True":
            self._notices.event("Warning", judged[1], judged[2])

"""Selects the messages, parameters and lifecycle states of an instance from the time when it was last healthy.

State that arrived while the health tree did not hold is never kept. Kept state may still be bad, because a failure begins before it is
noticed. So several versions are held. After a failure, the newest one is selected that had been good for the policy's margin when the
failure began. The older the versions, the fewer are held: for each moment in the past there is one that is not much older, however late a
failure is noticed. Times are Unix seconds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

from understudy.api.base import seconds
from understudy.api.kinds.state_spec import KeptTopic, State
from understudy.api.protocol.kept_state import (
    LARGEST,
    KeptSample,
    KeptState,
    LifecycleState,
    NotRestored,
    ParameterValues,
)

Kind = Literal["Topic", "Parameters", "Lifecycle"]

Standing = Literal["", "instance", "robot"]
"""Who holds a message for late joiners, so that it is valid until the next one arrives; empty if nobody does."""

Trouble = Literal["NeverCame", "TooOld", "TooBig", "NotWatched", "NotAsked", "NotCarried"]
"""Why something that should be kept is not, in the order in which the reasons are reported."""

SPREAD = 0.25
"""Distance of two versions as a fraction of their age. It limits how much older than requested the selected version is."""

LAG = 10.0
"""Maximum seconds from a failure until it is noticed, if there is no room for many versions."""

PATIENCE = 10.0
"""Seconds of health after which state that never arrived is reported as missing, and not waited for any more."""

SQUEEZED = 60.0
"""Seconds for which a message that did not fit is reported, after the last such message."""


class Key(NamedTuple):
    """An item of state that is kept."""

    kind: Kind
    name: str
    """The topic or node."""

    @property
    def label(self) -> str:
        """The name in reports; a node may have both parameters and a lifecycle state."""
        return self.name if self.kind == "Topic" else f"{self.name} ({self.kind.lower()})"


@dataclass(frozen=True)
class Version:
    """The value of an item at one time."""

    taken_at: float
    """When the message was received (or sent, if the publisher held it for late joiners), or the node was asked."""
    good_from: float
    """Since when it is known to be the value of a healthy instance."""
    data: bytes
    type: str = ""
    """Message type of a topic."""


@dataclass(frozen=True)
class Entry:
    """The status of one item that should be kept."""

    key: Key
    taken_at: float | None
    """When the version that would be restored now was captured; None if there is none."""
    bytes: int
    trouble: Trouble | None = None
    message: str = ""


@dataclass
class _Item:
    """The versions of one item, oldest first."""

    max_age: float = math.inf
    versions: list[Version] = field(default_factory=list)
    pending: tuple[Version, Standing] | None = None
    """The version that arrived since the last verdict, and who holds it for late joiners."""
    squeezed: tuple[float, str] | None = None
    """When a message last did not fit, and the text that reports it."""

    size: int = 0
    """Bytes held. Consecutive versions with the same data share it."""

    def count(self) -> None:
        """Calculate the size again."""
        self.size, before = 0, b""
        for version in self.versions:
            if version.data is not before:
                self.size += len(version.data)
            before = version.data

    def before(self, moment: float) -> Version | None:
        """Return the newest version that was good at a moment."""
        return next((v for v in reversed(self.versions) if v.good_from <= moment), None)


class Keeper:
    """Keeps the state that a policy's ``state`` names, within its bounds.

    After each evaluation, call :meth:`offer` for what has arrived, then :meth:`judge` with the verdict of the same evaluation.
    """

    def __init__(self, state: State | None = None) -> None:
        self._state = State()
        self._margin = self._period = 0.0
        self._items: dict[Key, _Item] = {}
        self._topics: dict[str, KeptTopic] = {}
        self._healthy_since: float | None = None
        self._notes: dict[Key, tuple[Trouble, str]] = {}
        self.revision = 0
        """Grows whenever the kept state changes."""
        if state is not None:
            self.follow(state)

    def follow(self, state: State) -> None:
        """Keep only the state that this policy names. Versions of items that the old policy named too stay."""
        if state == self._state and self._items:
            return
        self._state = state
        self._margin, self._period = seconds(state.margin), seconds(state.period)
        self._topics = {topic.topic: topic for topic in state.keep}
        ages = {Key("Topic", topic.topic): seconds(topic.max_age) for topic in state.keep}
        ages |= {Key("Parameters", parameters.node): math.inf for parameters in state.parameters}
        ages |= {Key("Lifecycle", node): math.inf for node in state.lifecycle}
        self._items = {key: self._items.get(key, _Item()) for key in ages}
        for key, item in self._items.items():
            item.max_age = ages[key]
            item.versions = [v for v in item.versions if self._is_wanted(key, v)]
            item.count()
        self._fit(math.inf)
        self.revision += 1

    def _is_wanted(self, key: Key, version: Version) -> bool:
        """Return whether a version still has the type, or the parameters, that the policy names."""
        if key.kind == "Topic":
            return self._topics[key.name].type in (None, version.type)
        if key.kind == "Parameters":
            wanted = next(set(p.names) for p in self._state.parameters if p.node == key.name)
            return set(json.loads(version.data)) <= wanted
        return True

    @property
    def keys(self) -> Collection[Key]:
        """The items that should be kept."""
        return self._items.keys()

    @property
    def healthy_since(self) -> float | None:
        """Since when the health tree has held without a break."""
        return self._healthy_since

    # -- taking in --------------------------------------------------------------------------------------------------

    def offer(
        self, key: Key, data: bytes, *, taken_at: float, received_at: float, type: str = "", standing: Standing = ""
    ) -> None:
        """Record a version from the active instance or the robot. The next verdict determines whether it is kept."""
        item = self._items.get(key)
        if item is not None:
            item.pending = (Version(taken_at, received_at, data, type), standing)

    def judge(self, health: Literal["Starting", "Healthy", "Failed"], now: float) -> None:
        """Keep the versions that arrived since the last verdict, if the instance was healthy then and still is."""
        if health == "Failed":
            self.forget_offers()
        elif health == "Starting":
            self._healthy_since = None
            self._forget("")
        else:
            if self._healthy_since is None:
                self._healthy_since = now
            for key, item in self._items.items():
                if item.pending is not None:
                    (version, standing), item.pending = item.pending, None
                    if version.good_from >= self._healthy_since:
                        self._add(key, item, version, now)
                    elif standing:
                        # It was sent while the instance started, and was still valid when the instance was first healthy.
                        self._add(key, item, replace(version, good_from=now), now)

    def forget_offers(self) -> None:
        """Discard versions that are not kept yet, because the instance failed or another one is active.

        Messages that the robot itself holds for late joiners stay: they are valid for the next instance as well.
        """
        self._healthy_since = None
        self._forget("", "instance")

    def _forget(self, *standings: Standing) -> None:
        for item in self._items.values():
            if item.pending is not None and item.pending[1] in standings:
                item.pending = None

    def _add(self, key: Key, item: _Item, version: Version, now: float) -> None:
        most = min(self._state.max_bytes, LARGEST)
        if len(version.data) > most:
            item.squeezed = (now, f"a message of {len(version.data)} bytes is more than the {most} that can be kept")
            return
        versions = item.versions
        if versions:
            last = versions[-1]
            if version.good_from < last.good_from:
                return  # the clock was set back
            if version.data == last.data and version.type == last.type:
                if version.taken_at <= last.taken_at:
                    return  # the same message, sent to a late joiner again
                version = replace(version, data=last.data)
        # The last version is always the last that arrived; the one before it is at least a period older.
        if len(versions) > 1 and versions[-1].good_from - versions[-2].good_from < self._period:
            versions[-1] = version
        else:
            versions.append(version)
            self._thin(item, now)
        item.count()
        self.revision += 1
        if self._fit(now, item) and item.squeezed is not None and now - item.squeezed[0] > SQUEEZED:
            item.squeezed = None

    def _thin(self, item: _Item, now: float) -> None:
        """Drop versions whose neighbours are close enough for their age, and versions that would always be too old to restore."""
        versions = item.versions
        kept = versions[-2:]
        for version, older in _pairs(reversed(versions[:-2])):
            newest_kept = kept[0]
            if older is None or newest_kept.good_from - older.good_from > max(
                self._period, SPREAD * (now - newest_kept.good_from)
            ):
                kept.insert(0, version)
        while len(kept) > 1 and now - kept[1].taken_at > item.max_age:
            kept.pop(0)
        item.versions = kept

    def _fit(self, now: float, newcomer: _Item | None = None) -> bool:
        """Drop versions until the kept state fits. Returns whether the newest version of every item is left."""
        untouched = True
        while (total := sum(item.size for item in self._items.values())) > self._state.max_bytes:
            by_size = sorted(self._items.values(), key=lambda item: -item.size)
            safe = now - LAG - self._margin
            if ripe := next((i for i in by_size if len(i.versions) > 1 and i.versions[1].good_from <= safe), None):
                ripe.versions.pop(0)
                ripe.count()
            elif dense := next((i for i in by_size if len(i.versions) > 3), None):
                # The second oldest stays until it can replace the oldest, which would otherwise stay for ever.
                dense.versions.pop(-2)
                dense.count()
            else:
                largest = next((i for i in by_size if len(i.versions) > 1), newcomer or by_size[0])
                gone = largest.versions.pop()
                largest.count()
                message = (
                    f"a message of {len(gone.data)} bytes did not fit: {total} bytes would have been kept, and "
                    f"state.maxBytes is {self._state.max_bytes}"
                )
                # Without a newcomer the policy has changed: the next message that fits ends this report.
                largest.squeezed = (now if newcomer else -math.inf, message)
                untouched = False
        return untouched

    # -- giving out -------------------------------------------------------------------------------------------------

    def select(self, onset: float) -> KeptState:
        """Return the state for the instance that takes over after a failure with this onset, and what cannot be restored."""
        samples: list[KeptSample] = []
        parameters: list[ParameterValues] = []
        states: list[LifecycleState] = []
        left_out: list[NotRestored] = []
        for key, item in self._items.items():
            version = item.before(onset - self._margin)
            if version is None:
                left_out.append(NotRestored(key.label, self._why_none(key, item), failed=False))
            elif onset - version.taken_at > item.max_age:
                left_out.append(NotRestored(key.label, self._why_old(key, onset - version.taken_at), failed=False))
            elif key.kind == "Topic":
                topic = self._topics[key.name]
                samples.append(
                    KeptSample(
                        topic=key.name,
                        type=version.type,
                        taken_at=version.taken_at,
                        data=version.data,
                        to=topic.restore_to or "",
                        stamp=topic.stamp,
                        confirm=topic.confirm or "",
                    )
                )
            elif key.kind == "Parameters":
                parameters.append(ParameterValues(key.name, json.loads(version.data), version.taken_at))
            else:
                states.append(LifecycleState(key.name, version.data.decode(), version.taken_at))
        return KeptState(tuple(samples), tuple(parameters), tuple(states), tuple(left_out))

    def awaited(self, now: float) -> list[str]:
        """Return the items of which nothing can be restored yet that the present healthy instance sent or reported, and that may soon be
        there."""
        since = self._healthy_since
        if since is None or now - since > PATIENCE:
            return []
        best = ((key, item.before(now - self._margin)) for key, item in self._items.items())
        return [key.label for key, version in best if version is None or version.good_from < since]

    def note(self, notes: Mapping[Key, tuple[Trouble, str]]) -> None:
        """Set why items cannot be captured. The reason NeverCame is reported only if no version is kept."""
        self._notes = dict(notes)

    def entries(self, now: float) -> list[Entry]:
        """Return the status of every item that should be kept, as if the instance failed now."""
        found: list[Entry] = []
        for key, item in self._items.items():
            version = item.before(now - self._margin)
            trouble: Trouble | None = None
            message = ""
            if item.squeezed is not None:
                trouble, message = "TooBig", f"{key.label}: {item.squeezed[1]}"
            elif key in self._notes and self._notes[key][0] != "NeverCame":
                trouble, message = self._notes[key]
            elif version is None and not item.versions:
                if self._healthy_since is not None and now - self._healthy_since > PATIENCE:
                    trouble, message = "NeverCame", f"{key.label}: {self._why_none(key, item)}"
            elif version is not None and now - version.taken_at > item.max_age:
                trouble = "TooOld"
                message = f"{key.label}: what is kept is older than maxAge ({self._topics[key.name].max_age}), it would not be restored"
            found.append(
                Entry(
                    key,
                    version.taken_at if version is not None else None,
                    len(version.data) if version is not None else 0,
                    trouble,
                    message,
                )
            )
        return found

    def _why_none(self, key: Key, item: _Item) -> str:
        if item.versions:
            return (
                f"everything that was captured is from after the failure, or from the time before it that state.margin excludes "
                f"({self._state.margin})"
            )
        if key in self._notes:
            return self._notes[key][1].removeprefix(f"{key.label}: ")
        if key.kind == "Topic":
            return "no message came from the active instance or from the robot while the instance was healthy"
        return "the active instance did not answer while it was healthy"

    def _why_old(self, key: Key, age: float) -> str:
        most = self._topics[key.name].max_age
        return f"what is kept is {_age(age)} old, more than maxAge ({most})"

    # -- over time --------------------------------------------------------------------------------------------------

    def shift(self, step: float) -> None:
        """Adjust all times after the clock was set by ``step`` seconds, so that ages stay the same."""
        if self._healthy_since is not None:
            self._healthy_since += step
        for item in self._items.values():
            item.versions = [_moved(version, step) for version in item.versions]
            if item.pending is not None:
                item.pending = (_moved(item.pending[0], step), item.pending[1])
            if item.squeezed is not None:
                item.squeezed = (item.squeezed[0] + step, item.squeezed[1])
        self.revision += 1

    def versions(self) -> dict[Key, Sequence[Version]]:
        """Return all kept versions by item, oldest first."""
        return {key: tuple(item.versions) for key, item in self._items.items() if item.versions}

    def held(self) -> dict[Key, Sequence[Version]]:
        """Return all kept versions, and those that the next verdict may add."""
        return {
            key: (*item.versions, *((item.pending[0],) if item.pending is not None else ()))
            for key, item in self._items.items()
        }

    def adopt(self, versions: Mapping[Key, Iterable[Version]], now: float) -> None:
        """Continue with the versions of another process that are newer than those here. Items that the policy does not name are left out.

        A version from the future was captured with a wrong clock, so that its age is unknown. It is left out too.
        """
        for key, old in versions.items():
            item = self._items.get(key)
            if item is None:
                continue
            usable = (v for v in old if v.taken_at <= now and v.good_from <= now and self._is_wanted(key, v))
            last = item.versions[-1].good_from if item.versions else None
            newer = sorted((v for v in usable if last is None or v.good_from > last), key=lambda v: v.good_from)
            item.versions += newer
            self._share(item)
            if newer and last is not None:  # like versions that arrive one by one
                self._thin(item, now)
            item.count()
        self._fit(now)
        self.revision += 1

    def _share(self, item: _Item) -> None:
        for i in range(1, len(item.versions)):
            if item.versions[i].data == item.versions[i - 1].data:
                item.versions[i] = replace(item.versions[i], data=item.versions[i - 1].data)


def _pairs(versions: Iterable[Version]) -> Iterator[tuple[Version, Version | None]]:
    """Yield each version with the one that follows; the last with None."""
    before: Version | None = None
    for version in versions:
        if before is not None:
            yield before, version
        before = version
    if before is not None:
        yield before, None


def _moved(version: Version, step: float) -> Version:
    return replace(version, taken_at=version.taken_at + step, good_from=version.good_from + step)


def _age(age: float) -> str:
    return f"{age:.1f} s" if age < 120 else f"{age / 60:.0f} min" if age < 7200 else f"{age / 3600:.0f} h"

"""Which of an instance's messages, parameters and lifecycle states is the last healthy one.

What was taken while the health tree did not hold is never kept. What is kept is not yet good: a failure begins before
it is noticed, so several versions are held, and at a failure the newest is chosen that had been good for the policy's
margin when the failure began. The older versions are, the fewer: for each moment in the past there is one that is not
much older, however late a failure is noticed. Times are Unix seconds.
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
"""Whether a message is held for late joiners, so that it holds until the next one comes, and by whom."""

Trouble = Literal["NeverCame", "TooOld", "TooBig", "NotWatched", "NotAsked", "NotCarried"]
"""Why something that should be kept is not, in the order in which the reasons are reported."""

SPREAD = 0.25
"""Distance of two versions, as a part of their age: how much older than asked for the chosen one may be."""

LAG = 10.0
"""Maximum seconds from a failure until it is noticed, if there is no room for many versions."""

PATIENCE = 10.0
"""Seconds of health after which something that never came is said to be missing."""

SQUEEZED = 60.0
"""Seconds for which it is said that a message didn't fit, after the last one that didn't."""


class Key(NamedTuple):
    """One thing that is kept."""

    kind: Kind
    name: str
    """Topic, or node."""

    @property
    def label(self) -> str:
        """What it is called in reports; a node may have both parameters and a lifecycle state."""
        return self.name if self.kind == "Topic" else f"{self.name} ({self.kind.lower()})"


@dataclass(frozen=True)
class Version:
    """What it was at one time."""

    taken_at: float
    """When the message was received (or sent, where the publisher held it for late joiners), or the node asked."""
    good_from: float
    """From when on it is known to have been that of a healthy instance."""
    data: bytes
    type: str = ""
    """Message type of a topic."""


@dataclass(frozen=True)
class Entry:
    """How it stands with one thing that is kept."""

    key: Key
    taken_at: float | None
    """When that was taken which would be restored now."""
    bytes: int
    trouble: Trouble | None = None
    message: str = ""


@dataclass
class _Item:
    """The versions of one thing, oldest first."""

    max_age: float = math.inf
    versions: list[Version] = field(default_factory=list)
    pending: tuple[Version, Standing] | None = None
    """What came since the last verdict, and whether its publisher holds it for late joiners."""
    squeezed: tuple[float, str] | None = None
    """When a message last didn't fit, and what is said of it."""

    size: int = 0
    """Bytes held; versions that follow each other and are the same share them."""

    def count(self) -> None:
        """Calculate the size again."""
        self.size, before = 0, b""
        for version in self.versions:
            if version.data is not before:
                self.size += len(version.data)
            before = version.data

    def before(self, moment: float) -> Version | None:
        """The newest version that was good at a moment."""
        return next((v for v in reversed(self.versions) if v.good_from <= moment), None)


class Keeper:
    """Holds what a policy's ``state`` asks for, within its bounds.

    After each evaluation: :meth:`offer` what has arrived, then :meth:`judge` with the verdict of the same evaluation.
    """

    def __init__(self, state: State | None = None) -> None:
        self._state = State()
        self._margin = self._period = 0.0
        self._items: dict[Key, _Item] = {}
        self._topics: dict[str, KeptTopic] = {}
        self._healthy_since: float | None = None
        self._notes: dict[Key, tuple[Trouble, str]] = {}
        self.revision = 0
        """Grows whenever something else is kept than before."""
        if state is not None:
            self.follow(state)

    def follow(self, state: State) -> None:
        """Keep this and nothing else from now on. What both the old and the new policy keep stays."""
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
        """Whether a version is still of the type, or of the parameters, that the policy names."""
        if key.kind == "Topic":
            return self._topics[key.name].type in (None, version.type)
        if key.kind == "Parameters":
            wanted = next(set(p.names) for p in self._state.parameters if p.node == key.name)
            return set(json.loads(version.data)) <= wanted
        return True

    @property
    def keys(self) -> Collection[Key]:
        """All that should be kept."""
        return self._items.keys()

    @property
    def healthy_since(self) -> float | None:
        """Since when the health tree has held without a break."""
        return self._healthy_since

    # -- taking in --------------------------------------------------------------------------------------------------

    def offer(
        self, key: Key, data: bytes, *, taken_at: float, received_at: float, type: str = "", standing: Standing = ""
    ) -> None:
        """Something of the instance in control, or of the robot, has come; the next verdict says whether it is kept."""
        item = self._items.get(key)
        if item is not None:
            item.pending = (Version(taken_at, received_at, data, type), standing)

    def judge(self, health: Literal["Starting", "Healthy", "Failed"], now: float) -> None:
        """Keep what has come since the last verdict, if the instance was healthy then and is."""
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
                        # It was said while the instance started, and held when it was first healthy.
                        self._add(key, item, replace(version, good_from=now), now)

    def forget_offers(self) -> None:
        """The instance failed, or another is in control: nothing of it that came and isn't kept yet counts.

        What the robot itself holds for late joiners holds for the next instance as well.
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
                    return  # the same message, given to a late joiner again
                version = replace(version, data=last.data)
        # The newest is always the last that came; the one before it is at least the period older.
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
        """Drop versions whose neighbours are near enough for their age, and those that are too old for ever."""
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
        """Drop versions until all that is kept fits; whether no newest one had to go."""
        untouched = True
        while (total := sum(item.size for item in self._items.values())) > self._state.max_bytes:
            by_size = sorted(self._items.values(), key=lambda item: -item.size)
            safe = now - LAG - self._margin
            if ripe := next((i for i in by_size if len(i.versions) > 1 and i.versions[1].good_from <= safe), None):
                ripe.versions.pop(0)
                ripe.count()
            elif dense := next((i for i in by_size if len(i.versions) > 3), None):
                # The second oldest is left to ripen, or the oldest would stay for ever.
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
                # Without a newcomer the policy has changed, and what comes next decides.
                largest.squeezed = (now if newcomer else -math.inf, message)
                untouched = False
        return untouched

    # -- giving out -------------------------------------------------------------------------------------------------

    def select(self, onset: float) -> KeptState:
        """What is given to the instance that takes over after a failure that began then, and what can't be."""
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

    def note(self, notes: Mapping[Key, tuple[Trouble, str]]) -> None:
        """Set why something cannot be captured: reported if nothing of it is kept."""
        self._notes = dict(notes)

    def entries(self, now: float) -> list[Entry]:
        """How it stands with everything that should be kept, if the instance failed now."""
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
        """The clock was set by so many seconds: move all times with it, so that ages stay what they are."""
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
        """All that is kept, oldest first."""
        return {key: tuple(item.versions) for key, item in self._items.items() if item.versions}

    def held(self) -> dict[Key, Sequence[Version]]:
        """All that is kept, and what may be with the next verdict."""
        return {
            key: (*item.versions, *((item.pending[0],) if item.pending is not None else ()))
            for key, item in self._items.items()
        }

    def adopt(self, versions: Mapping[Key, Iterable[Version]], now: float) -> None:
        """Take up what an earlier keeper had kept; what the policy doesn't name (any more) is left out.

        A version that claims to be from the future is of a clock that was wrong, and of an age that nobody knows.
        """
        for key, old in versions.items():
            item = self._items.get(key)
            if item is not None and not item.versions:
                usable = (v for v in old if v.taken_at <= now and v.good_from <= now and self._is_wanted(key, v))
                item.versions = sorted(usable, key=lambda v: v.good_from)
                self._share(item)
                item.count()
        self._fit(now)
        self.revision += 1

    def _share(self, item: _Item) -> None:
        for i in range(1, len(item.versions)):
            if item.versions[i].data == item.versions[i - 1].data:
                item.versions[i] = replace(item.versions[i], data=item.versions[i - 1].data)


def _pairs(versions: Iterable[Version]) -> Iterator[tuple[Version, Version | None]]:
    """Each with the one that follows; the last with None."""
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

"""Kept state as the monitor hands it to an agent, and what the agent says became of it.

Plain dataclasses and no pydantic: an agent sits in every pod, and should be small. Times are Unix seconds by the
monitor's clock.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

from understudy.api.protocol.agent_messages import ProtocolError
from understudy.kinematics.poses import HERE, Pose

Stamp = Literal["now", "kept"]

LARGEST = 22 * 1024 * 1024
"""Bytes of messages that fit into one request to an agent, with what base64 and JSON add."""


@dataclass(frozen=True)
class Motion:
    """What carries a kept pose to the present: where odometry had the robot when the pose was so, and had it last."""

    topic: str
    type: str
    required: bool = False
    """Whether a pose that can't be carried is not to be restored."""
    missing: str = ""
    """Why it can't be carried, in plain words; then what follows says nothing."""
    writer: bytes = b""
    """GID of the odometry's publisher: another one's has another origin."""
    frame: str = ""
    child: str = ""
    then: Pose = HERE
    last: Pose = HERE
    stamp: int = 0
    """Of the last one, in ns by its publisher's clock; 0 where it doesn't say."""
    received: float = 0.0
    """When it was received."""
    driven: float = 0.0
    """Metres between the two."""
    turned: float = 0.0
    """Radians between the two."""
    blind: float = 0.0
    """Seconds between them for which nobody watched whether odometry was set anew."""

    def to_wire(self) -> dict[str, Any]:
        """As it is sent."""
        if self.missing:
            return {"topic": self.topic, "type": self.type, "required": self.required, "missing": self.missing}
        plain = {field.name: getattr(self, field.name) for field in fields(self)}
        return plain | {"writer": self.writer.hex(), "then": list(self.then), "last": list(self.last)}

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> Motion:
        """From what was sent. Raises ProtocolError."""
        with _reading("motion", data):
            required = bool(data.get("required"))
            if data.get("missing"):
                return cls(str(data["topic"]), str(data["type"]), required, str(data["missing"]))
            return cls(
                topic=str(data["topic"]),
                type=str(data["type"]),
                required=required,
                writer=bytes.fromhex(data["writer"]),
                frame=str(data["frame"]),
                child=str(data["child"]),
                then=Pose.of([float(value) for value in data["then"]]),
                last=Pose.of([float(value) for value in data["last"]]),
                stamp=int(data["stamp"]),
                received=float(data["received"]),
                driven=float(data["driven"]),
                turned=float(data["turned"]),
                blind=float(data["blind"]),
            )


@dataclass(frozen=True)
class KeptSample:
    """A topic's message of a healthy instance."""

    topic: str
    type: str
    taken_at: float
    data: bytes
    """CDR with its 4-byte header."""
    to: str = ""
    """Topic that it is restored to; empty where it is kept for trees only."""
    stamp: Stamp = "kept"
    """What becomes of the stamp of a message with a header."""
    confirm: str = ""
    """Topic on which the instance itself publishes once it has taken it in; empty where a subscriber is enough."""
    motion: Motion | None = None
    """What carries it to the present; None where it is restored as it was kept."""

    @property
    def name(self) -> str:
        """The topic."""
        return self.topic

    def to_wire(self) -> dict[str, Any]:
        """As it is sent."""
        return {
            "topic": self.topic,
            "type": self.type,
            "to": self.to,
            "stamp": self.stamp,
            "confirm": self.confirm,
            "takenAt": self.taken_at,
            "data": base64.b64encode(self.data).decode(),
        } | ({"motion": self.motion.to_wire()} if self.motion else {})

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> KeptSample:
        """From what was sent. Raises ProtocolError."""
        with _reading("kept message", data):
            stamp: Stamp = "now" if data.get("stamp") == "now" else "kept"
            return cls(
                topic=str(data["topic"]),
                type=str(data["type"]),
                taken_at=float(data["takenAt"]),
                data=base64.b64decode(data["data"], validate=True),
                to=str(data.get("to") or ""),
                stamp=stamp,
                confirm=str(data.get("confirm") or ""),
                motion=Motion.from_wire(data["motion"]) if data.get("motion") else None,
            )


@dataclass(frozen=True)
class ParameterValues:
    """A node's parameters of a healthy instance."""

    node: str
    values: Mapping[str, Any]
    """Booleans, numbers, texts and lists of them, by name."""
    taken_at: float

    @property
    def name(self) -> str:
        """What it is called in reports."""
        return f"{self.node} (parameters)"

    def to_wire(self) -> dict[str, Any]:
        """As it is sent."""
        return {"node": self.node, "values": dict(self.values), "takenAt": self.taken_at}

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> ParameterValues:
        """From what was sent. Raises ProtocolError."""
        with _reading("kept parameters", data):
            return cls(str(data["node"]), dict(data["values"]), float(data["takenAt"]))


@dataclass(frozen=True)
class LifecycleState:
    """A managed node's state in a healthy instance."""

    node: str
    state: str
    """unconfigured, inactive, active or finalized."""
    taken_at: float

    @property
    def name(self) -> str:
        """What it is called in reports."""
        return f"{self.node} (lifecycle)"

    def to_wire(self) -> dict[str, Any]:
        """As it is sent."""
        return {"node": self.node, "state": self.state, "takenAt": self.taken_at}

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> LifecycleState:
        """From what was sent. Raises ProtocolError."""
        with _reading("kept lifecycle state", data):
            return cls(str(data["node"]), str(data["state"]), float(data["takenAt"]))


@dataclass(frozen=True)
class NotRestored:
    """Something that the policy keeps and that the instance was not given."""

    name: str
    """Topic, or node with what of it."""
    reason: str
    failed: bool = True
    """Whether giving it was tried; it was not where it is too old or was never kept."""

    def to_wire(self) -> dict[str, Any]:
        """As it is sent."""
        return {"name": self.name, "reason": self.reason, "failed": self.failed}

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> NotRestored:
        """From what was sent. Raises ProtocolError."""
        with _reading("restore report", data):
            return cls(str(data["name"]), str(data.get("reason", "")), bool(data.get("failed", True)))


@dataclass(frozen=True)
class KeptState:
    """All that the instance that takes over is to be given."""

    samples: tuple[KeptSample, ...] = ()
    parameters: tuple[ParameterValues, ...] = ()
    lifecycle: tuple[LifecycleState, ...] = ()
    left_out: tuple[NotRestored, ...] = ()
    """What the policy keeps and what can't be given: too old, or never seen of a healthy instance."""

    def __bool__(self) -> bool:
        """Whether there is anything to give."""
        return bool(self.restored_samples or self.parameters or self.lifecycle)

    @property
    def restored_samples(self) -> tuple[KeptSample, ...]:
        """The messages that are restored to a topic."""
        return tuple(sample for sample in self.samples if sample.to)

    @property
    def size(self) -> int:
        """Bytes of its messages."""
        return sum(len(sample.data) for sample in self.samples)

    def only(self, names: Collection[str]) -> KeptState:
        """What is of these topics and nodes; all of it where none are named."""
        if not names:
            return self
        return KeptState(
            tuple(s for s in self.samples if s.topic in names or s.to in names),
            tuple(p for p in self.parameters if p.node in names),
            tuple(n for n in self.lifecycle if n.node in names),
            tuple(n for n in self.left_out if n.name.split(" ")[0] in names),
        )

    def batches(self, most: int) -> list[KeptState]:
        """The same in parts whose messages have at most so many bytes, or are one; all but messages is in the first."""
        parts: list[list[KeptSample]] = [[]]
        for sample in self.samples:
            if parts[-1] and sum(len(s.data) for s in parts[-1]) + len(sample.data) > most:
                parts.append([])
            parts[-1].append(sample)
        first, *others = parts
        return [replace(self, samples=tuple(first)), *(KeptState(tuple(part)) for part in others)]

    def not_given(self, reason: str) -> RestoreReport:
        """The report of who could give none of it."""
        names = [s.name for s in self.restored_samples]
        names += [p.name for p in self.parameters] + [n.name for n in self.lifecycle]
        return RestoreReport((), (*self.left_out, *(NotRestored(name, reason) for name in names)))

    def contents(self) -> dict[str, object]:
        """What is in each of its parts, by name, whenever it was taken."""
        found: dict[str, object] = {s.name: s.data for s in self.samples}
        found |= {p.name: dict(p.values) for p in self.parameters}
        return found | {n.name: n.state for n in self.lifecycle}

    def changed_from(self, contents: Mapping[str, object]) -> KeptState:
        """What is other than those contents, or not among them."""
        changed = {name for name, content in self.contents().items() if contents.get(name) != content}
        return replace(
            self,
            samples=tuple(s for s in self.samples if s.name in changed),
            parameters=tuple(p for p in self.parameters if p.name in changed),
            lifecycle=tuple(n for n in self.lifecycle if n.name in changed),
        )

    def to_wire(self) -> dict[str, Any]:
        """As it is sent."""
        return {
            "samples": [s.to_wire() for s in self.samples],
            "parameters": [p.to_wire() for p in self.parameters],
            "lifecycle": [n.to_wire() for n in self.lifecycle],
            "leftOut": [n.to_wire() for n in self.left_out],
        }

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> KeptState:
        """From what was sent. Raises ProtocolError."""
        with _reading("kept state", data):
            return cls(
                tuple(KeptSample.from_wire(s) for s in data.get("samples", ())),
                tuple(ParameterValues.from_wire(p) for p in data.get("parameters", ())),
                tuple(LifecycleState.from_wire(n) for n in data.get("lifecycle", ())),
                tuple(NotRestored.from_wire(n) for n in data.get("leftOut", ())),
            )


@dataclass(frozen=True)
class Restored:
    """Something that an instance was given."""

    name: str
    """Topic, or node with what of it."""
    taken_at: float
    """When it was taken of the healthy instance."""
    carried: float | None = None
    """Metres by which odometry carried it to the present; None where it didn't."""
    note: str = ""
    """Why it wasn't carried although it should have been, or what is uncertain about that."""

    def to_wire(self) -> dict[str, Any]:
        """As it is sent."""
        return {"name": self.name, "takenAt": self.taken_at, "carried": self.carried, "note": self.note}

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> Restored:
        """From what was sent. Raises ProtocolError."""
        with _reading("restore report", data):
            carried = data.get("carried")
            return cls(
                str(data["name"]),
                float(data["takenAt"]),
                None if carried is None else float(carried),
                str(data.get("note") or ""),
            )


@dataclass(frozen=True)
class RestoreReport:
    """What became of a state that was to be restored."""

    restored: tuple[Restored, ...] = ()
    not_restored: tuple[NotRestored, ...] = ()

    @property
    def failed(self) -> tuple[NotRestored, ...]:
        """What was tried in vain."""
        return tuple(entry for entry in self.not_restored if entry.failed)

    @property
    def problem(self) -> str:
        """What was tried in vain and why, in plain words; empty where nothing was."""
        return "; ".join(f"{entry.name}: {entry.reason}" for entry in self.failed)

    def merged(self, other: RestoreReport) -> RestoreReport:
        """With what became of another part of the state; what was tried again counts as it ended last."""
        names = {r.name for r in other.restored} | {n.name for n in other.not_restored}
        return RestoreReport(
            (*(r for r in self.restored if r.name not in names), *other.restored),
            (*(n for n in self.not_restored if n.name not in names), *other.not_restored),
        )

    def to_wire(self) -> dict[str, Any]:
        """As it is sent."""
        return {
            "restored": [r.to_wire() for r in self.restored],
            "notRestored": [n.to_wire() for n in self.not_restored],
        }

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> RestoreReport:
        """From what was sent. Raises ProtocolError."""
        with _reading("restore report", data):
            return cls(
                tuple(Restored.from_wire(r) for r in data.get("restored", ())),
                tuple(NotRestored.from_wire(n) for n in data.get("notRestored", ())),
            )


class _reading:
    """Turns what goes wrong inside into a ProtocolError that says what was being read."""

    def __init__(self, what: str, data: object) -> None:
        self._what, self._data = what, data

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, KeyError | TypeError | ValueError | AttributeError | binascii.Error):
            raise ProtocolError(f"not a {self._what}: {error!r} in {self._data!r:.200}") from error

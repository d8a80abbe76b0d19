"""Kept state, as the monitor sends it to an agent, and the agent's report of what was restored.

Plain dataclasses, without pydantic: every pod has an agent, which should need little memory. Times are Unix seconds of the
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
"""Maximum size of the messages in one request to an agent, in bytes, without the overhead of base64 and JSON."""


@dataclass(frozen=True)
class Motion:
    """Motion that brings a kept pose up to date: the robot's odometry when the pose was taken, and the latest odometry."""

    topic: str
    type: str
    required: bool = False
    """Whether a pose that cannot be brought up to date must not be restored."""
    missing: str = ""
    """Why the pose cannot be brought up to date, as text. If it is set, the fields below have no meaning."""
    writer: bytes = b""
    """GID of the odometry's publisher. Another publisher has another origin."""
    frame: str = ""
    child: str = ""
    then: Pose = HERE
    last: Pose = HERE
    stamp: int = 0
    """Stamp of the last odometry message, in ns of its publisher's clock; 0 if it has none."""
    received: float = 0.0
    """When the last odometry message was received."""
    driven: float = 0.0
    """Metres between the two poses."""
    turned: float = 0.0
    """Radians between the two poses."""
    blind: float = 0.0
    """Seconds between the two poses in which nothing watched whether odometry was reset."""

    def to_wire(self) -> dict[str, Any]:
        """Return the message for the wire."""
        if self.missing:
            return {"topic": self.topic, "type": self.type, "required": self.required, "missing": self.missing}
        plain = {field.name: getattr(self, field.name) for field in fields(self)}
        return plain | {"writer": self.writer.hex(), "then": list(self.then), "last": list(self.last)}

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> Motion:
        """Return the value in a message. Raises ProtocolError."""
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
    """A topic's message from a healthy instance."""

    topic: str
    type: str
    taken_at: float
    data: bytes
    """CDR with its 4-byte header."""
    to: str = ""
    """Topic on which the message is restored. Empty if it is kept for trees only."""
    stamp: Stamp = "kept"
    """What happens to the stamp of a message with a header."""
    confirm: str = ""
    """Topic on which the instance publishes when it has processed the message. Empty if it is enough that a subscriber received it."""
    motion: Motion | None = None
    """Motion that brings the pose up to date. None if the message is restored as it was kept."""

    @property
    def name(self) -> str:
        """The topic."""
        return self.topic

    def to_wire(self) -> dict[str, Any]:
        """Return the message for the wire."""
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
        """Return the value in a message. Raises ProtocolError."""
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
    """Parameters of a node of a healthy instance."""

    node: str
    values: Mapping[str, Any]
    """Booleans, numbers, strings and lists of them, by name."""
    taken_at: float

    @property
    def name(self) -> str:
        """Name of the item in reports."""
        return f"{self.node} (parameters)"

    def to_wire(self) -> dict[str, Any]:
        """Return the message for the wire."""
        return {"node": self.node, "values": dict(self.values), "takenAt": self.taken_at}

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> ParameterValues:
        """Return the value in a message. Raises ProtocolError."""
        with _reading("kept parameters", data):
            return cls(str(data["node"]), dict(data["values"]), float(data["takenAt"]))


@dataclass(frozen=True)
class LifecycleState:
    """Lifecycle state of a managed node of a healthy instance."""

    node: str
    state: str
    """unconfigured, inactive, active or finalized."""
    taken_at: float

    @property
    def name(self) -> str:
        """Name of the item in reports."""
        return f"{self.node} (lifecycle)"

    def to_wire(self) -> dict[str, Any]:
        """Return the message for the wire."""
        return {"node": self.node, "state": self.state, "takenAt": self.taken_at}

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> LifecycleState:
        """Return the value in a message. Raises ProtocolError."""
        with _reading("kept lifecycle state", data):
            return cls(str(data["node"]), str(data["state"]), float(data["takenAt"]))


@dataclass(frozen=True)
class NotRestored:
    """An item of kept state that the instance did not receive."""

    name: str
    """Name of the topic, or of the node and the kind of its state."""
    reason: str
    failed: bool = True
    """Whether the restoration was tried. False if the item is too old or was never kept."""

    def to_wire(self) -> dict[str, Any]:
        """Return the message for the wire."""
        return {"name": self.name, "reason": self.reason, "failed": self.failed}

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> NotRestored:
        """Return the value in a message. Raises ProtocolError."""
        with _reading("restore report", data):
            return cls(str(data["name"]), str(data.get("reason", "")), bool(data.get("failed", True)))


@dataclass(frozen=True)
class KeptState:
    """Everything to restore to the instance that takes over."""

    samples: tuple[KeptSample, ...] = ()
    parameters: tuple[ParameterValues, ...] = ()
    lifecycle: tuple[LifecycleState, ...] = ()
    left_out: tuple[NotRestored, ...] = ()
    """Items that the policy lists and that cannot be restored, because they are too old or were never received from a healthy instance."""

    def __bool__(self) -> bool:
        """Whether there is anything to restore."""
        return bool(self.restored_samples or self.parameters or self.lifecycle)

    @property
    def restored_samples(self) -> tuple[KeptSample, ...]:
        """The messages that have a topic to restore them to."""
        return tuple(sample for sample in self.samples if sample.to)

    @property
    def size(self) -> int:
        """Size of the messages in bytes."""
        return sum(len(sample.data) for sample in self.samples)

    def only(self, names: Collection[str]) -> KeptState:
        """Return the part for these topics and nodes, or everything if none are given."""
        if not names:
            return self
        return KeptState(
            tuple(s for s in self.samples if s.topic in names or s.to in names),
            tuple(p for p in self.parameters if p.node in names),
            tuple(n for n in self.lifecycle if n.node in names),
            tuple(n for n in self.left_out if n.name.split(" ")[0] in names),
        )

    def batches(self, most: int) -> list[KeptState]:
        """Split the state into parts with at most this many bytes of messages, or one message. The first part contains everything else."""
        parts: list[list[KeptSample]] = [[]]
        for sample in self.samples:
            if parts[-1] and sum(len(s.data) for s in parts[-1]) + len(sample.data) > most:
                parts.append([])
            parts[-1].append(sample)
        first, *others = parts
        return [replace(self, samples=tuple(first)), *(KeptState(tuple(part)) for part in others)]

    def none_restored(self, reason: str) -> RestoreReport:
        """Return the report of an agent that could restore nothing."""
        names = [s.name for s in self.restored_samples]
        names += [p.name for p in self.parameters] + [n.name for n in self.lifecycle]
        return RestoreReport((), (*self.left_out, *(NotRestored(name, reason) for name in names)))

    def contents(self) -> dict[str, object]:
        """The content of each item by name, without its time."""
        found: dict[str, object] = {s.name: s.data for s in self.samples}
        found |= {p.name: dict(p.values) for p in self.parameters}
        return found | {n.name: n.state for n in self.lifecycle}

    def changed_from(self, contents: Mapping[str, object]) -> KeptState:
        """Return what differs from these contents, or is not among them."""
        changed = {name for name, content in self.contents().items() if contents.get(name) != content}
        return replace(
            self,
            samples=tuple(s for s in self.samples if s.name in changed),
            parameters=tuple(p for p in self.parameters if p.name in changed),
            lifecycle=tuple(n for n in self.lifecycle if n.name in changed),
        )

    def to_wire(self) -> dict[str, Any]:
        """Return the message for the wire."""
        return {
            "samples": [s.to_wire() for s in self.samples],
            "parameters": [p.to_wire() for p in self.parameters],
            "lifecycle": [n.to_wire() for n in self.lifecycle],
            "leftOut": [n.to_wire() for n in self.left_out],
        }

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> KeptState:
        """Return the value in a message. Raises ProtocolError."""
        with _reading("kept state", data):
            return cls(
                tuple(KeptSample.from_wire(s) for s in data.get("samples", ())),
                tuple(ParameterValues.from_wire(p) for p in data.get("parameters", ())),
                tuple(LifecycleState.from_wire(n) for n in data.get("lifecycle", ())),
                tuple(NotRestored.from_wire(n) for n in data.get("leftOut", ())),
            )


@dataclass(frozen=True)
class Restored:
    """An item that an instance received."""

    name: str
    """Name of the topic, or of the node and the kind of its state."""
    taken_at: float
    """When it was taken from the healthy instance."""
    carried: float | None = None
    """Distance in metres that the pose was moved with odometry to bring it up to date; None if odometry was not used."""
    note: str = ""
    """Why the pose was not brought up to date, or what is uncertain about it."""

    def to_wire(self) -> dict[str, Any]:
        """Return the message for the wire."""
        return {"name": self.name, "takenAt": self.taken_at, "carried": self.carried, "note": self.note}

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> Restored:
        """Return the value in a message. Raises ProtocolError."""
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
    """Result of a restoration."""

    restored: tuple[Restored, ...] = ()
    not_restored: tuple[NotRestored, ...] = ()

    @property
    def failed(self) -> tuple[NotRestored, ...]:
        """Items whose restoration was tried and failed."""
        return tuple(entry for entry in self.not_restored if entry.failed)

    @property
    def problem(self) -> str:
        """The failed items with their reasons, as text. Empty if nothing failed."""
        return "; ".join(f"{entry.name}: {entry.reason}" for entry in self.failed)

    def merged(self, other: RestoreReport) -> RestoreReport:
        """Return this report combined with that of another part of the state. For an item that was tried again, the later result counts."""
        names = {r.name for r in other.restored} | {n.name for n in other.not_restored}
        return RestoreReport(
            (*(r for r in self.restored if r.name not in names), *other.restored),
            (*(n for n in self.not_restored if n.name not in names), *other.not_restored),
        )

    def to_wire(self) -> dict[str, Any]:
        """Return the message for the wire."""
        return {
            "restored": [r.to_wire() for r in self.restored],
            "notRestored": [n.to_wire() for n in self.not_restored],
        }

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> RestoreReport:
        """Return the value in a message. Raises ProtocolError."""
        with _reading("restore report", data):
            return cls(
                tuple(Restored.from_wire(r) for r in data.get("restored", ())),
                tuple(NotRestored.from_wire(n) for n in data.get("notRestored", ())),
            )


class _reading:
    """Turns errors inside the block into a ProtocolError that says what was being read."""

    def __init__(self, what: str, data: object) -> None:
        self._what, self._data = what, data

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, KeyError | TypeError | ValueError | AttributeError | binascii.Error):
            raise ProtocolError(f"not a {self._what}: {error!r} in {self._data!r:.200}") from error

"""The messages between the monitor and an agent.

TCP, one JSON object per line. Both sides first prove that they know the token (secure_channel.py). From then on the monitor sends requests
``{"id", "op", "gate", "seen", ...}``, each answered by ``{"id", "ok": true, ...}`` or ``{"id", "error"}``, in the order in which they are
completed. In between, the agent sends ``{"status": ..., "number": n}`` on every change and once a second, so that silence means that the
connection is lost, and ``{"event": ...}`` for events such as the feedback of a goal.

``seen`` is the number of the last status that the monitor has received. It proves the age of a request without a common
clock: if the agent sent ``seen`` too long ago, the network or a stalled process has held the request back. The agent then does
not carry it out and answers ``{"id", "error", "heldBack": true}``. The monitor may send it again if it still wants it.

Plain dataclasses, without pydantic: every pod has an agent, and a held agent should need little memory.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

KEYED_PROTOCOL = 3
"""Newest version of the protocol: the agent recognizes the monitor by its key."""

PROTOCOL = 2
"""The version that every agent of this release knows: both sides prove the token, and each message is authenticated by it."""

OLDEST_PROTOCOL = 1
"""Oldest version of the protocol: that of Understudy before version 0.3."""

MAX_LINE = 1 << 25
"""Maximum size of a message in bytes: enough for a claim's environment, a policy's tree or a kept map."""

MAX_GREETING = 4096
"""Maximum size of a message in bytes before the monitor is authenticated."""

STATUS_PERIOD = 1.0
"""Seconds between two status messages if nothing changes."""

SILENCE = 3.0
"""Seconds without a message after which the connection counts as lost."""

FRESH = 4.0
"""Seconds after the agent has sent a status until requests of a monitor that has seen no later one are refused."""

RENEW_PERMIT = "lease"
"""Name of the operation that renews an instance's permit. Agents of version 0.1.0 know it by this name, and an upgrade leaves the
agents of running pods as they are: rename it only when no supported version of the agent needs the old name."""

GAVE_WAY = "gave way to another procedure"
"""Error of a procedure that a newer procedure replaced."""

BEGUN = "begun:"
"""Prefix of a procedure in ``AgentStatus.initialized`` that has begun and is not completed: it runs, or has failed."""

Phase = Literal["Held", "Starting", "Running"]


class ProtocolError(Exception):
    """The other side sent something that is not a message."""


def encode(message: Mapping[str, Any]) -> bytes:
    """Return a message as one line.

    Raises ProtocolError if it is longer than the other side would read.
    """
    line = json.dumps(message, separators=(",", ":")).encode() + b"\n"
    if len(line) > MAX_LINE:
        raise ProtocolError(f"the message has {len(line)} bytes, the maximum is {MAX_LINE}")
    return line


def decode(line: bytes) -> dict[str, Any]:
    """Return the message in a line.

    Raises ProtocolError if the line is not a message.
    """
    try:
        message = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"not JSON: {error}") from error
    if not isinstance(message, dict):
        raise ProtocolError(f"a message is a JSON object, not {type(message).__name__}")
    return message


async def read_line(reader: asyncio.StreamReader, most: int) -> bytes:
    """Return a line of at most ``most`` bytes, with its line end, whatever the reader's own limit.

    Raises EOFError if the other side closes the connection, ProtocolError if the line is longer.
    """
    parts: list[bytes] = []
    size = 0
    while True:
        try:
            part = await reader.readuntil(b"\n")
        except asyncio.LimitOverrunError as overrun:
            part = await reader.readexactly(overrun.consumed)
        except asyncio.IncompleteReadError:
            raise EOFError("the other side closed the connection") from None
        size += len(part)
        if size > most:
            raise ProtocolError(f"a line of more than {most} bytes")
        parts.append(part)
        if part.endswith(b"\n"):
            return b"".join(parts)


def reset(writer: asyncio.StreamWriter) -> None:
    """End a connection and discard what was not delivered yet. The kernel would try to deliver that first, even minutes later."""
    with contextlib.suppress(OSError):
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    writer.transport.abort()


@dataclass(frozen=True)
class GateEpoch:
    """The epoch of a workload's gate, as the sender of a request knows it: the request's field ``gate``.

    An agent refuses requests with an older epoch than it has received before, because another monitor has switched the
    gate since. Monitors before version 0.3 send none, which counts as epoch 0.
    """

    workload_uid: str = ""
    """UID of the RobotWorkload. Epochs of another workload of the same name begin again."""
    number: int = 0

    def to_wire(self) -> dict[str, Any]:
        """Return the field for the wire."""
        return {"workload": self.workload_uid, "epoch": self.number}

    @classmethod
    def from_wire(cls, data: object) -> GateEpoch:
        """Return the epoch in a request's field; epoch 0 if the field is missing or invalid."""
        if not isinstance(data, dict):
            return cls()
        uid, number = data.get("workload"), data.get("epoch")
        if not isinstance(uid, str) or not isinstance(number, int) or isinstance(number, bool):
            return cls()
        return cls(uid, number)


@dataclass(frozen=True)
class OutputCount:
    """What an instance has published on one topic."""

    count: int = 0
    last: float | None = None
    """Unix seconds at which the agent received the last sample."""


@dataclass(frozen=True)
class AgentStatus:
    """State of an instance, observed from inside its pod. Times are Unix seconds of its node's clock."""

    phase: Phase = "Held"
    """Held: a container waits for its claim. Starting: not yet healthy since the start. Running: healthy at least once since the start."""
    ready: bool = False
    """While held: every held container waits. Otherwise: the tree succeeds on this pod's own outputs and the robot's inputs."""
    reason: str = ""
    """Why the instance is not ready."""
    started_at: float | None = None
    process_up_at: float | None = None
    """When the application's first publisher or server of an output was discovered."""
    ready_at: float | None = None
    """When the health tree succeeded for the first time since the start."""
    configured: bool = False
    """Whether the agent has a health tree."""
    outputs: Mapping[str, OutputCount] = field(default_factory=dict)
    initialized: str = ""
    """The last procedure, by the name that the monitor gave it; after BEGUN if it runs or has failed. Empty if there was none."""
    check: str = ""
    """Why the readiness check fails. Empty if it succeeds or there is none."""
    procedure: str = ""
    """Name of the running procedure."""
    strength: tuple[int, int] | None = None
    """Minimum and maximum ownership strength of its writers; None if they have none, or none was discovered."""
    cut_off: float | None = None
    """Since when the application is held because nobody answered. None while it runs."""
    unfenced: str = ""
    """Why the application could not be held if the pod were cut off. Empty if it could, or if that is not needed."""
    further_interfaces: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """By the name of each network interface besides that of the pod network: its addresses. Agents before version 0.3 report none."""
    gate: GateEpoch = GateEpoch()
    """The newest epoch that this agent has received. Agents before version 0.3 report none."""

    def to_wire(self) -> dict[str, Any]:
        """Return the message for the wire."""
        return {
            "phase": self.phase,
            "ready": self.ready,
            "reason": self.reason,
            "startedAt": self.started_at,
            "processUpAt": self.process_up_at,
            "readyAt": self.ready_at,
            "configured": self.configured,
            "outputs": {topic: {"count": o.count, "last": o.last} for topic, o in self.outputs.items()},
            "initialized": self.initialized,
            "check": self.check,
            "procedure": self.procedure,
            **({"strength": list(self.strength)} if self.strength else {}),
            **({"cutOff": self.cut_off} if self.cut_off is not None else {}),
            **({"unfenced": self.unfenced} if self.unfenced else {}),
            **({"furtherInterfaces": dict(self.further_interfaces)} if self.further_interfaces else {}),
            **({"gate": self.gate.to_wire()} if self.gate.number else {}),
        }

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> AgentStatus:
        """Return the status in a message. Unknown fields, as a newer agent sends them, are ignored.

        Raises ProtocolError if it is not a status.
        """
        try:
            strength = data.get("strength")
            return cls(
                phase=data["phase"],
                ready=bool(data["ready"]),
                reason=str(data.get("reason", "")),
                started_at=data.get("startedAt"),
                process_up_at=data.get("processUpAt"),
                ready_at=data.get("readyAt"),
                configured=bool(data.get("configured", False)),
                outputs={
                    topic: OutputCount(int(o["count"]), o.get("last")) for topic, o in data.get("outputs", {}).items()
                },
                initialized=str(data.get("initialized") or ""),
                check=str(data.get("check") or ""),
                procedure=str(data.get("procedure") or ""),
                strength=(int(strength[0]), int(strength[1])) if strength else None,
                cut_off=float(data["cutOff"]) if data.get("cutOff") is not None else None,
                unfenced=str(data.get("unfenced") or ""),
                further_interfaces={
                    name: tuple(str(address) for address in addresses)
                    for name, addresses in (data.get("furtherInterfaces") or {}).items()
                },
                gate=GateEpoch.from_wire(data.get("gate")),
            )
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise ProtocolError(f"not a status: {error!r} in {data!r:.200}") from error

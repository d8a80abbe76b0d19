"""What the monitor and an agent say to each other, and how the monitor proves that it may command one.

TCP, one JSON object per line. The agent speaks first: ``{"nonce", "pod", "uid", "version"}``. The monitor answers
``{"workload", "claim", "mac"}``, and from then on sends requests ``{"id", "op", ...}``, each answered by
``{"id", "ok": true, ...}`` or ``{"id", "error"}``, in the order in which they are done. Between the answers the agent
sends ``{"status": ...}`` on every change and once a second, so that silence means that one side is gone, and
``{"event": ...}`` for what happens, such as a goal's feedback.

Plain dataclasses and no pydantic: an agent sits in every pod, and a held one should be small.
"""

from __future__ import annotations

import hashlib
import hmac
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

PROTOCOL = 1
"""Version of the protocol, said in the greeting."""

MAX_LINE = 1 << 25
"""Bytes of one message: a claim's whole environment, a policy's tree or a kept map fits in."""

MAX_GREETING = 4096
"""Bytes of one message before the mac was right."""

STATUS_PERIOD = 1.0
"""Seconds between two status messages when nothing changes."""

SILENCE = 3.0
"""Seconds without a message after which the other side is taken for gone."""

GAVE_WAY = "gave way to another procedure"
"""Said of a procedure whose place a newer one took."""

Phase = Literal["Held", "Starting", "Running"]


class ProtocolError(Exception):
    """The other side sent something that is no message."""


def mac(token: bytes, nonce: str, workload: str, claim: str) -> str:
    """Proof of the token for one session (HMAC-SHA256, RFC 2104), in hex. A nonce makes it worthless for another."""
    return hmac.new(token, f"{nonce}\n{workload}\n{claim}".encode(), hashlib.sha256).hexdigest()


def encode(message: Mapping[str, Any]) -> bytes:
    """One message as a line.

    Raises ProtocolError when it is longer than the other side would read.
    """
    line = json.dumps(message, separators=(",", ":")).encode() + b"\n"
    if len(line) > MAX_LINE:
        raise ProtocolError(f"the message has {len(line)} bytes, the most is {MAX_LINE}")
    return line


def decode(line: bytes) -> dict[str, Any]:
    """The message of a line.

    Raises ProtocolError when it is none.
    """
    try:
        message = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"not JSON: {error}") from error
    if not isinstance(message, dict):
        raise ProtocolError(f"a message is a JSON object, not {type(message).__name__}")
    return message


@dataclass(frozen=True)
class OutputCount:
    """What an instance has put out on one topic."""

    count: int = 0
    last: float | None = None
    """Unix seconds at which the agent received the last sample."""


@dataclass(frozen=True)
class AgentStatus:
    """An instance as seen from inside its pod. Times are Unix seconds of its node's clock."""

    phase: Phase = "Held"
    """Held: a container waits for its claim. Starting: not yet healthy since the start. Running: it has been."""
    ready: bool = False
    """Held: every held container waits. Else: the tree holds on this pod's own outputs and the robot's inputs."""
    reason: str = ""
    """Why it isn't ready."""
    started_at: float | None = None
    process_up_at: float | None = None
    """When the application's first publisher or server for an output was seen."""
    ready_at: float | None = None
    """When the health tree held for the first time since the start."""
    configured: bool = False
    """Whether it has a health tree."""
    outputs: Mapping[str, OutputCount] = field(default_factory=dict)
    initialized: str = ""
    """What a procedure has brought it to, as the monitor called it; empty where none has, or while one runs."""
    check: str = ""
    """Why its readiness check doesn't hold; empty where it does or there is none."""
    procedure: str = ""
    """Name of the procedure that runs on it."""
    strength: tuple[int, int] | None = None
    """Least and greatest ownership strength that its writers may have; None where they have none, or none is up."""
    cut_off: float | None = None
    """Since when its application is held, since nobody answered; None while it runs."""
    unfenced: str = ""
    """Why its application couldn't be held if it were cut off; empty where it could, or needn't."""

    def to_wire(self) -> dict[str, Any]:
        """As it is sent."""
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
        }

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> AgentStatus:
        """From what was sent; fields of a newer agent are passed over.

        Raises ProtocolError when it is no status.
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
            )
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise ProtocolError(f"not a status: {error!r} in {data!r:.200}") from error

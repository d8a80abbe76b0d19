"""The keys of one session between a monitor and an agent, and the authentication codes that are made with them. Pure.

The token that both sides share is never used itself. HKDF (RFC 5869) with SHA-256 derives each key from the token, the secret that the
monitor's key and the agent's key of the session give (monitor_key.py), the UID of the agent's pod, a nonce of each side, the workload and
the claim, so nothing of a session is valid in another one or for another pod. Each use and each direction has its own key. Nothing is
encrypted.
"""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass, field

from understudy.api.protocol.agent_messages import ProtocolError

_SALT, _SALT_OF_TOKEN = b"understudy agent session, version 3", b"understudy agent session, version 2"

TAG = 16
"""Bytes of a message authentication code (MAC): HMAC-SHA256, truncated."""


class NotAuthentic(ProtocolError):
    """What arrived was not sent by the other side of this session, or not in this order."""


@dataclass(frozen=True)
class SessionKeys:
    """The keys of one session."""

    monitor_proof: str
    """Shows the agent that the monitor knows the token, and which workload, claim and pod it means."""
    agent_proof: str
    """Shows the monitor that the agent knows the token, and that it is the agent of that pod."""
    to_agent: bytes = field(repr=False)
    """Authenticates the lines of the monitor."""
    to_monitor: bytes = field(repr=False)
    """Authenticates the lines of the agent."""
    probes: bytes = field(repr=False)
    """Authenticates the gate probes of the pod."""


def derive(
    token: bytes,
    *,
    uid: str,
    agent_nonce: str,
    monitor_nonce: str,
    workload: str,
    claim: str,
    shared: bytes = b"",
) -> SessionKeys:
    """Return the keys of a session with the agent of the pod with this UID. ``shared`` is empty in version 2."""
    salt, secret = (_SALT, _field(token) + shared) if shared else (_SALT_OF_TOKEN, token)

    def key(use: str) -> bytes:
        return expanded(salt, secret, use, uid, agent_nonce, monitor_nonce, workload, claim)

    return SessionKeys(
        monitor_proof=key("proof of the monitor").hex(),
        agent_proof=key("proof of the agent").hex(),
        to_agent=key("lines to the agent"),
        to_monitor=key("lines to the monitor"),
        probes=key("gate probes"),
    )


def expanded(salt: bytes, token: bytes, use: str, *context: str) -> bytes:
    """Return the key for one use in one context: HKDF with SHA-256, one block."""
    secret = hmac.digest(salt, token, "sha256")
    return hmac.digest(secret, b"".join(map(_field, (use, *context))) + b"\x01", "sha256")


def _field(text: str | bytes) -> bytes:
    """Return a text with its length, so that two different sequences of texts never have the same bytes."""
    data = text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass")
    return len(data).to_bytes(4, "big") + data


def tag(key: bytes, message: bytes) -> bytes:
    """Return the MAC of a message."""
    return hmac.digest(key, message, "sha256")[:TAG]


def equal(one: str, other: str) -> bool:
    """Compare two texts in a time that does not depend on where they differ."""
    return hmac.compare_digest(one.encode("utf-8", "surrogatepass"), other.encode("utf-8", "surrogatepass"))


class LineAuthentication:
    """The lines of one direction of a session. Each begins with its MAC in hex and a space.

    The MAC includes how many lines came before, so a line that is changed, repeated or moved does not pass, and neither does the next
    one if a line is missing.
    """

    OVERHEAD = 2 * TAG + 1
    """Bytes that are added to each line."""

    def __init__(self, key: bytes) -> None:
        """Raises ValueError if the key is empty."""
        if not key:
            raise ValueError("the key is empty")
        self._key, self._count = key, 0

    def seal(self, line: bytes) -> bytes:
        """Return the next line as it is sent."""
        return self._next(line) + b" " + line

    def open(self, line: bytes) -> bytes:
        """Return the line that was sealed. Raises NotAuthentic."""
        sealed, found = self._next(line[self.OVERHEAD :]), line[: self.OVERHEAD]
        if not hmac.compare_digest(found, sealed + b" "):
            raise NotAuthentic(
                f"line {self._count} of the session is not authentic: it was changed, repeated or inserted, or lines before it are missing"
            )
        return line[self.OVERHEAD :]

    def _next(self, line: bytes) -> bytes:
        number, self._count = self._count, self._count + 1
        return tag(self._key, number.to_bytes(8, "big") + line).hex().encode()


def legacy_proof(token: bytes, nonce: str, workload: str, claim: str) -> str:
    """Return the proof of a monitor in version 1 of the protocol. It does not depend on the pod, and no key follows from it."""
    return hmac.new(token, f"{nonce}\n{workload}\n{claim}".encode("utf-8", "surrogatepass"), hashlib.sha256).hexdigest()

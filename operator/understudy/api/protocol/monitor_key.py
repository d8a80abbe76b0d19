"""The key pair of a monitor, which shows its agents who it is: X25519 (RFC 7748). Pure.

The operator writes both keys to the Secret with the agents' token. Pods mount the public key beside the token, and monitors read the
private one from the API server. So whoever controls an agent knows the token, and still cannot act as the monitor toward another agent:
the keys of a session also depend on what only the private key and the agent's own key of that session give.
"""

from __future__ import annotations

import hashlib
from types import ModuleType


def _x25519() -> ModuleType:
    """Import the algorithm. Not at the top, because the command reads the same objects as the operator, and has no use for keys."""
    from cryptography.hazmat.primitives.asymmetric import x25519

    return x25519


def pair(seed: str) -> tuple[bytes, bytes]:
    """Return the private and the public key that follow from a random text."""
    private = hashlib.sha256(seed.encode()).digest()
    public: bytes = _x25519().X25519PrivateKey.from_private_bytes(private).public_key().public_bytes_raw()
    return private, public


def shared(private: bytes, public: bytes) -> bytes:
    """Return the secret that two sides share, by the private key of one and the public key of the other. Raises ValueError."""
    x25519 = _x25519()
    secret: bytes = x25519.X25519PrivateKey.from_private_bytes(private).exchange(
        x25519.X25519PublicKey.from_public_bytes(public)
    )
    return secret


class AgentSide:
    """The agent's own key, which exists for one session."""

    def __init__(self, monitor: bytes) -> None:
        """``monitor`` is the public key of the monitor. Raises ValueError."""
        x25519 = _x25519()
        own = x25519.X25519PrivateKey.generate()
        self.public: bytes = own.public_key().public_bytes_raw()
        self.shared: bytes = own.exchange(x25519.X25519PublicKey.from_public_bytes(monitor))

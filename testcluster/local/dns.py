"""Asks a DNS server a question to test whether it answers. Kubernetes reports a failure after the loss of a node late."""

import secrets
import socket
import struct


def answers(server: str, name: str, timeout: float = 0.5) -> bool:
    """Return whether a server resolves a name to an IPv4 address in time (RFC 1035, section 4)."""
    identity = secrets.randbelow(1 << 16)
    labels = b"".join(bytes([len(label)]) + label.encode() for label in name.rstrip(".").split("."))
    # One question, recursion desired, type A, class IN.
    query = struct.pack("!6H", identity, 0x0100, 1, 0, 0, 0) + labels + b"\0" + struct.pack("!2H", 1, 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as channel:
        channel.settimeout(timeout)
        try:
            channel.connect((server, 53))
            channel.send(query)
            reply = channel.recv(4096)
        except OSError:
            return False
    if len(reply) < 12:
        return False
    replied, flags, _, answered, _, _ = struct.unpack("!6H", reply[:12])
    return bool(replied == identity and flags & 0x000F == 0 and answered)

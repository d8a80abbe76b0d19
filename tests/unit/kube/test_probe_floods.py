"""Floods at the port of the probes: datagrams of strangers take no place of those of the agents. Over a real UDP socket of the loopback."""

from __future__ import annotations

import os
import socket
from collections.abc import AsyncIterator, Callable

import pytest

from understudy.kube.gates import probes
from understudy.kube.gates.probes import Arrivals, ProbeKeys, ProbeReceiver

UID = "0b5d9f5e-7c1e-4a8e-9f2b-5d2f3f6f9a10"
OLD = "1b5d9f5e-7c1e-4a8e-9f2b-5d2f3f6f9a11"

MANY = 5000
"""More datagrams than a socket keeps."""

Send = Callable[[bytes], object]


@pytest.fixture
async def receiver() -> AsyncIterator[ProbeReceiver]:
    """A monitor's."""
    made = ProbeReceiver(ProbeKeys())
    yield made
    made.close()


@pytest.fixture
async def send(receiver: ProbeReceiver) -> AsyncIterator[Send]:
    """Sends a datagram to the receiver."""
    port = await receiver.listen(port=0, host="127.0.0.1")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.connect(("127.0.0.1", port))
        yield sock.send


FORGED = {
    "garbage": lambda: os.urandom(64),
    "of the right length": lambda: b"USP2" + os.urandom(32),
    "without a MAC": lambda: probes.encode(UID, 1, 1),
    "of another session": lambda: probes.sign(b"other", 1),
}


@pytest.mark.parametrize("forged", FORGED.values(), ids=FORGED.keys())
async def test_a_probe_counts_after_more_datagrams_than_the_socket_keeps(
    receiver: ProbeReceiver, send: Send, forged: Callable[[], bytes]
) -> None:
    receiver.trust(UID, b"key")
    for _ in range(MANY):
        send(forged())
    send(probes.sign(b"key", 1))
    assert receiver.count_since(UID, 0) == 1


async def test_probes_of_all_pods_and_sessions_pass(receiver: ProbeReceiver, send: Send) -> None:
    pods = [f"{number:036}" for number in range(Arrivals.PODS)]
    receiver.trust_unsigned(OLD)
    for number, uid in enumerate(pods[:-1]):
        for session in (b"first", b"second"):
            receiver.trust(uid, session + uid.encode())
            send(probes.sign(session + uid.encode(), number + 1))
        send(probes.encode(OLD, number, 1))
        assert (receiver.count_since(uid, 0), receiver.count_since(OLD, 0)) == (2, number + 1)


async def test_probes_without_a_mac_pass_while_an_old_agent_is_there(receiver: ProbeReceiver, send: Send) -> None:
    receiver.trust_unsigned(OLD)
    send(probes.encode(OLD, 1, 1))
    assert receiver.count_since(OLD, 0) == 1
    receiver.trust(OLD, b"key")
    for _ in range(MANY):
        send(probes.encode(OLD, 2, 1))
    send(probes.sign(b"key", 1))
    assert receiver.count_since(OLD, 0) == 2

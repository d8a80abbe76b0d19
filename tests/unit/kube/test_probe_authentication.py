"""Which probes count at a monitor: those that an agent has authenticated for it. Over a real UDP socket of the loopback."""

import asyncio
import itertools
import socket

import pytest

from understudy.api import names
from understudy.kube.gates import probes, registry
from understudy.kube.gates.probes import Arrivals, ProbeKeys, ProbeReceiver, ProbeSender

UID = "0b5d9f5e-7c1e-4a8e-9f2b-5d2f3f6f9a10"
OTHER = "1b5d9f5e-7c1e-4a8e-9f2b-5d2f3f6f9a11"


@pytest.fixture
async def careful():
    """A receiver that counts authentic probes only, as a monitor's."""
    made = ProbeReceiver(ProbeKeys())
    made.port = await made.listen(port=0, host="127.0.0.1")
    yield made
    made.close()


@pytest.fixture
def deliver(careful):
    """Sends datagrams, and waits until they have arrived."""
    end = itertools.count(1)
    careful.trust(OTHER, b"last")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:

        async def send(*datagrams):
            for datagram in (*datagrams, probes.sign(b"last", number := next(end))):
                sock.sendto(datagram, ("127.0.0.1", careful.port))
            async with asyncio.timeout(5):
                while careful.count_since(OTHER, 0) < number:
                    await asyncio.sleep(0.005)

        yield send


def test_a_datagram_with_a_mac_has_the_agreed_format():
    name, tag = bytes.fromhex("052e4a06dc3087d1"), bytes.fromhex("2279e7a920cdd30de808d6ce6f3e510a")
    assert probes.sign(b"key", 7) == b"USP2" + name + (7).to_bytes(8, "big") + tag


def test_whether_the_probes_of_a_pod_would_count_is_known():
    careful = ProbeReceiver(ProbeKeys())
    assert not careful.recognizes(UID)
    careful.trust(UID, b"key")
    careful.trust_unsigned(OTHER)
    assert careful.recognizes(UID)
    assert careful.recognizes(OTHER)
    assert ProbeReceiver().recognizes(UID), "without keys, those of all senders count"


async def test_nobody_can_forge_the_probes_of_a_pod(careful, deliver):
    careful.trust(UID, b"key")
    authentic = probes.sign(b"key", 1)
    forged = [
        probes.encode(UID, 1, 1),
        probes.sign(b"guessed", 1),
        authentic[:12] + probes.sign(b"guessed", 1)[12:],
        authentic[:-1],
        authentic + b"x",
        b"USP2",
        *(authentic[:at] + bytes([authentic[at] ^ 1]) + authentic[at + 1 :] for at in range(len(authentic))),
    ]
    await deliver(*forged)
    assert careful.last(UID) is None
    assert careful.heard_since(0) == [OTHER], "no leak is reported of anybody"
    await deliver(authentic)
    assert careful.count_since(UID, 0) == 1


async def test_a_probe_that_is_sent_again_by_somebody_counts_once(careful, deliver):
    careful.trust(UID, b"key")
    await deliver(probes.sign(b"key", 1), probes.sign(b"key", 2))
    before = careful.last(UID)
    await asyncio.sleep(0.01)
    await deliver(probes.sign(b"key", 1), probes.sign(b"key", 2))
    careful.trust(UID, b"key")
    await deliver(probes.sign(b"key", 2))
    assert (careful.count_since(UID, 0), careful.last(UID)) == (2, before)
    await deliver(probes.sign(b"key", 3))
    assert careful.count_since(UID, 0) == 3


async def test_a_probe_of_a_session_with_an_earlier_monitor_is_not_heard(careful, deliver):
    """Nor is one that somebody has recorded before this monitor started."""
    careful.trust(UID, b"new session")
    await deliver(probes.sign(b"old session", 1000))
    assert careful.last(UID) is None


async def test_probes_of_a_pod_are_heard_until_it_is_configured_in_a_later_session(careful, deliver):
    for session in (b"1", b"2", b"3"):
        careful.trust(UID, session)
    await deliver(probes.sign(b"1", 1), probes.sign(b"3", 2))
    assert careful.count_since(UID, 0) == 2


async def test_a_pod_whose_agent_is_old_needs_no_mac(careful, deliver):
    careful.trust_unsigned(UID)
    await deliver(probes.encode(UID, 1, 1), probes.encode("2" * 36, 1, 1))
    assert sorted(careful.heard_since(0)) == sorted([UID, OTHER])
    careful.trust(UID, b"key")
    careful.trust_unsigned(UID)
    await deliver(probes.encode(UID, 2, 1))
    assert careful.count_since(UID, 0) == 1, "it has shown that it can do better"


async def test_a_sender_signs_from_when_it_has_a_key(careful):
    careful.trust(UID, b"key")
    sender = ProbeSender(UID)
    sender.aim("127.0.0.1", careful.port, key=b"key")
    sender.burst(0.01, 0.2)
    await careful.wait(UID, 0, 5)
    sender.close()


def test_keys_are_bounded():
    keys, pods = ProbeKeys(), [f"{i:036}" for i in range(Arrivals.PODS + 5)]
    for uid in pods:
        for session in range(2 * ProbeKeys.SESSIONS):
            keys.trust(uid, f"{uid} {session}".encode())
    heard = [
        keys.sender(probes.sign(f"{uid} {session}".encode(), 1)) for uid in pods for session in range(2 * keys.SESSIONS)
    ]
    assert [uid for uid in heard if uid] == [uid for uid in pods[5:] for _ in range(keys.SESSIONS)]
    for uid in pods:
        keys.trust_unsigned("old" + uid[3:])
    assert keys.sender(probes.encode("old" + pods[0][3:], 1, 1)) is None
    assert keys.sender(probes.encode("old" + pods[-1][3:], 1, 1))


async def test_a_monitor_of_the_default_gate_hears_authentic_probes_only(monkeypatch):
    monkeypatch.setattr(names, "PROBE_PORT", 0)
    proof = await registry.DEFAULT.proof()
    port = proof._socket.getsockname()[1]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.sendto(probes.encode(UID, 1, 1), ("127.0.0.1", port))
        proof.trust(OTHER, b"key")
        sock.sendto(probes.sign(b"key", 1), ("127.0.0.1", port))
    await proof.wait(OTHER, 0, 5)
    assert proof.heard_since(0) == [OTHER]
    proof.close()

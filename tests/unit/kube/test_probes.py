"""Probes over a real UDP socket of the loopback."""

import asyncio
import itertools
import math
import socket
import statistics
import time

import pytest

from tests.support.clock import set_clock
from understudy.clock import CLOCK
from understudy.kube.gates import probes
from understudy.kube.gates.probes import Arrivals, Probe, ProbeReceiver, ProbeSender

UID = "0b5d9f5e-7c1e-4a8e-9f2b-5d2f3f6f9a10"
OTHER = "1b5d9f5e-7c1e-4a8e-9f2b-5d2f3f6f9a11"


@pytest.fixture
async def receiver():
    made = ProbeReceiver()
    made.port = await made.listen(port=0, host="127.0.0.1")
    yield made
    made.close()


@pytest.fixture
def sender():
    made = ProbeSender(UID)
    yield made
    made.close()


@pytest.fixture
def send(receiver):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        yield lambda datagram: sock.sendto(datagram, ("127.0.0.1", receiver.port))


def test_a_datagram_has_the_agreed_format():
    datagram = probes.encode(UID, 7, 1_700_000_000_123_456_789)
    assert datagram == b"USP1" + UID.encode() + (7).to_bytes(8, "big") + (1_700_000_000_123_456_789).to_bytes(8, "big")
    assert probes.decode(datagram) == Probe(UID, 7, pytest.approx(1_700_000_000.123456789))


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"USP1",
        b"USP2" + bytes(52),
        b"USP1" + b"\xff" * 52,
        probes.encode(UID, 1, 1)[:-1],
        probes.encode(UID, 1, 1) + b"x",
    ],
)
def test_other_datagrams_are_ignored(datagram):
    assert probes.decode(datagram) is None


def test_a_uid_has_36_characters():
    with pytest.raises(ValueError, match="pod UID 'abc' has 3 bytes"):
        ProbeSender("abc")


async def test_arrivals_are_recorded_per_pod(receiver, send):
    started_at = time.time()
    for _ in range(3):
        send(probes.encode(UID, 1, 1))
    send(probes.encode(OTHER, 1, 1))
    send(b"nonsense")
    first = await receiver.wait(UID, started_at, 1)
    await receiver.wait(OTHER, started_at, 1)
    assert started_at <= first <= time.time()
    assert receiver.count_since(UID, started_at) == 3
    assert receiver.count_since(UID, time.time()) == 0
    assert started_at <= receiver.last(OTHER) <= time.time()
    assert receiver.last("nobody") is None
    assert receiver.count_since("nobody", 0) == 0


async def test_wait_ignores_arrivals_before_the_given_time(receiver, send):
    send(probes.encode(UID, 1, 1))
    first = await receiver.wait(UID, 0, 1)
    await asyncio.sleep(0.01)
    later = time.time()
    waiting = asyncio.create_task(receiver.wait(UID, later, 1))
    send(probes.encode(OTHER, 1, 1))
    await asyncio.sleep(0.05)
    assert not waiting.done()
    send(probes.encode(UID, 2, 1))
    assert await waiting > later > first
    assert await receiver.wait(UID, 0) == first
    with pytest.raises(TimeoutError):
        await receiver.wait(UID, time.time() + 60, 0.05)


async def test_the_arrival_time_is_that_of_receipt_not_of_reading(receiver, send):
    send(probes.encode(OTHER, 1, 1))  # the kernel begins to stamp with the first socket that wants it
    await receiver.wait(OTHER, 0, 1)
    sent = time.time()
    send(probes.encode(UID, 1, 1))
    time.sleep(0.2)  # noqa: ASYNC251 (a busy event loop)
    assert await receiver.wait(UID, 0, 1) - sent < 0.1


def test_memory_is_bounded():
    arrivals = Arrivals()
    for i in range(Arrivals.PODS + 10):
        arrivals.add(f"{i:036}", float(i))
    arrivals.add(f"{10:036}", 1000.0)
    arrivals.add("new", 1000.0)
    known = [i for i in range(Arrivals.PODS + 10) if arrivals.of(f"{i:036}")]
    assert len(known) + bool(arrivals.of("new")) == Arrivals.PODS
    assert list(arrivals.of(f"{10:036}")) == [10.0, 1000.0]
    assert not arrivals.of(f"{11:036}")
    for i in range(2 * Arrivals.MOST):
        arrivals.add(UID, float(i))
    assert len(arrivals.of(UID)) == Arrivals.MOST


def test_arrival_times_follow_a_clock_that_is_set_back():
    arrivals = Arrivals()
    for arrival in (100.0, 101.0, 100.999):
        arrivals.add(UID, arrival)
    assert list(arrivals.of(UID)) == [100.0, 101.0, 101.0], "it was slewed"


@pytest.mark.parametrize("step", [-60.0, 60.0])
async def test_arrival_times_follow_a_clock_that_is_set(receiver, sender, monkeypatch, step):
    sender.aim("127.0.0.1", receiver.port)
    begun = CLOCK.now()
    sender.run()
    first = await receiver.wait(UID, begun - 0.01, 5)
    sender.burst(0.01, 0.1)
    time.sleep(0.15)  # noqa: ASYNC251  The probes wait in the socket, with stamps of the old clock.
    set_clock(monkeypatch, step)
    last = receiver.last(UID)
    assert 0 <= time.time() - last < 1.0
    assert receiver.first_since(UID, time.time() - 1.0) == pytest.approx(first + step, abs=0.05)
    assert await receiver.wait(UID, first, 5) == pytest.approx(first, abs=1.0)


async def test_one_probe_a_second_is_sent_once_a_target_is_set(receiver, sender):
    sender.run()
    await asyncio.sleep(0.05)
    sender.aim("127.0.0.1", receiver.port)
    first = await receiver.wait(UID, 0, 1.5)
    second = await receiver.wait(UID, first + 0.001, 1.5)
    assert second - first == pytest.approx(probes.PERIOD, abs=0.2)
    sender.rest()
    with pytest.raises(TimeoutError):
        await receiver.wait(UID, second + 0.001, 1.3)


def times(receiver):
    """When the probes of the pod arrived."""
    after = 0.0
    while (arrival := receiver.first_since(UID, after)) is not None:
        yield arrival
        after = math.nextafter(arrival, math.inf)


async def test_a_burst_has_the_requested_duration_and_becomes_slower(receiver, sender):
    sender.aim("127.0.0.1", receiver.port)
    started_at, cpu = time.time(), time.process_time()
    sender.burst(0.002, 1.0)
    await asyncio.sleep(1.2)
    spent = time.process_time() - cpu
    assert receiver.count_since(UID, 0)
    arrivals = list(times(receiver))
    # Wide bounds: the machine may have more to do. A quiet one gives 97.
    assert 50 <= len(arrivals) <= 105
    assert arrivals[-1] - started_at < 1.15
    gaps = [b - a for a, b in itertools.pairwise(arrivals)]
    assert 0.0015 < statistics.median(gaps[:18]) < 0.004
    assert 0.018 < statistics.median(gaps[-20:]) < 0.03
    assert spent < 0.2
    await asyncio.sleep(0.1)
    assert list(times(receiver)) == arrivals


async def test_a_burst_without_a_waiter_rarely_wakes_the_process(sender, monkeypatch):
    loop, woken = asyncio.get_running_loop(), 0
    add_reader = loop.add_reader

    def counting(descriptor, callback):
        def counted():
            nonlocal woken
            woken += 1
            callback()

        add_reader(descriptor, counted)

    monkeypatch.setattr(loop, "add_reader", counting)
    receiver = ProbeReceiver()
    sender.aim("127.0.0.1", await receiver.listen(port=0, host="127.0.0.1"))
    sender.burst(0.001, 0.2)
    await asyncio.sleep(0.3)
    assert 1 <= woken <= 0.3 / probes.REST + 2
    assert receiver.count_since(UID, 0) > 30
    receiver.close()


async def test_a_new_waiter_receives_an_arrival_at_once_after_nobody_waited(receiver, send, monkeypatch):
    monkeypatch.setattr(probes, "REST", 30.0)
    send(probes.encode(OTHER, 1, 1))
    await asyncio.sleep(0.05)
    waiting = asyncio.create_task(receiver.wait(UID, 0, 10))
    await asyncio.sleep(0.05)
    send(probes.encode(UID, 1, 1))
    assert await waiting


async def test_a_burst_does_not_wait_for_the_event_loop(receiver, sender):
    sender.aim("127.0.0.1", receiver.port)
    sender.burst(0.005, 2.0)
    await receiver.wait(UID, 0, 1)
    started_at = time.time()
    time.sleep(0.2)  # noqa: ASYNC251 (a busy event loop)
    ended = time.time()
    await asyncio.sleep(0.05)
    assert receiver.count_since(UID, started_at) - receiver.count_since(UID, ended) > 15


async def test_a_second_burst_prolongs_the_first(receiver, sender):
    sender.aim("127.0.0.1", receiver.port)
    started_at = time.time()
    sender.burst(0.01, 0.2)
    sender.burst(0.01, 0.5)
    await asyncio.sleep(0.8)
    assert 0.4 < receiver.last(UID) - started_at < 0.6
    assert receiver.count_since(UID, 0) <= 52
    sender.burst(0.01, 0.1)
    assert await receiver.wait(UID, started_at + 0.7, 1)


@pytest.mark.parametrize(("interval", "duration"), [(0.0, 1), (0.0001, 1), (2, 1), (0.001, 0), (0.001, 1e6)])
def test_bursts_are_bounded(sender, interval, duration):
    sender.aim("127.0.0.1")
    with pytest.raises(ValueError, match="out of bounds"):
        sender.burst(interval, duration)


def test_a_target_must_be_an_address(sender):
    with pytest.raises(RuntimeError, match="no address"):
        sender.burst(0.001, 1)
    with pytest.raises(ValueError, match=r"robot\.example"):
        sender.aim("robot.example")
    with pytest.raises(ValueError, match="port 70000"):
        sender.aim("127.0.0.1", 70000)
    with pytest.raises(RuntimeError, match="no address"):
        sender.burst(0.001, 1)


async def test_a_probe_that_cannot_be_sent_is_lost_without_other_effects(sender):
    sender.aim("127.0.0.1", 1)  # answers with "connection refused"
    sender.burst(0.001, 0.1)
    sender.aim("ff02::1", 1)  # needs a scope
    sender.run()
    await asyncio.sleep(0.2)

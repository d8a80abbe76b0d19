"""What discovery says of participants and readers is understood as Fast DDS says it: datagrams of real processes, recorded."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from understudy.ros.dds import rtps
from understudy.ros.dds.rtps import Gap, Heartbeat, Participant, Reader, Sample
from understudy.ros.middleware import Locator

RECORDED = {
    name: bytes.fromhex(datagram)
    for name, datagram in (
        line.split()
        for line in (Path(__file__).parent / "recorded_discovery.txt").read_text().splitlines()
        if not line.startswith("#")
    )
}
SERVER = bytes.fromhex("4453005f4550524f53494d41")
OURS = bytes.fromhex("010f") + bytes(range(10))


def samples(name: str) -> list[Sample]:
    return [message for message in rtps.parse(RECORDED[name]) if isinstance(message, Sample)]


def reader(name: str) -> Reader:
    (sample,) = samples(name)
    assert isinstance(sample.entity, Reader)
    return sample.entity


@pytest.mark.parametrize("name", ["server_participant", "multicast_participant"])
def test_a_participant_announces_its_locators(name: str) -> None:
    (sample,) = samples(name)
    assert isinstance(sample.entity, Participant)
    assert sample.entity.discovery == (Locator("10.9.0.2", 9160),)
    assert sample.entity.default == (Locator("10.9.0.2", 9161),)


def test_a_reader_announces_its_own_port_or_that_of_its_participant() -> None:
    plain, gated = reader("server_plain"), reader("server_gated")
    assert (plain.topic, plain.locators) == ("rt/chat", (Locator("10.9.0.2", 9161),))
    assert (gated.topic, gated.locators) == ("rt/chat", (Locator("10.9.0.3", 7950),))
    assert len(plain.guid) == len(gated.guid) == 16


def test_a_server_announces_readers_of_others_and_a_participant_its_own() -> None:
    (message,) = samples("server_gated")
    assert message.writer == SERVER + rtps.SUBSCRIPTIONS[0]
    for message in samples("multicast_two_readers"):
        assert isinstance(message.entity, Reader)
        assert message.writer[: rtps.PREFIX] == message.entity.guid[: rtps.PREFIX]


def test_one_datagram_may_contain_several_readers() -> None:
    first, second = samples("multicast_two_readers")
    assert second.number == first.number + 1
    assert isinstance(second.entity, Reader)
    assert second.entity.topic == "rt/chat"


def test_a_deleted_reader_announces_nothing() -> None:
    (message,) = samples("reader_gone")
    assert (message.number, message.entity) == (15, None)


def test_heartbeats_and_gaps_are_parsed() -> None:
    (heartbeat,) = rtps.parse(RECORDED["server_heartbeat"])
    assert isinstance(heartbeat, Heartbeat)
    assert heartbeat.writer == SERVER + rtps.SUBSCRIPTIONS[0]
    assert heartbeat.first <= heartbeat.last + 1
    (gap,) = rtps.parse(RECORDED["server_gap"])
    assert isinstance(gap, Gap)
    assert gap.numbers == {8, 9}


def test_our_own_announcements_are_parsed_as_they_were_meant() -> None:
    at = Locator("10.9.0.4", 40000)
    (message,) = rtps.parse(rtps.announcement(OURS, at, rtps.SUBSCRIPTIONS, lease=10.0, kind="SUPER_CLIENT", to=SERVER))
    assert message == Sample(OURS + rtps.PARTICIPANTS[0], 1, Participant(OURS, (at,), (at,)))
    assert list(rtps.parse(rtps.farewell(OURS, to=SERVER))) == [Sample(OURS + rtps.PARTICIPANTS[0], 2, None)]


@pytest.mark.parametrize(
    ("missing", "base", "bits"),
    [([], 21, ""), ([3], 3, "1"), ([3, 5, 6], 3, "1011"), ([3, 40], 3, "1" + "0" * 36 + "1")],
)
def test_an_acknowledgement_lists_the_missing_samples(missing: list[int], base: int, bits: str) -> None:
    writer = SERVER + rtps.SUBSCRIPTIONS[0]
    acknowledgement = rtps.acknowledgement(OURS, writer, missing, then=21, count=7)
    body = acknowledgement[20 + 16 + 4 :]  # after the header, whom it is for, and its own head
    assert body[:8] == rtps.SUBSCRIPTIONS[1] + rtps.SUBSCRIPTIONS[0]
    assert int.from_bytes(body[12:16], "little") == base
    count = int.from_bytes(body[16:20], "little")
    words = [int.from_bytes(body[20 + i : 24 + i], "little") for i in range(0, (count + 31) // 32 * 4, 4)]
    assert "".join(f"{word:032b}" for word in words)[:count] == bits
    assert body[-4:] == (7).to_bytes(4, "little")


def test_a_datagram_that_is_not_rtps_is_ignored() -> None:
    assert list(rtps.parse(b"")) == list(rtps.parse(b"GET / HTTP/1.1\r\n\r\n" + bytes(20))) == []


@given(name=st.sampled_from(sorted(RECORDED)), data=st.data())
def test_a_broken_datagram_is_refused_without_other_effects(name: str, data: st.DataObject) -> None:
    datagram = bytearray(RECORDED[name])
    for at in data.draw(st.lists(st.integers(0, len(datagram) - 1), max_size=8)):
        datagram[at] = data.draw(st.integers(0, 255))
    cut = bytes(datagram[: data.draw(st.integers(0, len(datagram)))])
    with contextlib.suppress(ValueError):
        list(rtps.parse(cut))

"""The black box of a monitor: what real nodes said around a failure, what it costs a failover, and what it does when things go wrong."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from mcap.reader import make_reader

from tests.unit.dds import isolate_discovery
from tests.unit.monitor.recorded_monitor import Monitored, policy
from understudy.api.kinds.recording_spec import Recordings
from understudy.monitor.report import black_box as module
from understudy.process.http_pages import serve

pytestmark = pytest.mark.ros


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Monitored]:
    isolate_discovery(monkeypatch)
    monkeypatch.setattr(module, "AFTER", 0.3)
    monitored = Monitored(tmp_path / "recordings")
    yield monitored
    monitored.observer.graph.close()


@pytest.fixture
async def monitored(made: Monitored) -> AsyncIterator[Monitored]:
    running = asyncio.create_task(made.box.run())
    await asyncio.sleep(0)
    yield made
    running.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await running


async def test_messages_before_and_after_a_failure_are_recorded(monitored: Monitored) -> None:
    await monitored.driven()
    progress = monitored.fail()
    await monitored.look(0.1)
    monitored.recovered(progress)
    before = monitored.received
    await monitored.driven(5)
    await monitored.recorded()
    (recording,) = monitored.archive.recordings
    assert (recording.number, recording.reason, recording.result, recording.strategy) == (
        1,
        "no /cmd_vel",
        "Recovered",
        "Restart",
    )
    found = monitored.messages("/cmd_vel")
    assert len(found) >= before + 5
    place = monitored.sent.index(found[0])
    assert found == monitored.sent[place : place + len(found)], "byte by byte, as it was sent"
    traces = [json.loads(data[8:-1]) for data in monitored.messages("/understudy/tree")]
    assert [trace["health"] for trace in traces if trace["health"] == "Failed"], "how the tree was when it failed"
    assert traces[0]["tree"]["topic"] == "/cmd_vel"
    assert any(b"FailureDetected: no /cmd_vel" in data for data in monitored.messages("/understudy/events"))
    assert set(monitored.cluster.asked) == {
        "involvedObject.kind=RobotWorkload,involvedObject.name=robot-1", "involvedObject.kind=Pod,involvedObject.name=a",
    }  # fmt: skip


async def test_without_the_black_box_nothing_is_recorded(monitored: Monitored) -> None:
    monitored.objects.put_policy(policy(None))
    await monitored.look(0.2)
    await monitored.driven(5)
    monitored.recovered(monitored.fail())
    await monitored.look(0.6)
    assert not monitored.archive.recordings
    assert not monitored.cluster.asked


async def test_a_planned_recovery_is_not_recorded(monitored: Monitored) -> None:
    monitored.recovered(monitored.fail(planned=True))
    await monitored.look(0.6)
    assert not monitored.archive.recordings


async def test_a_repeated_failure_is_recorded_once(monitored: Monitored) -> None:
    first = monitored.fail()
    first.result = "Failed"
    monitored.box.end(first)
    monitored.notices.record(first)
    await monitored.recorded()
    again = monitored.fail()
    again.result = "Failed"
    monitored.box.end(again)
    monitored.notices.record(again)
    await monitored.look(0.8)
    assert [one.id for one in monitored.archive.recordings] == [first.id]


async def test_two_consecutive_failures_have_two_recordings(monitored: Monitored) -> None:
    await monitored.driven()
    first = monitored.fail()
    monitored.recovered(first)
    second = monitored.fail()
    await monitored.look(0.6)  # the first is written meanwhile
    monitored.recovered(second)
    await monitored.recorded(2)
    assert [(one.number, one.id) for one in monitored.archive.recordings] == [(2, second.id), (1, first.id)]
    for recording in (0, 1):
        assert monitored.sent[-1] in monitored.messages("/cmd_vel", recording)


async def test_an_abandoned_recovery_does_not_hold_the_ring(monitored: Monitored) -> None:
    progress = monitored.fail()
    monitored.box.end(progress)  # superseded
    ring = monitored.observer.ring
    assert ring is not None
    assert ring.since is None
    assert not monitored.archive.recordings


async def test_an_unwritable_disk_is_reported_once_and_the_next_recording_succeeds(
    monitored: Monitored, tmp_path: Path
) -> None:
    (tmp_path / "recordings").write_text("a file where the folder should be")
    for _ in range(2):
        monitored.recovered(monitored.fail())
        await monitored.look(0.8)
    assert [event[:2] for event in monitored.notices.events] == [("Warning", "NotRecorded")]
    assert "recovery 1 is not recorded: " in monitored.notices.events[0][2]
    (tmp_path / "recordings").unlink()
    monitored.recovered(monitored.fail())
    await monitored.recorded()
    assert [one.number for one in monitored.archive.recordings] == [3]


async def test_a_recording_without_events_is_complete_otherwise(monitored: Monitored) -> None:
    monitored.cluster.refuses = True
    monitored.recovered(monitored.fail())
    await monitored.recorded()
    with monitored.archive.path(monitored.archive.recordings[0]).open("rb") as file:
        (metadata,) = make_reader(file).iter_metadata()
    assert "events is forbidden" in metadata.metadata["events"]


async def test_an_omitted_topic_is_named(monitored: Monitored) -> None:
    ring = monitored.observer.ring
    assert ring is not None
    ring.limit = 1000
    await monitored.driven(20)
    monitored.recovered(monitored.fail())
    await monitored.recorded()
    (recording,) = monitored.archive.recordings
    assert "/cmd_vel" in recording.left_out


async def test_the_black_box_does_not_delay_a_failover(monitored: Monitored) -> None:
    await monitored.driven()
    times = []
    for _ in range(20):
        began = time.perf_counter()
        progress = monitored.fail()
        monitored.box.end(progress)
        times.append(time.perf_counter() - began)
        await asyncio.sleep(0)
    assert sorted(times)[10] < 0.001


async def test_recordings_can_be_downloaded(monitored: Monitored, get: Callable[[str], Any]) -> None:
    monitored.recovered(monitored.fail())
    await monitored.recorded()
    (recording,) = monitored.archive.recordings
    await monitored.look(0.1)
    server = await serve(monitored.box.pages, 0, host="127.0.0.1")
    url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    recordings = Recordings.model_validate_json(await get(f"{url}/"))
    assert (recordings.workload, recordings.on, recordings.recordings) == ("robot-1", True, [recording])
    assert await get(f"{url}/{recording.id}.mcap") == monitored.archive.path(recording).read_bytes()
    server.close()


@pytest.fixture
def get() -> Callable[[str], Any]:
    from urllib.request import urlopen

    def asked(url: str) -> bytes:
        with urlopen(url, timeout=20) as answer:
            body: bytes = answer.read()
            return body

    return lambda url: asyncio.to_thread(asked, url)

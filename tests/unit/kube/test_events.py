"""Events count up instead of flooding, and are never what anything depends on."""

from __future__ import annotations

from typing import Any

import pytest

from tests.unit.kube.memory import MemoryClient
from understudy.kube import events
from understudy.kube.client import ApiError, Object
from understudy.kube.events import Recorder

TARGET: Object = {
    "apiVersion": "understudy.dev/v1alpha1",
    "kind": "RobotWorkload",
    "metadata": {"name": "robot-17", "namespace": "fleet", "uid": "u-17", "resourceVersion": "4"},
}


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def client() -> MemoryClient:
    return MemoryClient()


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def recorder(client: MemoryClient, clock: Clock) -> Recorder:
    return Recorder(client, "understudy-operator", "pod-1", clock=clock)


def stored(client: MemoryClient) -> list[Any]:
    return list(client.items.values())


async def test_an_event_is_about_its_object(recorder: Recorder, client: MemoryClient) -> None:
    await recorder.warning(TARGET, "PolicyNotFound", "no such policy")
    (event,) = stored(client)
    assert event["involvedObject"] == {
        "apiVersion": "understudy.dev/v1alpha1",
        "kind": "RobotWorkload",
        "name": "robot-17",
        "namespace": "fleet",
        "uid": "u-17",
    }
    assert event["metadata"]["namespace"] == "fleet"
    assert (event["type"], event["reason"], event["message"]) == ("Warning", "PolicyNotFound", "no such policy")
    assert event["count"] == 1
    assert event["firstTimestamp"] == event["lastTimestamp"]
    assert event["reportingComponent"] == event["source"]["component"] == "understudy-operator"


async def test_an_event_accepts_a_reference_instead_of_an_object(recorder: Recorder, client: MemoryClient) -> None:
    reference = {"kind": "Pod", "name": "p", "namespace": "fleet", "uid": "u"}
    await recorder.normal(reference, "Claimed", "")
    assert stored(client)[0]["involvedObject"] == reference


async def test_a_repeated_event_increases_the_count(recorder: Recorder, client: MemoryClient, clock: Clock) -> None:
    for _ in range(4):
        await recorder.warning(TARGET, "StandbyNotReady", "not ready")
        clock.now += 60
    (event,) = stored(client)
    assert event["count"] == 4


async def test_a_burst_of_equal_events_takes_two_writes_and_loses_none(
    recorder: Recorder, client: MemoryClient, clock: Clock
) -> None:
    for _ in range(100):
        await recorder.warning(TARGET, "StandbyNotReady", "not ready")
    clock.now += events.COUNT_SECONDS
    await recorder.warning(TARGET, "StandbyNotReady", "not ready")
    assert len(client.requests) == 2
    assert stored(client)[0]["count"] == 101


async def test_many_messages_of_one_reason_become_one_event(
    recorder: Recorder, client: MemoryClient, clock: Clock
) -> None:
    for i in range(events.SIMILAR_MOST + 10):
        await recorder.warning(TARGET, "LeakSeen", f"at {i}")
        clock.now += events.COUNT_SECONDS
    assert len(stored(client)) == events.SIMILAR_MOST + 1
    combined = stored(client)[-1]
    assert combined["message"].startswith("(combined from similar events)")
    assert combined["count"] == 10


async def test_events_of_one_object_are_rate_limited(recorder: Recorder, client: MemoryClient, clock: Clock) -> None:
    for i in range(500):
        await recorder.warning(TARGET, f"Reason{i}", "message")
    assert len(client.requests) == events.BURST
    other = {**TARGET, "metadata": {**TARGET["metadata"], "name": "robot-18", "uid": "u-18"}}
    await recorder.warning(other, "Reason", "message")
    assert len(client.requests) == events.BURST + 1


async def test_an_expired_event_is_created_again(recorder: Recorder, client: MemoryClient, clock: Clock) -> None:
    await recorder.warning(TARGET, "StandbyNotReady", "not ready")
    client.items.clear()
    clock.now += 7200
    await recorder.warning(TARGET, "StandbyNotReady", "not ready")
    (event,) = stored(client)
    assert event["count"] == 1


@pytest.mark.parametrize("error", [ApiError(500, "InternalError", "no"), TimeoutError(), OSError("refused")])
async def test_a_failed_write_of_an_event_raises_nothing(
    recorder: Recorder, client: MemoryClient, clock: Clock, error: Exception
) -> None:
    client.failing = lambda method, name: error
    await recorder.warning(TARGET, "StandbyNotReady", "not ready")
    client.failing = lambda method, name: None
    clock.now += events.COUNT_SECONDS
    await recorder.warning(TARGET, "StandbyNotReady", "not ready")
    assert stored(client)[0]["count"] == 2


async def test_a_long_message_is_cut_to_the_limit_of_the_api_server(recorder: Recorder, client: MemoryClient) -> None:
    await recorder.warning(TARGET, "TemplateInvalid", "x" * 5000)
    assert len(stored(client)[0]["message"]) <= events.MESSAGE_MOST


async def test_an_event_has_no_control_characters_and_is_bounded(recorder: Recorder, client: MemoryClient) -> None:
    """The reason of a failure may quote the log of a robot's node."""
    await recorder.warning(
        TARGET, "RecoveryFailed", "amcl says ERROR: \x1b[2J\x1b]0;owned\x07\nrobot-18 is \u202ehealthy"
    )
    await recorder.warning(TARGET, "RecoveryFailed", "\x1b" * 10**6)
    first, second = stored(client)
    assert first["message"] == r"amcl says ERROR: \x1b[2J\x1b]0;owned\x07 robot-18 is \u202ehealthy"
    assert len(second["message"]) == events.MESSAGE_MOST

"""Kept state is given to real nodes: poses with the present stamp, parameters, lifecycle states; in bounded time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.serialization import deserialize_message, serialize_message

from tests.unit.agent.poses import POSE, pose
from tests.unit.dds import isolate_discovery
from understudy.agent.control_channel import Peer, Refused
from understudy.agent.restoration.kept_messages import stamped
from understudy.agent.restoration.state_restoration import StateRestorer
from understudy.api.protocol.kept_state import (
    KeptSample,
    KeptState,
    LifecycleState,
    NotRestored,
    ParameterValues,
    RestoreReport,
)
from understudy.ros.actions.instance_calls import CallFailed, InstanceCaller

pytestmark = pytest.mark.ros

WITHIN = 25.0
"""Seconds for what is done at once on a machine that is not busy."""
PEER = Peer("shop", "", "127.0.0.1")


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    isolate_discovery(monkeypatch)


@pytest.fixture
def caller() -> Iterator[InstanceCaller]:
    made = InstanceCaller("restorer")
    yield made
    made.close()


@pytest.fixture
def restorer(caller: InstanceCaller) -> StateRestorer:
    return StateRestorer(lambda: caller)


async def localized(caller: InstanceCaller) -> PoseWithCovarianceStamped:
    sample = await caller.wait_sample("/amcl_pose", POSE, WITHIN)
    return deserialize_message(sample.data, PoseWithCovarianceStamped)


def names(report: RestoreReport) -> list[str]:
    return [entry.name for entry in report.restored]


async def test_a_pose_is_published_with_the_present_stamp_and_otherwise_unchanged(
    localizer: Callable[..., None], restorer: StateRestorer, caller: InstanceCaller
) -> None:
    localizer()
    await caller.bring_to("/localizer", "inactive", WITHIN)
    before = time.time()
    sample = pose()
    report = await restorer.restore(KeptState((sample,)), within=WITHIN)
    assert (names(report), report.not_restored) == (["/amcl_pose"], ())
    assert report.restored[0].taken_at == sample.taken_at
    taken = await localized(caller)
    assert before - 0.001 <= taken.header.stamp.sec + taken.header.stamp.nanosec * 1e-9 <= time.time()
    assert (taken.header.frame_id, taken.pose.pose.position.x, taken.pose.covariance[35]) == ("map", 1.5, 0.25)


async def test_a_stamp_is_unchanged_if_the_policy_keeps_it(
    localizer: Callable[..., None], restorer: StateRestorer, caller: InstanceCaller
) -> None:
    localizer()
    await caller.bring_to("/localizer", "inactive", WITHIN)
    await restorer.restore(KeptState((pose(stamp="kept"),)), within=WITHIN)
    assert (await localized(caller)).header.stamp.sec == 42


async def test_a_message_is_published_again_until_it_is_confirmed(
    localizer: Callable[..., None], restorer: StateRestorer, caller: InstanceCaller
) -> None:
    localizer("2")
    await caller.bring_to("/localizer", "inactive", WITHIN)
    report = await restorer.restore(KeptState((pose(confirm="/amcl_pose"),)), within=WITHIN)
    assert (names(report), report.not_restored) == (["/amcl_pose"], ())
    assert (await localized(caller)).pose.pose.position.x == 1.5


async def test_earlier_messages_confirm_nothing(
    localizer: Callable[..., None], restorer: StateRestorer, caller: InstanceCaller
) -> None:
    localizer()
    await caller.bring_to("/localizer", "inactive", WITHIN)
    await restorer.restore(KeptState((pose(),)), within=WITHIN)
    await localized(caller)  # latched: it is there for every late joiner
    other = KeptSample("/map_pose", POSE, time.time(), pose().data, to="/nowhere", confirm="/amcl_pose")
    started_at = time.monotonic()
    report = await restorer.restore(KeptState((other,)), within=2.0)
    assert time.monotonic() - started_at < 10
    (entry,) = report.failed
    assert entry.reason.startswith(f"nobody subscribes to /nowhere as {POSE} within ")


async def test_a_missing_confirmation_fails_in_bounded_time(
    localizer: Callable[..., None], restorer: StateRestorer, caller: InstanceCaller
) -> None:
    localizer("1000")
    await caller.bring_to("/localizer", "inactive", WITHIN)
    started_at = time.monotonic()
    report = await restorer.restore(KeptState((pose(confirm="/amcl_pose"),)), within=8.0)
    assert time.monotonic() - started_at < 20
    (entry,) = report.failed
    assert entry.name == "/amcl_pose"
    assert_golden("agent", entry.reason.partition(" within ")[0], "/initialpose")


async def test_a_topic_without_a_subscriber_fails_in_bounded_time_and_is_named(restorer: StateRestorer) -> None:
    started_at = time.monotonic()
    report = await restorer.restore(KeptState((pose(),)), within=1.0)
    assert time.monotonic() - started_at < 10
    assert report.restored == ()
    assert report.problem.startswith(f"/amcl_pose: nobody subscribes to /initialpose as {POSE} within ")


async def test_parameters_are_set_and_nodes_brought_up_before_a_pose_finds_its_subscriber(
    localizer: Callable[..., None], restorer: StateRestorer, caller: InstanceCaller
) -> None:
    localizer()
    state = KeptState(
        (pose(),),
        (ParameterValues("/localizer", {"speed": 0.75}, 1.0),),
        (LifecycleState("/localizer", "active", 2.0),),
    )
    report = await restorer.restore(state, within=WITHIN)
    assert report.not_restored == ()
    assert sorted(names(report)) == ["/amcl_pose", "/localizer (lifecycle)", "/localizer (parameters)"]
    found = await restorer.inspect({"/localizer": ["speed"]}, ["/localizer"], within=WITHIN)
    assert found == {
        "parameters": {"/localizer": {"speed": 0.75}},
        "lifecycle": {"/localizer": "active"},
        "problems": [],
    }
    again = await restorer.restore(state, within=WITHIN)
    assert again.not_restored == (), "it can be done again"


async def test_a_sample_that_cannot_be_restored_does_not_block_others(
    localizer: Callable[..., None], restorer: StateRestorer, caller: InstanceCaller
) -> None:
    localizer()
    await caller.bring_to("/localizer", "inactive", WITHIN)
    state = KeptState(
        (pose(), KeptSample("/plan", "nav2_msgs/msg/Plan", 1.0, b"\0\1\0\0", to="/plan")),
        (ParameterValues("/localizer", {"nope": 1}, 1.0), ParameterValues("/localizer", {"speed": 0.5}, 1.0)),
        (),
        (NotRestored("/map", "what is kept is 61.0 s old, more than maxAge (1m)", failed=False),),
    )
    report = await restorer.restore(state, within=WITHIN)
    assert sorted(names(report)) == ["/amcl_pose", "/localizer (parameters)"]
    reasons = {entry.name: entry for entry in report.not_restored}
    assert "nope" in reasons["/localizer (parameters)"].reason
    assert "nav2_msgs/msg/Plan is not installed" in reasons["/plan"].reason
    assert reasons["/map"].reason == "what is kept is 61.0 s old, more than maxAge (1m)"
    assert "/map" not in report.problem, "what is too old was not tried"


async def test_only_named_samples_are_restored(
    localizer: Callable[..., None], restorer: StateRestorer, caller: InstanceCaller
) -> None:
    localizer()
    await caller.bring_to("/localizer", "inactive", WITHIN)
    state = KeptState((pose(),), (ParameterValues("/localizer", {"speed": 0.5}, 1.0),))
    report = await restorer.restore(state, within=WITHIN, only=["/amcl_pose", "/map"])
    assert names(report) == ["/amcl_pose"]
    assert_golden("agent", report.problem, "/map")
    found = await restorer.inspect({"/localizer": ["speed"]}, [], within=WITHIN)
    assert found["parameters"] == {"/localizer": {"speed": 0.25}}


async def test_the_first_instance_needs_no_state(restorer: StateRestorer) -> None:
    report = await restorer.restore(KeptState(), within=WITHIN, only=["/amcl_pose"])
    assert report.problem == ""
    assert report.not_restored == (NotRestored("/amcl_pose", "nothing is kept yet", failed=False),)


async def test_an_inspection_reports_what_is_unknown(localizer: Callable[..., None], restorer: StateRestorer) -> None:
    localizer()
    found = await restorer.inspect({"/localizer": ["speed"], "/gone": ["speed"]}, ["/localizer"], within=8.0)
    assert found["parameters"] == {"/localizer": {"speed": 0.25}}
    assert found["lifecycle"] == {"/localizer": "unconfigured"}
    (problem,) = found["problems"]
    assert (problem["kind"], problem["node"]) == ("parameters", "/gone")
    assert "/gone" in problem["reason"]


async def test_requests_contain_the_state_and_answers_the_report(
    localizer: Callable[..., None], restorer: StateRestorer, caller: InstanceCaller
) -> None:
    localizer()
    await caller.bring_to("/localizer", "inactive", WITHIN)
    operations = restorer.operations()
    answer = await operations["restore"]({"state": KeptState((pose(),)).to_wire(), "within": WITHIN}, PEER)
    assert answer is not None
    assert names(RestoreReport.from_wire(answer["report"])) == ["/amcl_pose"]
    asked = {"parameters": [{"node": "/localizer", "names": ["speed"]}], "lifecycle": ["/localizer"], "within": WITHIN}
    answer = await operations["inspect"](asked, PEER)
    assert answer is not None
    assert answer["lifecycle"] == {"/localizer": "inactive"}


@pytest.mark.parametrize(
    ("op", "body"),
    [
        ("restore", {"state": {"samples": [{"topic": "/a"}]}}),
        ("restore", {"state": {"samples": [{"topic": "/a", "type": "b", "takenAt": 1, "data": "?"}]}}),
        ("restore", {"state": {}, "within": -1}),
        ("inspect", {"parameters": [{"node": "/a"}]}),
        ("inspect", {"within": "long"}),
    ],
)
async def test_malformed_restore_requests_are_refused(restorer: StateRestorer, op: str, body: dict[str, Any]) -> None:
    with pytest.raises(Refused):
        await restorer.operations()[op](body, PEER)


def test_a_message_without_a_header_is_unchanged() -> None:
    from std_msgs.msg import String

    data = serialize_message(String(data="home"))
    assert stamped(KeptSample("/dock", "std_msgs/msg/String", 1.0, data, to="/dock", stamp="now")) == data


def test_bytes_that_are_not_a_message_are_reported() -> None:
    with pytest.raises(CallFailed, match="what is kept of /amcl_pose is no geometry_msgs"):
        stamped(KeptSample("/amcl_pose", POSE, 1.0, b"\0\1\0\0\1", to="/initialpose", stamp="now"))

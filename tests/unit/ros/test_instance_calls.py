"""Calls to real nodes in processes of their own."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.network_namespaces import Network, network
from tests.unit.ros.processes import PACKAGE, Processes
from understudy.api import names
from understudy.api.kinds.robot_workload import Gate
from understudy.ros.dds.profiles import mux_monitor_profiles_xml
from understudy.ros.rmw import MIDDLEWARE

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("dds")]

WITHIN = 60.0
"""Seconds for what succeeds at once on a machine that is not busy."""


class Managed(Processes):
    def start(self, kind: str = "") -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, str(Path(__file__).parent / "managed.py"), kind],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(PACKAGE)},
        )
        self._running.append(process)
        assert self.line(process, 30) == "ready"
        return process


@pytest.fixture
def managed(dds: None) -> Iterator[Managed]:
    started = Managed()
    yield started
    started.end()


@pytest.fixture
def caller(dds: None) -> Iterator[object]:
    from understudy.ros.actions.instance_calls import InstanceCaller

    made = InstanceCaller("caller")
    yield made
    made.close()


async def test_a_service_call_returns_the_fields_of_the_answer(managed: Managed, caller) -> None:
    managed.start()

    answer = await caller.call("/switch", "std_srvs/srv/SetBool", {"data": True}, WITHIN)

    assert answer == {"success": True, "message": "on"}


async def test_a_missing_service_is_reported(caller) -> None:
    from understudy.ros.actions.instance_calls import CallFailed

    with pytest.raises(CallFailed, match=r"service /switch \(std_srvs/srv/SetBool\) is not there within 0.3 s"):
        await caller.call("/switch", "std_srvs/srv/SetBool", {}, 0.3)


async def test_a_service_call_without_an_answer_times_out(managed: Managed, caller) -> None:
    from understudy.ros.actions.instance_calls import CallFailed

    managed.start()
    end = time.monotonic() + WITHIN
    while not await caller.service_present("/never"):
        assert time.monotonic() < end
        await asyncio.sleep(0.05)

    message = ""
    while message != "service /never has not answered within 1 s":  # it may be found only just before the end
        assert time.monotonic() < end, message
        with pytest.raises(CallFailed) as failure:
            await caller.call("/never", "std_srvs/srv/Trigger", {}, 1.0)
        message = str(failure.value)


async def test_a_service_call_with_a_repeat_time_is_repeated_after_a_lost_answer(managed: Managed, caller) -> None:
    managed.start()

    answer = await caller.call("/second", "std_srvs/srv/Trigger", {}, WITHIN, repeat=0.5)

    assert answer["success"] is True


async def test_a_request_that_does_not_match_the_type_names_the_field(caller) -> None:
    from understudy.ros.actions.instance_calls import CallFailed

    with pytest.raises(
        CallFailed, match=r"service /switch: dat: SetBool_Request has no field dat; did you mean data\?"
    ):
        await caller.call("/switch", "std_srvs/srv/SetBool", {"dat": True}, WITHIN)
    with pytest.raises(CallFailed, match="service /switch: data: expected boolean, found 'yes'"):
        await caller.call("/switch", "std_srvs/srv/SetBool", {"data": "yes"}, WITHIN)
    with pytest.raises(CallFailed, match="no_such_package/srv/X is not installed"):
        await caller.call("/switch", "no_such_package/srv/X", {}, WITHIN)


async def test_a_managed_node_changes_its_state_in_both_directions(managed: Managed, caller) -> None:
    from understudy.ros.actions.instance_calls import CallFailed

    managed.start()

    assert await caller.lifecycle_state("/managed", WITHIN) == "unconfigured"
    await caller.bring_to("/managed", "active", WITHIN)
    assert await caller.lifecycle_state("/managed", WITHIN) == "active"
    await caller.bring_to("/managed", "active", WITHIN)
    await caller.bring_to("/managed", "unconfigured", WITHIN)
    assert await caller.lifecycle_state("/managed", WITHIN) == "unconfigured"
    await caller.bring_to("/managed", "finalized", WITHIN)
    with pytest.raises(
        CallFailed, match="node /managed is finalized, and no lifecycle transition leads from there to active"
    ):
        await caller.bring_to("/managed", "active", WITHIN)
    with pytest.raises(CallFailed, match="'running' is not a state"):
        await caller.bring_to("/managed", "running", WITHIN)


async def test_a_slow_transition_is_awaited(managed: Managed, caller) -> None:
    managed.start("slow")

    await caller.bring_to("/managed", "inactive", WITHIN)

    assert await caller.lifecycle_state("/managed", WITHIN) == "inactive"


async def test_a_refused_transition_is_reported_and_can_be_retried(managed: Managed, caller) -> None:
    from understudy.ros.actions.instance_calls import CallFailed

    managed.start("refusing")

    with pytest.raises(CallFailed, match="node /managed did not activate: it is inactive"):
        await caller.bring_to("/managed", "active", WITHIN)
    await caller.bring_to("/managed", "active", WITHIN)


async def test_parameters_are_read_and_set_with_their_types(managed: Managed, caller) -> None:
    from understudy.ros.actions.instance_calls import CallFailed

    managed.start()

    await caller.set_parameters("/managed", {"speed": 2, "label": "b", "count": 3}, WITHIN)

    found = await caller.get_parameters("/managed", ["speed", "label", "count"], WITHIN)
    assert found == {"speed": 2.0, "label": "b", "count": 3}
    assert isinstance(found["speed"], float)
    with pytest.raises(CallFailed, match="node /managed has no parameter colour"):
        await caller.get_parameters("/managed", ["label", "colour"], WITHIN)
    with pytest.raises(CallFailed, match=r"node /managed refused parameters: label = 0\.5"):
        await caller.set_parameters("/managed", {"label": 0.5}, WITHIN)


async def test_a_message_waits_for_its_subscriber_and_arrives_once(managed: Managed, caller) -> None:
    from std_msgs.msg import String

    from understudy.ros.actions.instance_calls import CallFailed

    pose = {
        "header": {"frame_id": "map", "stamp": "now"},
        "pose": {"pose": {"position": {"x": 2}}, "covariance": [0.0] * 35 + [0.5]},
    }
    type_name = "geometry_msgs/msg/PoseWithCovarianceStamped"
    with pytest.raises(CallFailed, match=f"nobody subscribes to /initialpose as {type_name} within 0.3 s"):
        await caller.publish("/initialpose", type_name, pose, 0.3)
    began = time.time()
    publishing = asyncio.create_task(caller.publish("/initialpose", type_name, pose, WITHIN))
    await asyncio.to_thread(managed.start)
    await publishing

    sample = await caller.wait_sample("/taken", "std_msgs/msg/String", WITHIN, since=began)

    from rclpy.serialization import deserialize_message

    assert deserialize_message(sample.data, String).data == "map 2.0 0.5"
    with pytest.raises(CallFailed, match=r"nothing came on /taken \(std_msgs/msg/String\) within 1 s"):
        await caller.wait_sample("/taken", "std_msgs/msg/String", 1.0, since=time.time())


async def test_serialized_messages_are_published_unchanged(managed: Managed, caller) -> None:
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from rclpy.serialization import serialize_message

    managed.start()
    message = PoseWithCovarianceStamped()
    message.header.frame_id = "kept"
    type_name = "geometry_msgs/msg/PoseWithCovarianceStamped"

    await caller.publish("/initialpose", type_name, serialize_message(message), WITHIN)

    sample = await caller.wait_sample("/taken", "std_msgs/msg/String", WITHIN)
    assert b"kept 0.0 0.0" in sample.data


async def test_nodes_and_services_are_found(managed: Managed, caller) -> None:
    assert not await caller.node_present("/managed")
    managed.start()
    end = time.monotonic() + WITHIN
    while not (await caller.node_present("/managed") and await caller.service_present("/switch")):
        assert time.monotonic() < end
        await asyncio.sleep(0.05)
    assert not await caller.service_present("/nothing")


async def test_endpoints_of_other_hosts_do_not_count(managed: Managed, dds: None, graph) -> None:
    """Behind a discovery server an agent also learns of the other instances' servers, which it can't reach."""
    from understudy.ros.actions.calling_node import GraphLocation
    from understudy.ros.actions.instance_calls import CallFailed, InstanceCaller
    from understudy.ros.dds.host_ids import HOST

    managed.start()
    context = graph.node.context
    end = time.monotonic() + WITHIN
    while not (own := [e.gid[HOST] for e in graph.publishers("/parameter_events") if e.node == "/tested"]):
        assert time.monotonic() < end
        await asyncio.sleep(0.05)
    here = InstanceCaller("here", place=lambda: GraphLocation(context, own[0]))
    elsewhere = InstanceCaller("elsewhere", place=lambda: GraphLocation(context, b"\x01\x0f\x00\x00"))
    nowhere = InstanceCaller("nowhere", place=lambda: None)
    try:
        assert (await here.call("/switch", "std_srvs/srv/SetBool", {}, WITHIN))["message"] == "off"
        await here.bring_to("/managed", "inactive", WITHIN)
        with pytest.raises(CallFailed, match="is not there within 1 s"):
            await elsewhere.call("/switch", "std_srvs/srv/SetBool", {}, 1.0)
        with pytest.raises(CallFailed, match="nobody subscribes to /initialpose"):
            await elsewhere.publish("/initialpose", "geometry_msgs/msg/PoseWithCovarianceStamped", {}, 1.0)
        with pytest.raises(CallFailed, match=r"has not joined the ROS graph within 0\.2 s"):
            await nowhere.lifecycle_state("/managed", 0.2)
    finally:
        for one in (here, elsewhere, nowhere):
            one.close()


async def test_a_call_whose_node_is_closed_meanwhile_fails_with_a_reason(caller) -> None:
    from understudy.ros.actions.instance_calls import CallFailed

    calling = asyncio.create_task(caller.call("/missing", "std_srvs/srv/Trigger", {}, WITHIN))
    await asyncio.sleep(1.0)
    caller.close()
    with pytest.raises(CallFailed, match="service /missing: this process left the ROS graph during the call"):
        await asyncio.wait_for(calling, WITHIN)


async def test_a_cancelled_call_leaves_the_caller_usable(managed: Managed, caller) -> None:
    managed.start()
    await caller.call("/switch", "std_srvs/srv/SetBool", {}, WITHIN)
    hanging = asyncio.create_task(caller.call("/never", "std_srvs/srv/Trigger", {}, WITHIN))
    await asyncio.sleep(0.2)

    hanging.cancel()

    with pytest.raises(asyncio.CancelledError):
        await hanging
    assert (await caller.call("/switch", "std_srvs/srv/SetBool", {"data": True}, WITHIN))["success"]


async def test_an_idle_caller_closes_its_node_and_makes_another(
    managed: Managed, caller, monkeypatch: pytest.MonkeyPatch
) -> None:
    from understudy.ros.actions import instance_calls

    opened, closed = [], []

    class RecordedNode(instance_calls.CallingNode):
        def __init__(self, *arguments) -> None:
            super().__init__(*arguments)
            opened.append(self)

        def close(self) -> None:
            super().close()
            closed.append(self)

    monkeypatch.setattr(instance_calls, "IDLE", 0.05)
    monkeypatch.setattr(instance_calls, "CallingNode", RecordedNode)
    managed.start()
    await caller.call("/switch", "std_srvs/srv/SetBool", {}, WITHIN)
    assert len(opened) == 1
    end = time.monotonic() + WITHIN
    while closed != opened:
        assert time.monotonic() < end
        await asyncio.sleep(0.02)

    await caller.call("/switch", "std_srvs/srv/SetBool", {}, WITHIN)
    assert len(opened) == 2


LISTEN = """
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("listener")
node.create_subscription(String, "/initialpose", lambda message: print(message.data, flush=True), 10)
rclpy.spin(node)
"""


class Instances:
    """The process that publishes to the instance of its host, that instance, and one of another host that no packet reaches."""

    def __init__(
        self, running: Processes, lan: Network, known: str, profiles: Path | None = None, of_other: Path | None = None
    ) -> None:
        environment = {
            "ROS_DOMAIN_ID": "62",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
            "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
            "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
        }
        other, own = lan.host("10.62.0.2"), lan.host("10.62.0.3")
        listen, publish = ["-c", LISTEN], [str(Path(__file__).parent / "publishing.py"), "2", known]
        variable = MIDDLEWARE.settings_variable
        unreachable, self.instance, self._publisher = (
            running.start(
                [*host, sys.executable, *command],
                **environment,
                **{names.POD_VARIABLE: pod},
                **({variable: str(settings)} if settings is not None else {}),
            )
            for pod, host, command, settings in (
                ("w-2", other, listen, of_other or profiles),
                ("w-1", own, listen, profiles),
                ("w-1", own, publish, profiles),
            )
        )
        assert running.line(self._publisher, WITHIN) == "all"
        unreachable.send_signal(signal.SIGSTOP)

    def publish(self, text: str, within: float) -> str:
        """Publish a text, and return how that went."""
        assert self._publisher.stdin is not None
        self._publisher.stdin.write(f"{text} {within}\n")
        self._publisher.stdin.flush()
        return Processes.line(self._publisher, WITHIN + within)


@pytest.fixture(params=["named"])
def instances(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Instances]:
    running, known, profiles, of_other = Processes(), request.param, None, None
    if known in ("apart", "monitored"):  # by a mux, so that the nodes of the other one are never known
        profiles = tmp_path / "profiles.xml"
        profiles.write_text(MIDDLEWARE.instance_settings([], [], Gate(kind="Mux")))
        if known == "monitored":  # the other one is a monitor, whose readers are in the partitions of all instances
            of_other = tmp_path / "monitor.xml"
            of_other.write_text(mux_monitor_profiles_xml([]))
        known = "discovered"
    with network() as lan:
        try:
            yield Instances(running, lan, known, profiles, of_other)
        finally:
            running.end()


@pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root")
def test_an_unreachable_subscriber_delays_nothing(instances: Instances) -> None:
    """Instances of one workload know of each other's subscribers, and no packet passes between them."""
    assert instances.publish("here", WITHIN) == "published here"
    assert Processes.line(instances.instance, WITHIN) == "here"


@pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root")
@pytest.mark.parametrize(
    ("instances", "reason"),
    [
        ("apart", "the subscribers of /initialpose have not taken the message within 2 s"),
        ("monitored", "a message was sent on /initialpose, and .*"),
    ],
    ids=["an instance that a partition keeps apart", "a former monitor whose node was lost"],
    indirect=["instances"],
)
def test_a_subscriber_that_is_not_reached_with_a_mux_is_not_waited_for(instances: Instances, reason: str) -> None:
    # Discovery forgets the stopped one after 20 s.
    assert instances.publish("here", 10.0) == "published here"
    assert Processes.line(instances.instance, WITHIN) == "here"
    instances.instance.send_signal(signal.SIGSTOP)
    assert re.fullmatch(f"failed {reason}", instances.publish("early", 2.0))
    instances.instance.send_signal(signal.SIGCONT)
    assert instances.publish("late", WITHIN) == "published late"


@pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root")
def test_a_message_counts_as_received_only_after_an_answer_of_its_subscriber_if_another_one_is_unreachable(
    instances: Instances,
) -> None:
    """The middleware does not report whose acknowledgement is missing."""
    instances.instance.send_signal(signal.SIGSTOP)

    reason = "a message was sent on /initialpose, and node /listener has not answered since then within 3 s"
    assert instances.publish("early", 3.0) == f"failed {reason}"

    instances.instance.send_signal(signal.SIGCONT)
    assert instances.publish("late", WITHIN) == "published late"
    assert "late" in {Processes.line(instances.instance, WITHIN) for _ in range(2)}


@pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root")
@pytest.mark.parametrize("instances", ["discovered"], indirect=True)
def test_a_message_to_a_subscriber_of_a_node_without_a_known_name_does_not_count_as_received(
    instances: Instances,
) -> None:
    """Discovery finds a node's endpoints before its name, and a process may stop in between."""
    instances.instance.send_signal(signal.SIGSTOP)

    assert instances.publish("early", 3.0).startswith("failed a message was sent on /initialpose, and ")

    instances.instance.send_signal(signal.SIGCONT)
    assert instances.publish("late", WITHIN) == "published late"

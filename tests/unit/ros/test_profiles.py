"""The profiles name every gated reader once, each with its own port in the gated range."""

from xml.etree import ElementTree

import pytest

from understudy.api import names
from understudy.api.kinds.robot_workload import Output
from understudy.api.kinds.task_spec import Task
from understudy.ros.dds.profiles import gate_ports, instance_profiles_xml, profiles_xml

CMD_VEL = Output(topic="/cmd_vel", type="geometry_msgs/msg/Twist")
SNAP = Output(service="/snap", type="std_srvs/srv/Trigger")
GOTO = Output(action="/robot/goto", type="test_msgs/action/Fibonacci")


def test_the_profile_of_a_topic_has_its_name():
    assert gate_ports([CMD_VEL]) == {"/cmd_vel": 7950}


def test_a_service_is_gated_in_both_directions():
    assert gate_ports([SNAP]) == {"rq/snapRequest": 7950, "rr/snapReply": 7951}


def test_an_action_is_gated_in_both_directions():
    assert list(gate_ports([GOTO])) == [
        "rq/robot/goto/_action/send_goalRequest",
        "rr/robot/goto/_action/send_goalReply",
        "rq/robot/goto/_action/get_resultRequest",
        "rr/robot/goto/_action/get_resultReply",
        "rq/robot/goto/_action/cancel_goalRequest",
        "rr/robot/goto/_action/cancel_goalReply",
        "/robot/goto/_action/feedback",
        "/robot/goto/_action/status",
    ]


def test_ports_follow_the_order_of_the_outputs_and_never_repeat():
    ports = gate_ports([SNAP, CMD_VEL, GOTO])
    assert list(ports.values()) == list(range(7950, 7950 + 11))


def test_an_output_that_is_named_twice_uses_one_port():
    assert gate_ports([CMD_VEL, CMD_VEL, SNAP])["rq/snapRequest"] == 7951


def test_the_largest_workload_that_the_api_allows_fits():
    outputs = [Output(action=f"/a{i}", type="test_msgs/action/Fibonacci") for i in range(24)]
    ports = gate_ports(outputs)
    assert len(ports) == 24 * 8
    assert max(ports.values()) < names.PROBE_PORT


def test_an_output_without_a_free_port_is_reported():
    outputs = [Output(action=f"/a{i}", type="test_msgs/action/Fibonacci") for i in range(25)]
    with pytest.raises(ValueError, match=r"spec\.outputs: no gate port is left for /a24.*199 UDP ports"):
        gate_ports(outputs)


def test_the_file_has_one_reader_per_port():
    outputs = [CMD_VEL, SNAP, GOTO]
    root = ElementTree.fromstring(profiles_xml(outputs))
    space = {"d": "http://www.eprosima.com"}
    found = {
        reader.attrib["profile_name"]: int(reader.findtext(".//d:udpv4/d:port", namespaces=space) or 0)
        for reader in root.iterfind(".//d:data_reader", space)
    }
    assert found == gate_ports(outputs)


def test_names_are_escaped():
    odd = Output.model_construct(topic='/a"<b', service=None, action=None, type="std_msgs/msg/String")
    root = ElementTree.fromstring(profiles_xml([odd]))
    assert [r.attrib["profile_name"] for r in root.iter("{http://www.eprosima.com}data_reader")] == ['/a"<b']


def test_every_endpoint_of_a_task_is_in_the_partition_of_its_pod():
    text = instance_profiles_xml([Task(action="/goto", type="test_msgs/action/Fibonacci")])
    root = ElementTree.fromstring(text)
    partitions = {
        (entry.tag.partition("}")[2], entry.get("profile_name")): "".join(entry.itertext()).strip()
        for entry in root.iter()
        if entry.get("profile_name")
    }
    assert {name for kind, name in partitions if kind == "data_reader"} == {
        *(f"rq/goto/_action/{service}Request" for service in ("send_goal", "get_result", "cancel_goal")),
        *(f"rr/goto/_action/{service}Reply" for service in ("send_goal", "get_result", "cancel_goal")),
        "/goto/_action/feedback",
        "/goto/_action/status",
    }
    assert len(partitions) == 16
    assert set(partitions.values()) == {"understudy-${UNDERSTUDY_POD}"}


def test_without_tasks_instances_have_no_profiles():
    assert instance_profiles_xml([]) == ""

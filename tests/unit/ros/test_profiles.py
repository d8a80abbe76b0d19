"""The profiles name every gated reader once, each with its own port in the gated range."""

from xml.etree import ElementTree

import pytest

from understudy.api import names
from understudy.api.kinds.robot_workload import Output, Reflex
from understudy.api.kinds.task_spec import Task
from understudy.ros.dds.profiles import gate_ports, instance_profiles_xml, mux_profiles_xml, profiles_xml

CMD_VEL = Output(topic="/cmd_vel", type="geometry_msgs/msg/Twist")
SNAP = Output(service="/snap", type="std_srvs/srv/Trigger")
SPACE = {"d": "http://www.eprosima.com"}
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
    found = {
        reader.attrib["profile_name"]: int(reader.findtext(".//d:udpv4/d:port", namespaces=SPACE) or 0)
        for reader in root.iterfind(".//d:data_reader", SPACE)
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


def writers(*outputs: Output, reflex: Reflex | None = None) -> dict[str, tuple[float, float]]:
    """Lifespan and heartbeat period of each writer in an instance, in seconds."""
    root = ElementTree.fromstring(instance_profiles_xml([], outputs, reflex))

    def seconds(writer: ElementTree.Element, path: str) -> float:
        whole, nanoseconds = (int(writer.findtext(f"{path}/d:{unit}", "", SPACE)) for unit in ("sec", "nanosec"))
        return whole + nanoseconds / 1e9

    return {
        writer.attrib["profile_name"]: (
            seconds(writer, "d:qos/d:lifespan/d:duration"),
            seconds(writer, "d:times/d:heartbeatPeriod"),
        )
        for writer in root.iterfind(".//d:data_writer", SPACE)
    }


def test_every_writer_that_commands_the_robot_has_a_lifespan_of_about_one_period() -> None:
    assert writers(CMD_VEL, SNAP, GOTO) == {
        "/cmd_vel": (0.1, 0.025),
        "rq/snapRequest": (1.0, 0.25),
        "rq/robot/goto/_action/send_goalRequest": (1.0, 0.25),
        "rq/robot/goto/_action/cancel_goalRequest": (1.0, 0.25),
    }


def test_a_workload_sets_the_lifespan_of_an_output() -> None:
    slow = CMD_VEL.model_copy(update={"lifespan": "1m30s"})
    quick = SNAP.model_copy(update={"lifespan": "200ms"})
    assert writers(slow, quick) == {"/cmd_vel": (90.0, 3.0), "rq/snapRequest": (0.2, 0.05)}


def test_a_deadline_of_the_reflex_is_at_most_the_lifespan_of_topics() -> None:
    short, long = Reflex(deadline="40ms"), Reflex(deadline="5s")
    slow = CMD_VEL.model_copy(update={"lifespan": "300ms"})
    assert writers(CMD_VEL, SNAP, reflex=short) == {"/cmd_vel": (0.04, 0.01), "rq/snapRequest": (1.0, 0.25)}
    assert writers(CMD_VEL, reflex=long) == {"/cmd_vel": (0.1, 0.025)}
    assert writers(slow, reflex=short) == {"/cmd_vel": (0.3, 0.075)}, "what the workload says comes first"


def test_only_with_tasks_or_the_reflex_do_instances_have_profiles_of_readers() -> None:
    assert "<data_reader" not in instance_profiles_xml([], [CMD_VEL, SNAP, GOTO])
    assert instance_profiles_xml([]) == ""


def test_a_mux_that_starts_again_asks_its_discovery_server_ten_times_a_second() -> None:
    """Nothing reaches the robot until the server has answered: 0.4 s instead of 1.1 s (bench mux)."""
    root = ElementTree.fromstring(mux_profiles_xml([]))
    period = root.find(".//{*}participant[@is_default_profile='true']//{*}clientAnnouncementPeriod")
    assert period is not None
    assert [part.text for part in period] == ["0", "100000000"]

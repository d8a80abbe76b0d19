"""A reader that the gate cannot reach is reported; one that is not the robot's is no alarm."""

from __future__ import annotations

import pytest

from tests.support.golden import assert_golden
from understudy.api import names
from understudy.monitor.notices import ConditionReport
from understudy.monitor.observe.robot.reader_ports import Reading, judge
from understudy.ros.middleware import Locator

CMD_VEL, ARM = "/cmd_vel", "/arm/command"
GATED, DEFAULT = names.GATE_PORTS[0], 7411


def reading(host: str, port: int = GATED, *, node: str = "/base", topic: str = CMD_VEL) -> Reading:
    return Reading(topic, node, (Locator(host, port),))


def judged(
    *readings: Reading,
    topics: tuple[str, ...] = (CMD_VEL,),
    unreported: tuple[str, ...] = (),
    robots: tuple[str, ...] = (),
) -> ConditionReport:
    return judge("robot-17", topics, readings, unreported, robots)


def test_a_robot_that_reads_at_gate_ports_has_no_problem() -> None:
    status, reason, message = judged(reading("10.1.0.7"))
    assert (status, reason) == ("True", "AtGatedPorts")
    assert_golden("monitor", message, "/cmd_vel", "/base", "10.1.0.7:7950")


def test_a_robot_without_the_profile_is_reported_with_a_cure() -> None:
    status, reason, message = judged(reading("10.1.0.7", DEFAULT))
    assert (status, reason) == ("False", "ReaderWithoutProfile")
    assert "/cmd_vel by /base at 10.1.0.7:7411" in message
    assert "understudy robot-profile robot-17" in message


def test_each_output_is_judged_separately() -> None:
    topics = (CMD_VEL, ARM)
    both = judged(reading("10.1.0.7"), reading("10.1.0.7", DEFAULT, node="/arm", topic=ARM), topics=topics)
    assert both[:2] == ("False", "ReaderWithoutProfile")
    assert "/arm/command by /arm" in both[2]
    assert "/cmd_vel by" not in both[2]
    assert judged(reading("10.1.0.7"), topics=topics)[:2] == ("Unknown", "NobodyReads")


def test_an_output_without_readers_is_reported() -> None:
    status, reason, message = judged()
    assert (status, reason) == ("Unknown", "NobodyReads")
    assert message.startswith("No process of the robot reads /cmd_vel.")


@pytest.mark.parametrize(
    "node",
    ["/_ros2cli_4711", "/rosbag2_recorder", "/fleet/rosbag2_recorder", "/understudy_watch_12", "/understudy_init_12"],
)
def test_readers_of_tools_do_not_count_as_the_robot(node: str) -> None:
    alone = judged(reading("10.1.0.9", DEFAULT, node=node))
    assert alone[:2] == ("Unknown", "NobodyReads")
    assert node in alone[2]
    beside = judged(reading("10.1.0.7"), reading("10.1.0.9", DEFAULT, node=node))
    assert beside[:2] == ("True", "ReadPastTheGate")


def test_an_ungated_reader_next_to_a_gated_robot_is_mentioned_but_no_problem() -> None:
    status, reason, message = judged(reading("10.1.0.7"), reading("10.1.0.9", DEFAULT, node="/display"))
    assert (status, reason) == ("True", "ReadPastTheGate")
    assert "/cmd_vel by /display at 10.1.0.9:7411" in message


def test_outside_the_cluster_a_host_needs_one_gated_reader() -> None:
    robots = ("10.20.17.4/32", "10.20.17.5/32")
    display = reading("10.20.17.4", DEFAULT, node="/display")
    assert judged(reading("10.20.17.4"), display, robots=robots)[1] == "ReadPastTheGate"
    assert judged(reading("10.20.17.5"), display, robots=robots)[:2] == ("False", "ReaderWithoutProfile")
    assert judged(reading("10.20.17.5"), display)[1] == "ReadPastTheGate", "where nobody said whose address it is"


def test_one_ungated_port_of_several_is_a_problem() -> None:
    group = Reading(CMD_VEL, "/base", (Locator("10.1.0.7", GATED), Locator("239.255.0.1", 7401)))
    assert judged(group)[:2] == ("False", "ReaderWithoutProfile")


def test_readers_that_discovery_does_not_report_are_unknown() -> None:
    assert judged(unreported=(CMD_VEL,))[:2] == ("Unknown", "ReadersUnknown")
    assert judged(reading("10.1.0.7"), unreported=(CMD_VEL,))[:2] == ("Unknown", "ReadersUnknown")
    assert judged(reading("10.1.0.7", DEFAULT), unreported=(CMD_VEL,))[:2] == ("False", "ReaderWithoutProfile")
    assert judged(topics=(CMD_VEL, ARM), unreported=(CMD_VEL,))[:2] == ("Unknown", "NobodyReads")


def test_a_node_without_a_known_name_is_reported_by_its_address() -> None:
    assert "/cmd_vel by an unnamed node at 10.1.0.7:7411" in judged(reading("10.1.0.7", DEFAULT, node=""))[2]

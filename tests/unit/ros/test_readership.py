"""A monitor tells who reads an output past the gate, and that nobody does: real nodes on hosts of their own."""

from __future__ import annotations

import json
import os
import time

import pytest

pytest.importorskip("rclpy")

from tests.support.network_namespaces import network
from understudy.api.kinds.robot_workload import Output
from understudy.ros.dds.profiles import profiles_xml

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root"),
]

MONITOR, INSTANCE, ROBOT, COMPANION = (f"10.77.0.{host}" for host in range(2, 6))


def test_readers_of_the_robot_are_reported_with_the_ports_at_which_they_listen(
    processes, monkeypatch, tmp_path
) -> None:
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE")
    file = tmp_path / "profiles.xml"
    file.write_text(profiles_xml([Output(topic="/chat", type="std_msgs/msg/String")]))
    profile = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(file)}
    arguments = {"address": MONITOR, "instances": {"w-1": INSTANCE}, "robots": [f"{COMPANION}/32"]}

    def expected(reason: str) -> str:
        end = time.monotonic() + 30
        while True:
            line = processes.line(monitor, end - time.monotonic())
            type_, _, found, message = json.loads(line)
            assert type_ == "OutputsRead"
            if found == reason:
                return message

    with network() as lan:
        processes.node("obey", "/chat", "{}", inside=lan.host(INSTANCE))
        monitor = processes.node(json.dumps(arguments), inside=lan.host(MONITOR), script="reading.py", **profile)
        expected("NobodyReads")
        processes.node("obey", "/chat", "{}", inside=lan.host(ROBOT), **profile)
        assert (
            expected("AtGatedPorts")
            == f"The robot reads at ports that the gate controls: /chat by /robot at {ROBOT}:7950."
        )
        processes.node("obey", "/chat", "{}", inside=lan.host(COMPANION))
        assert f"/chat by /robot at {COMPANION}:" in expected("ReaderWithoutProfile")

"""What Understudy says on /diagnostics is heard by everybody, and taken for evidence by no health tree."""

from __future__ import annotations

import json
import time
from typing import Any

import pytest

pytest.importorskip("rclpy")

from tests.unit.ros.judged_tree import Judged, tell
from understudy.ros.actions.diagnostics_topic import Diagnostics, Status
from understudy.ros.observe.message_contents import OURS, ours

pytestmark = pytest.mark.ros

TYPE = "diagnostic_msgs/msg/DiagnosticArray"
FAILED = Status(2, "understudy: robot-1-drive", "no /cmd_vel for 500 ms", "fleet/robot-1-drive", [("gate epoch", "3")])


def test_another_process_reads_level_reason_and_values(graph: Any, processes: Any, eventually: Any) -> None:
    diagnostics = Diagnostics(graph)
    reader = processes.node("diagnoses", script="viewing.py")
    eventually(lambda: diagnostics.readers)
    diagnostics.publish(FAILED, 1.7e9 + 0.25)
    assert json.loads(processes.line(reader, 20)) == {
        "at": pytest.approx(1.7e9 + 0.25, abs=1e-3),
        "level": 2,
        "name": "understudy: robot-1-drive",
        "message": "no /cmd_vel for 500 ms",
        "hardware": "fleet/robot-1-drive",
        "values": {"gate epoch": "3"},
    }
    diagnostics.close()
    assert not graph.publishers("/diagnostics")


def test_diagnostics_of_understudy_are_ignored_by_levels_and_gaps(
    watching: Any, graph: Any, processes: Any, eventually: Any
) -> None:
    """Whoever publishes it, since a standby's agent hears the monitor, and one monitor another's."""
    judged = Judged(
        watching,
        {
            "parallel": [
                {"diagnostics": {"worst": "WARN"}},
                {"name": "heard", "topic": {"name": "/diagnostics", "gap": "1h", "type": TYPE}},
            ]
        },
    )
    other = processes.node("say", "/diagnostics", TYPE)
    tell(other, status=[{"name": "understudy: robot-2-drive", "level": 2}])
    own = Diagnostics(graph)
    eventually(lambda: own.readers)
    taken = 0

    def drained() -> bool:
        nonlocal taken
        own.publish(FAILED, time.time())
        taken += watching.drain()
        return taken > 40 and len(graph.publishers("/diagnostics")) == 2

    eventually(drained)
    assert judged.now().state == "Starting"
    assert watching.topic("/diagnostics").count == 0
    assert not watching.records("/diagnostics")
    application = processes.node("say", "/diagnostics", TYPE)
    tell(application, status=[{"name": "lidar", "level": 0}])
    eventually(lambda: judged.now().state == "Healthy")
    own.publish(FAILED, time.time())
    assert judged.now().state == "Healthy"
    tell(application, status=[{"name": "lidar", "level": 2, "message": "dead"}])
    eventually(lambda: judged.now().state == "Failed")
    assert judged.now().reason.startswith("/diagnostics: status 'lidar' is ERROR (dead), but ")


@pytest.mark.parametrize(
    ("frame", "names", "expected"),
    [
        ("", ["understudy: w"], True),
        ("", ["understudy: w", "lidar"], True),
        ("", ["lidar", "understudy: w"], False),
        ("", ["understudy"], False),
        ("", [], False),
        ("understudy: ", ["lidar"], False),
    ],
)
def test_diagnostics_of_understudy_are_recognized_by_their_first_bytes(
    frame: str, names: list[str], expected: bool
) -> None:
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
    from rclpy.serialization import serialize_message

    array = DiagnosticArray(status=[DiagnosticStatus(name=name) for name in names])
    array.header.frame_id = frame
    array.header.stamp.sec = 1_700_000_000
    data = bytes(serialize_message(array))
    assert ours(data) is expected
    assert ours(data[:OURS]) is expected

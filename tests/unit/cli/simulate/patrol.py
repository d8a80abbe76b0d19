"""The recording that docs/trying.md is about: a robot on patrol, with what went wrong on the way."""

from __future__ import annotations

import random
from pathlib import Path

from tests.support.bag_recording import RecordedMessage, write


def record(folder: Path) -> Path:
    """Write the bag ``patrol`` into a folder."""
    chance = random.Random(1)

    def steady(topic: str, type_: str, begin: float, end: float, hertz: float) -> list[RecordedMessage]:
        count = round((end - begin) * hertz)
        return [RecordedMessage(begin + (n + chance.uniform(0, 0.3)) / hertz, topic, type_) for n in range(count)]

    def goal(at: float, status: int) -> RecordedMessage:
        fields = {"status_list": [{"status": status}]}
        return RecordedMessage(at, "/navigate_to_pose/_action/status", "action_msgs/msg/GoalStatusArray", fields)

    twist, odometry = "geometry_msgs/msg/Twist", "nav_msgs/msg/Odometry"
    battery = "sensor_msgs/msg/BatteryState"
    messages = [
        RecordedMessage(0.0, "/battery_state", battery, {"percentage": 0.3}),
        *steady("/scan", "sensor_msgs/msg/LaserScan", 0, 60, 10),
        *steady("/odom", odometry, 0, 33, 30),
        *steady("/odom", odometry, 33, 38, 12),
        *steady("/odom", odometry, 38, 60, 30),
        goal(5, 2),
        *steady("/cmd_vel", twist, 5.3, 21.4, 20),
        *steady("/cmd_vel", twist, 24.1, 40, 20),
        goal(40.2, 4),
        *(
            RecordedMessage(float(at), "/battery_state", battery, {"percentage": 0.3 - at * 0.003})
            for at in range(1, 60)
        ),
    ]
    return write(folder / "patrol", messages)

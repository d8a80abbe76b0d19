"""A running tree and its snapshot, for tests."""

from __future__ import annotations

from typing import Any

from tests.unit.trees.world import START, World
from understudy.trees.core.snapshots import Snapshot, snapshot

TREE: dict[str, Any] = {
    "sequence": [
        {"topic": {"name": "/scan", "gap": "1s"}},
        {
            "name": "driving",
            "while": {"task_active": {"action": "/go"}},
            "do": {"topic": {"name": "/cmd_vel", "gap": "500ms"}},
        },
        {"selector": [{"value": {"topic": "/battery", "type": "sensor_msgs/msg/BatteryState", "holds": "percentage > 0.2"}}]},
    ]
}  # fmt: skip


def taken(world: World, now: float) -> Snapshot:
    world.at(now)
    found = snapshot(world.tree, world.observed(), START + now)
    assert found is not None
    return found

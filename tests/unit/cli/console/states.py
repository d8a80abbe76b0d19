"""What a monitor says, as it says it."""

from __future__ import annotations

from typing import Any


def leaf(name: str, state: str = "Healthy", *, received: int | None = 10, age: float | None = 0.05, **more: Any) -> Any:
    found = {"name": name, "kind": "topic", "state": state, "reason": "", "topic": f"/{name}", **more}
    return found | ({"received": received, "age": age} if received is not None else {})


def state(time: float = 100.0, health: str = "Healthy", **more: Any) -> dict[str, Any]:
    driving = {
        "name": "driving", "kind": "while", "task": "/navigate_to_pose", "state": "Idle", "reason": "",
        "children": [leaf("cmd_vel", "Idle", received=0, age=None)],
    }  # fmt: skip
    found: dict[str, Any] = {
        "workload": "robot-1-drive", "namespace": "fleet", "policy": "navigation", "time": time, "health": health,
        "active": "robot-1-drive-abc", "epoch": 3, "strategy": "Executing", "recoveries": 2, "notes": [],
        "conditions": [{"type": "Monitored", "status": "True", "reason": "Watching", "message": "Watching /scan."}],
        "tree": {
            "name": "parallel", "kind": "parallel", "state": "Healthy", "reason": "",
            "children": [leaf("scan"), driving, leaf("node", received=None, kind="publisher")],
        },
    }  # fmt: skip
    return found | more

"""A health tree as it is reported to /diagnostics, for tests."""

from __future__ import annotations

from typing import Any

TREE: dict[str, Any] = {
    "name": "parallel", "kind": "parallel", "state": "Failed", "reason": "",
    "children": [
        {"name": "scan", "kind": "topic", "state": "Healthy", "reason": "", "topic": "/scan"},
        {"name": "cmd_vel", "kind": "topic", "state": "Failed", "reason": "no /cmd_vel for 500 ms", "topic": "/cmd_vel"},
    ],
}  # fmt: skip

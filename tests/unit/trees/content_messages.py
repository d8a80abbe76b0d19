"""Messages whose content leaves judge, for tests."""

from typing import Any


def value(holds: str = "percentage > 0.15", **more: Any) -> dict[str, Any]:
    return {"value": {"topic": "/battery", "type": "t/msg/Battery", "holds": holds, **more}}


def age(most: str = "300ms", **more: Any) -> dict[str, Any]:
    return {"age": {"topic": "/scan", "most": most, **more}}


def levels(**more: Any) -> dict[str, Any]:
    return {"diagnostics": {"worst": "WARN", **more}}


class Status:
    def __init__(self, name: str, level: int, message: str = "") -> None:
        self.name, self.level, self.message = name, bytes([level]), message


class Array:
    def __init__(self, *status: Status) -> None:
        self.status = status


def during(node: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"while": {"task_active": {"action": "/go"}}, "do": node, **more}

"""Messages without ROS: objects that say their fields as rosidl's classes do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from understudy.trees.core.observations import Unreadable

TYPES: dict[str, dict[str, str]] = {
    "t/msg/Battery": {
        "header": "std_msgs/Header",
        "percentage": "float",
        "charging": "boolean",
        "level": "octet",
        "name": "string",
        "cells": "sequence<float>",
        "covariance": "double[4]",
        "packs": "sequence<t/Pack>",
    },
    "t/msg/Pack": {"name": "string", "temperature": "double"},
    "t/action/Go_Feedback": {
        "distance_remaining": "float",
        "number_of_recoveries": "int16",
        "current_pose": "t/Pack",
    },
    "std_msgs/msg/Float32": {"data": "float"},
    "std_msgs/msg/Header": {"frame_id": "string"},
}


def fields(type_name: str) -> dict[str, str] | None:
    return TYPES.get(type_name)


class Message:
    """A message with the fields of its type; what is beside them is no field."""

    secret = 7
    _type = ""

    def __init__(self, **values: Any) -> None:
        self.__dict__.update(values)

    @classmethod
    def get_fields_and_field_types(cls) -> dict[str, str]:
        return dict(TYPES[cls._type])


class Pack(Message):
    _type = "t/msg/Pack"


class Header(Message):
    _type = "std_msgs/msg/Header"


class Battery(Message):
    _type = "t/msg/Battery"


class Figure(Message):
    _type = "std_msgs/msg/Float32"


@dataclass
class Goal:
    """unique_identifier_msgs/UUID."""

    uuid: list[int]


class Feedback(Message):
    """What is sent on an action's feedback topic."""

    _type = "t/action/Go_FeedbackMessage"

    def __init__(self, goal: int = 1, **values: Any) -> None:
        super().__init__(goal_id=Goal([goal] * 16), feedback=GoFeedback(**values))


class GoFeedback(Message):
    _type = "t/action/Go_Feedback"


@dataclass
class Log:
    """Of rcl_interfaces/msg/Log what matters."""

    level: int
    name: str
    msg: str
    file: str = ""


@dataclass
class ReceivedMessage:
    """A received message; what isn't one cannot be read."""

    received: float
    content: object = None
    late: float | None = None
    way: float | None = None

    def message(self) -> object:
        if isinstance(self.content, str):
            raise Unreadable(self.content)
        return self.content

    def age(self) -> float | None:
        return self.late

    def under_way(self) -> float | None:
        return self.way

    def older(self, stamp: float) -> float:
        return self.received - stamp

    def mentions(self, text: str) -> bool:
        return True

    def byte(self, place: int) -> int | None:
        return None

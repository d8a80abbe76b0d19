"""The outputs of a workload to its robot, as the monitor sends them to an agent.

The contents are those of :class:`understudy.api.kinds.robot_workload.Output`. That is a pydantic model, which would
cost a tenth of a second and 9 MB in every pod.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from understudy.api.ros_names import ROS_NAME_MESSAGE, ROS_NAME_PATTERN, ROS_TYPE_MESSAGE, ROS_TYPE_PATTERN

_LONGEST = 256  # characters, as in the API


@dataclass(frozen=True)
class Output:
    """A topic, service or action; the others are None."""

    type: str
    topic: str | None = None
    service: str | None = None
    action: str | None = None

    @classmethod
    def from_wire(cls, data: object) -> Output:
        """Read an entry of a ``configure`` request; unknown fields are ignored. Raises ValueError."""
        if not isinstance(data, Mapping):
            raise ValueError(f"an output is a mapping, not {data!r:.100}")
        names = {key: data.get(key) for key in ("topic", "service", "action")}
        for key, name in names.items():
            if name is not None and not _is(ROS_NAME_PATTERN, name):
                raise ValueError(f"outputs: {key} {name!r:.100}: {ROS_NAME_MESSAGE}")
        if not _is(ROS_TYPE_PATTERN, data.get("type")):
            raise ValueError(f"outputs: type {data.get('type')!r:.100}: {ROS_TYPE_MESSAGE}")
        return cls(data["type"], **names)

    @property
    def name(self) -> str:
        """The topic's, service's or action's name."""
        return self.topic or self.service or self.action or ""


def _is(pattern: str, text: object) -> bool:
    return isinstance(text, str) and len(text) <= _LONGEST and re.fullmatch(pattern, text) is not None

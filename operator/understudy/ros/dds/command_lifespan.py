"""How long a command that the robot has not received stays valid, as DDS lifespan in XML profiles.

A reliable writer keeps its last samples until the reader has acknowledged them. Without a lifespan, the writers of a
standby deliver this whole history when the gate opens, with commands that are seconds old. Fast DDS removes a sample
from the writer's history when its lifespan ends (DDS 1.4, 2.2.3.16). It measures the age by the clock of the writer's
own host, so the clocks of other hosts do not matter.

rmw_fastrtps keeps the lifespan of a profile if the node sets none, and it keeps the times of a writer.
"""

from __future__ import annotations

from understudy.ros.dds.xml_durations import seconds_xml

_HEARTBEATS = 4
"""Heartbeats within a lifespan. With the period of Fast DDS (3 s), a lost sample that no other one follows would expire
before the reader learned of it and could ask for it again."""

_LONGEST_HEARTBEAT = 3.0
"""The heartbeat period of Fast DDS, in seconds."""


def writer_qos(length: float) -> str:
    """Return the QoS of a writer whose samples are valid for so many seconds."""
    return f"<lifespan><duration>{seconds_xml(length)}</duration></lifespan>"


def writer_times(length: float) -> str:
    """Return the times of a writer whose samples are valid for so many seconds."""
    period = min(length / _HEARTBEATS, _LONGEST_HEARTBEAT)
    return f"<times><heartbeatPeriod>{seconds_xml(period)}</heartbeatPeriod></times>"

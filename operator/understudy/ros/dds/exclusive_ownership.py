"""DDS exclusive ownership in XML profiles, with which a robot's reader changes from one writer to another by itself.

A reader with exclusive ownership delivers only the samples of the strongest live writer. It changes to the next one if
that writer was silent for the reader's deadline (DDS 1.4, 2.2.3.9 and 2.2.3.7). rmw_fastrtps keeps ownership, strength
and deadline of a profile if the node itself sets no deadline. Reader and writer match only if both are exclusive and
the writer offers a deadline that is not longer than the reader's.
"""

from __future__ import annotations

from understudy.api import names
from understudy.api.base import seconds
from understudy.api.kinds.robot_workload import Reflex
from understudy.ros.dds.xml_durations import seconds_xml

OFFERED = 0.9
"""Fraction of the reader's deadline that writers offer, so that rounding does not make the two incompatible."""

_EXCLUSIVE = "<ownership><kind>EXCLUSIVE</kind></ownership>"


def robot_reader(reflex: Reflex) -> str:
    """Return the QoS of an output's reader on the robot's side.

    It is also that of the monitor, which must receive what the robot receives.
    """
    return f"<qos>{_EXCLUSIVE}{_deadline(seconds(reflex.deadline))}</qos>"


def instance_reader() -> str:
    """Return the elements of QoS for an output's readers in an instance's pod: they match its writers, without a deadline."""
    return _EXCLUSIVE


def instance_writer(reflex: Reflex) -> str:
    """Return the elements of QoS for an output's writers in an instance.

    Their strength is filled in when the pod starts (api/protocol/ownership_strength.py).
    """
    value = f"${{{names.STRENGTH_VARIABLE}}}"
    strength = f"<ownershipStrength><value>{value}</value></ownershipStrength>"
    return f"{_EXCLUSIVE}{strength}{_deadline(OFFERED * seconds(reflex.deadline))}"


def _deadline(length: float) -> str:
    return f"<deadline><period>{seconds_xml(length)}</period></deadline>"

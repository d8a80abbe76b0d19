"""Refuses an unsafe reflex: it must not let a robot follow two instances at the same time, or none."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.controller.pods import instance_pod
from understudy.ros.rmw import MIDDLEWARE

_NO_TOPIC = "spec.gate.reflex: spec.outputs has no topic, and the reflex works only for topics. Remove spec.gate.reflex"


def problem(spec: RobotWorkloadSpec, template: Mapping[str, Any]) -> str | None:
    """Return why the reflex of a workload is unsafe, and how to correct it; None if it is safe."""
    reflex = spec.gate.reflex
    if reflex is None:
        return None
    topics = [output.name for output in spec.outputs if output.topic]
    if spec.gate.is_at_robot:
        return None if topics else _NO_TOPIC
    if spec.workload_ref is not None:
        return (
            f"spec.gate.reflex: Understudy does not change the pods of {spec.workload_ref.kind} {spec.workload_ref.name}, so their DDS "
            "writers have no ownership strength, and a robot's reader with exclusive ownership would receive nothing from them. Use "
            "spec.template instead of spec.workloadRef, or remove spec.gate.reflex"
        )
    if own := instance_pod.own_profiles(template):
        return (
            f"spec.gate.reflex: container {', '.join(own)} of spec.template sets the environment variable "
            f"{MIDDLEWARE.settings_variable} itself, so its DDS writers have no ownership strength, and the robot would receive nothing "
            "from them. Remove the variable, or remove spec.gate.reflex"
        )
    if not topics:
        return _NO_TOPIC
    others = [output.name for output in spec.outputs if not output.topic]
    if len(topics) == 1 and not others:
        return None
    missing = [output.name for output in spec.outputs if output.name not in reflex.accept]
    if not missing:
        return None
    why = []
    if len(topics) > 1:
        why.append(
            f"each of the topics ({', '.join(topics)}) switches independently, so the robot may follow different instances on "
            "different topics"
        )
    if others:
        why.append(
            f"{', '.join(others)} (service or action) has no exclusive owner: the admitted standby could use it while the "
            "active instance does"
        )
    return (
        f"spec.gate.reflex is unsafe with these outputs: {'; and '.join(why)}. Remove spec.gate.reflex, or accept this risk: "
        f"list all these outputs in spec.gate.reflex.accept (missing: {', '.join(missing)})"
    )

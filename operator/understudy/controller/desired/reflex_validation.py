"""Refuses an unsafe reflex: it must not let a robot follow two instances at the same time, or none."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.controller.pods import instance_pod
from understudy.ros.rmw import MIDDLEWARE


def problem(spec: RobotWorkloadSpec, template: Mapping[str, Any]) -> str | None:
    """Return why the reflex of a workload is unsafe, and how to correct it; None if it is safe."""
    reflex = spec.gate.reflex
    if reflex is None:
        return None
    if spec.workload_ref is not None:
        return (
            f"spec.gate.reflex: the pods of {spec.workload_ref.kind} {spec.workload_ref.name} are left as they are, so their "
            "writers have no strength and a robot's reader with exclusive ownership would receive none of them. Give the pods "
            "as spec.template instead of workloadRef, or leave reflex out"
        )
    if own := instance_pod.own_profiles(template):
        return (
            f"spec.gate.reflex: container {', '.join(own)} of spec.template sets {MIDDLEWARE.settings_variable} itself, so its "
            "writers have no strength and the robot would receive none of them. Remove the variable, or remove reflex"
        )
    topics = [output.name for output in spec.outputs if output.topic]
    if not topics:
        return "spec.gate.reflex: outputs has no topic, and services and actions have no reflex. Remove reflex"
    others = [output.name for output in spec.outputs if not output.topic]
    if len(topics) == 1 and not others:
        return None
    missing = [output.name for output in spec.outputs if output.name not in reflex.accept]
    if not missing:
        return None
    why = []
    if len(topics) > 1:
        why.append(
            f"each topic ({', '.join(topics)}) switches by itself, so the robot may follow different instances on "
            "different topics"
        )
    if others:
        why.append(
            f"{', '.join(others)} (service or action) has no exclusive owner: the admitted standby could use it while the "
            "active instance does"
        )
    return (
        f"spec.gate.reflex is unsafe with these outputs: {'; and '.join(why)}. Remove reflex, or accept that by naming all "
        f"of them in spec.gate.reflex.accept (missing: {', '.join(missing)})"
    )

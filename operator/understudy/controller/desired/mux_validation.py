"""Refuses a workload whose instances cannot be kept in partitions of their own, so that a mux could not tell them apart."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.controller.pods import instance_pod
from understudy.ros.rmw import MIDDLEWARE


def problem(spec: RobotWorkloadSpec, template: Mapping[str, Any]) -> str | None:
    """Return why a mux cannot forward the outputs of a workload, and how to correct it; None if it can, or if there is none."""
    if not spec.gate.is_at_robot:
        return None
    if spec.gate.on_board is not None and not any(output.topic for output in spec.outputs):
        return (
            "spec.gate.mux.onBoard: the mux notices by the silence on a topic that an instance does not reach it, and spec.outputs has no "
            "topic. Add one, or remove spec.gate.mux.onBoard"
        )
    if spec.workload_ref is not None:
        return (
            f"spec.gate.kind: Understudy does not change the pods of {spec.workload_ref.kind} {spec.workload_ref.name}, so their writers "
            "are in no partition, and each of these pods would reach the robot beside the mux. Use spec.template instead of "
            "spec.workloadRef, or gate kind NetworkPolicy"
        )
    if own := instance_pod.own_profiles(template):
        return (
            f"spec.gate.kind: container {', '.join(own)} of spec.template sets the environment variable {MIDDLEWARE.settings_variable} "
            "itself, so its writers are in no partition, and it would reach the robot beside the mux. Remove the variable, or use gate "
            "kind NetworkPolicy"
        )
    return None

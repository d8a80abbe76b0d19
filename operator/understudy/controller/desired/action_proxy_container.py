"""The objects for tasks: action endpoints that only an instance's own agent reaches, and one proxy for all instances."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from understudy.api import names
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.controller.plan import config_map
from understudy.controller.pods import instance_pod
from understudy.kube.client import Object
from understudy.ros.rmw import MIDDLEWARE


def proxied(spec: RobotWorkloadSpec) -> bool:
    """Whether a workload has an action proxy.

    Pods of a referred controller cannot be prevented from serving under the plain name.
    """
    return bool(spec.tasks) and spec.workload_ref is None


def instance_profiles(spec: RobotWorkloadSpec) -> str:
    """Return the DDS profiles of the instances; empty if they need none."""
    return MIDDLEWARE.instance_settings(spec.tasks if proxied(spec) else [], spec.outputs, spec.gate)


def profiles_map(workload: str, profiles: str) -> Object:
    """Return the ConfigMap that instances mount."""
    return config_map(names.instance_profiles(workload), {names.PROFILES_KEY: profiles})


def problem(workload: str, spec: RobotWorkloadSpec, template: Mapping[str, Any]) -> str:
    """Return why the tasks have no proxy, or a proxy with limitations; empty if there is no problem."""
    if spec.tasks and spec.workload_ref is not None:
        return (
            f"spec.tasks: the pods of {spec.workload_ref.kind} {spec.workload_ref.name} serve {_actions(spec)} "
            f"directly, so the action proxy cannot keep goals during a failover. Use spec.template instead of spec.workloadRef"
        )
    if proxied(spec) and (own := instance_pod.own_profiles(template)):
        return (
            f"spec.template: container {', '.join(own)} sets the environment variable {MIDDLEWARE.settings_variable} itself, so "
            f"clients reach {_actions(spec)} without the action proxy, and their goals end with the instance. Remove the variable, or "
            f"add the profiles of ConfigMap {names.instance_profiles(workload)} to the file that it names"
        )
    return ""


def _actions(spec: RobotWorkloadSpec) -> str:
    return ", ".join(task.action for task in spec.tasks)

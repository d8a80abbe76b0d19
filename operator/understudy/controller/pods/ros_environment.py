"""The ConfigMaps for processes on the robot's side: their environment, the settings of their ROS middleware, and those of a mux."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from understudy.api import names
from understudy.api.kinds.robot_workload import Gate, Output
from understudy.controller.plan import config_map
from understudy.kube.client import Object
from understudy.ros.rmw import MIDDLEWARE

PROFILES_DIR = "/etc/understudy"
PROFILES_KEY = "profiles.xml"
PROFILES_FILE = f"{PROFILES_DIR}/{PROFILES_KEY}"


MONITOR_KEY = "monitor.xml"
"""The profiles of the monitor, if they differ from those of the robot."""


def config_maps(
    workload: str, environment: Mapping[str, str], outputs: Sequence[Output], gate: Gate, namespace: str = ""
) -> list[Object]:
    """Return the ConfigMaps with the environment (``envFrom``) and the profiles (mounted at PROFILES_DIR), and with what a mux and an
    instance on board need besides.

    Raises ValueError if there are not enough gated ports for the outputs.
    """
    robots, monitors = MIDDLEWARE.robot_settings(outputs, gate), MIDDLEWARE.monitor_settings(outputs, gate)
    variables = {**environment, MIDDLEWARE.settings_variable: PROFILES_FILE}
    profiles = {PROFILES_KEY: robots} | ({MONITOR_KEY: monitors} if monitors != robots else {})
    found = [
        config_map(names.robot_env(workload), dict(environment) if gate.is_at_robot else variables),
        config_map(names.robot_profiles(workload), profiles),
    ]
    if gate.is_at_robot:
        listed = [output.model_dump(mode="json", exclude_none=True, by_alias=True) for output in outputs]
        settings = {
            "HOME": names.STATE_DIR,
            "ROS_LOG_DIR": f"{names.STATE_DIR}/log",
            names.NAMESPACE_VARIABLE: namespace,
            names.WORKLOAD_VARIABLE: workload,
            names.OUTPUTS_VARIABLE: json.dumps(listed),
            names.ALLOWED_NODES_VARIABLE: json.dumps(gate.mux.allowed_nodes if gate.mux else []),
        }
        found.append(config_map(names.mux(workload), settings))
    if gate.on_board is not None:
        variables = {
            names.POD_VARIABLE: gate.on_board.name,
            MIDDLEWARE.settings_variable: PROFILES_FILE,
        }
        found.append(config_map(names.on_board(workload), variables))
    return found

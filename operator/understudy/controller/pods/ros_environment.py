"""The two ConfigMaps for processes on the robot's side: their environment, and the settings of their ROS middleware."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from understudy.api import names
from understudy.api.kinds.robot_workload import Output, Reflex
from understudy.controller.plan import config_map
from understudy.kube.client import Object
from understudy.ros.rmw import MIDDLEWARE

PROFILES_DIR = "/etc/understudy"
PROFILES_KEY = "profiles.xml"
PROFILES_FILE = f"{PROFILES_DIR}/{PROFILES_KEY}"


def config_maps(
    workload: str, environment: Mapping[str, str], outputs: Sequence[Output], reflex: Reflex | None = None
) -> list[Object]:
    """Return the ConfigMaps with the environment (``envFrom``) and the profiles (mounted at PROFILES_DIR).

    Raises ValueError if there are not enough gated ports for the outputs.
    """
    variables = {**environment, MIDDLEWARE.settings_variable: PROFILES_FILE}
    return [
        config_map(names.robot_env(workload), variables),
        config_map(names.robot_profiles(workload), {PROFILES_KEY: MIDDLEWARE.robot_settings(outputs, reflex)}),
    ]

"""The two ConfigMaps that the processes of a robot's side read: their environment, and the settings of their ROS middleware."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from understudy.api import names
from understudy.api.kinds.robot_workload import Output, Reflex
from understudy.kube.client import Object
from understudy.ros.rmw import MIDDLEWARE

PROFILES_DIR = "/etc/understudy"
PROFILES_KEY = "profiles.xml"
PROFILES_FILE = f"{PROFILES_DIR}/{PROFILES_KEY}"


def config_maps(
    workload: str, environment: Mapping[str, str], outputs: Sequence[Output], reflex: Reflex | None = None
) -> list[Object]:
    """What the robot's side takes in: environment (``envFrom``) and profiles (mounted at PROFILES_DIR).

    Raises ValueError where the gated ports don't suffice for the outputs.
    """
    return [
        {
            "apiVersion": "v1",
            "kind": "ConfigMap",
            "metadata": {"name": names.robot_env(workload)},
            "data": {**environment, MIDDLEWARE.settings_variable: PROFILES_FILE},
        },
        {
            "apiVersion": "v1",
            "kind": "ConfigMap",
            "metadata": {"name": names.robot_profiles(workload)},
            "data": {PROFILES_KEY: MIDDLEWARE.robot_settings(outputs, reflex)},
        },
    ]

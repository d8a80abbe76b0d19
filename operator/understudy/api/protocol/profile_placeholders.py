"""Fills in what differs between the pods of a workload in their DDS profiles.

Fast DDS replaces variables of a process's environment. A value that is not in the environment, or that must be the same for all
processes of a pod, is filled in beforehand. Does not import ROS, because an init container uses it.
"""

from __future__ import annotations

from collections.abc import Mapping


def variables(text: str, values: Mapping[str, str]) -> str:
    """Return the text with ``${NAME}`` replaced for each given name. Other placeholders stay."""
    for name, value in values.items():
        text = text.replace(f"${{{name}}}", value)
    return text

"""What differs from pod to pod in the profiles of instances, put in.

Fast DDS puts variables of a process's environment into what it reads, but what isn't in the environment, or must be the
same for all processes of a pod, is put in beforehand. Imports nothing of ROS: an init container does it.
"""

from __future__ import annotations

from collections.abc import Mapping


def variables(text: str, values: Mapping[str, str]) -> str:
    """The text with ``${NAME}`` replaced for each name that is given; others stay."""
    for name, value in values.items():
        text = text.replace(f"${{{name}}}", value)
    return text

"""Message, service and action types by name.

The monitor can only watch types that its image contains. If one is missing, the error says what to do, and the
workload's condition shows the error.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import re
from collections.abc import Mapping
from importlib.machinery import PathFinder
from typing import Any

from understudy.ros.runtime.lean_imports import leave_out_generator

leave_out_generator()

_TYPE_NAME = re.compile(r"([A-Za-z][A-Za-z0-9_]*)/(msg|srv|action)/([A-Z][A-Za-z0-9_]*)")
_packages: set[str] = set()
"""The packages that are known to have ROS types."""


class TypeNotInstalled(LookupError):
    """A ROS type that this image does not have."""

    def __init__(self, type_name: str, found: str) -> None:
        self.type_name = type_name
        super().__init__(
            f"{type_name} is not installed in the monitor's image ({found}): build a monitor image with it, and set "
            "spec.monitor.image to that"
        )


def interface_class(type_name: str) -> Any:
    """Return the Python class of ``package/msg/Name``, ``package/srv/Name`` or ``package/action/Name``, ready for use.

    Raises ValueError if the name is malformed, TypeNotInstalled if the image does not have the type.
    """
    parts = _TYPE_NAME.fullmatch(type_name)
    if parts is None:
        raise ValueError(
            f"{type_name!r:.200} is not a ROS type: write package/msg/Name, such as geometry_msgs/msg/Twist"
        )
    package, kind, name = parts.groups()
    if package not in _packages:
        _refuse_others(package, type_name)
        _packages.add(package)
    try:
        module = importlib.import_module(f"{package}.{kind}")
    except ImportError as error:
        raise TypeNotInstalled(type_name, f"{package} has no {kind} types: {error}") from None
    found = getattr(module, name, None)
    if found is None:
        known = difflib.get_close_matches(name, [entry for entry in dir(module) if entry[:1].isupper()], n=1)
        raise TypeNotInstalled(
            type_name, f"{package} has {package}/{kind}/{known[0]}" if known else f"{package} lacks it"
        )
    meta = found.__class__
    if not hasattr(meta, "__import_type_support__"):
        raise TypeNotInstalled(type_name, f"{package}.{kind}.{name} is not a ROS type")
    try:
        meta.__import_type_support__()
    except Exception as error:  # whatever error a broken package's libraries raise, the type cannot be used
        raise TypeNotInstalled(type_name, f"its libraries do not load: {error}") from error
    if meta._TYPE_SUPPORT is None:  # rosidl reports a failed import in its debug log only
        raise TypeNotInstalled(type_name, "its libraries do not load")
    return found


def _refuse_others(package: str, type_name: str) -> None:
    """Raise TypeNotInstalled unless a package has ROS types, without importing it.

    Importing a module executes it, and a policy, or any participant of the DDS domain, chooses the names of types. All
    packages of ROS types contain this library, also those outside the ament index, and without it no type is usable.
    """
    try:
        spec = importlib.util.find_spec(package)
    except ValueError:  # a module without a specification, such as one that was made at run time
        raise TypeNotInstalled(type_name, f"{package} is not a package of ROS types") from None
    if spec is None:
        raise TypeNotInstalled(type_name, f"there is no package {package}")
    places = list(spec.submodule_search_locations or ())
    if PathFinder.find_spec(f"{package}_s__rosidl_typesupport_c", places) is None:
        raise TypeNotInstalled(type_name, f"{package} is not a package of ROS types")


def message_class(type_name: str) -> Any:
    """Return the Python class of ``package/msg/Name``; errors as in :func:`interface_class`.

    It also accepts ``package/action/Name_FeedbackMessage``, which is the graph's type of an action's feedback topic,
    and ``package/action/Name_Feedback``, which that message contains beside the goal's id.
    """
    if "/action/" in type_name:
        action, _, part = type_name.rpartition("_")
        if part == "FeedbackMessage":
            return interface_class(action).Impl.FeedbackMessage
        if part == "Feedback":
            return interface_class(action).Feedback
    if "/msg/" not in type_name:
        raise ValueError(
            f"{type_name!r} is not a message type: write package/msg/Name, such as geometry_msgs/msg/Twist"
        )
    return interface_class(type_name)


def message_fields(type_name: str) -> Mapping[str, str] | None:
    """Return the fields of ``package/msg/Name``, or of an action's feedback, with their types, as rosidl names them.

    None if the image does not have the type.
    """
    try:
        found: Mapping[str, str] = message_class(type_name).get_fields_and_field_types()
    except TypeNotInstalled:
        return None
    return found

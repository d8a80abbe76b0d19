"""Keeps the ROS code generator out of memory.

The first message that is used imports its type support through ``rosidl_generator_py``. This package has one small
function for that, and loads a template engine and an IDL parser with it: 20 MB resident, in every monitor and every
agent.
"""

from __future__ import annotations

import asyncio
import importlib
import importlib.util
import sys
import threading
from types import ModuleType

_IMPORTING = threading.Lock()
_imported = threading.Event()

_GENERATOR = "rosidl_generator_py"
_NEEDED = f"{_GENERATOR}.import_type_support_impl"


def leave_out_generator() -> bool:
    """Import only those parts of ``rosidl_generator_py`` that types need at run time.

    Returns whether that was possible. Call it before any type is used. If the package is loaded already, or has a
    different structure, nothing is changed.
    """
    if _GENERATOR in sys.modules:
        return _NEEDED in sys.modules and not hasattr(sys.modules[_GENERATOR], "generate_py")
    spec = importlib.util.find_spec(_GENERATOR)
    if spec is None or spec.submodule_search_locations is None:
        return False
    package = ModuleType(_GENERATOR, "Only what types need at run time; see understudy.ros.runtime.lean_imports.")
    package.__path__ = spec.submodule_search_locations
    package.__spec__ = spec
    sys.modules[_GENERATOR] = package
    try:
        package.import_type_support = importlib.import_module(_NEEDED).import_type_support  # type: ignore[attr-defined]
    except (ImportError, AttributeError):
        del sys.modules[_GENERATOR]
        return False
    return True


def import_rclpy() -> None:
    """Import rclpy, from whichever thread comes first.

    Its modules import each other in a circle. If two threads import them at the same time, one finds a module that is
    half loaded. So code that may run before this process has joined the ROS graph calls this function, or awaits
    :func:`rclpy_imported` in an event loop, before it imports anything of rclpy.
    """
    with _IMPORTING:
        importlib.import_module("rclpy")
        importlib.import_module("rclpy.node")
    _imported.set()


def import_in_turn(module: str) -> None:
    """Import a module in a thread while others import too, of packages whose modules import each other in a circle.

    py_trees is one, as rclpy. At the end of its import a package is not in ``sys.modules`` for a moment, so another thread that imports a
    part of it fails with a KeyError.
    """
    with _IMPORTING:
        importlib.import_module(module)


async def rclpy_imported() -> None:
    """Import rclpy in a thread, since it takes a second, or wait for another thread that is importing it."""
    if not _imported.is_set():
        await asyncio.to_thread(import_rclpy)

"""Types are found by name, and what is missing says what to do."""

import sys

import geometry_msgs.msg
import pytest

from tests.support.golden import assert_golden
from understudy.ros.runtime.interface_types import TypeNotInstalled, interface_class, message_class

pytestmark = pytest.mark.ros


@pytest.mark.parametrize(
    "name", ["geometry_msgs/msg/Twist", "std_srvs/srv/Trigger", "test_msgs/action/Fibonacci", "std_msgs/msg/String"]
)
def test_installed_types_are_found(name):
    found = interface_class(name)
    assert found.__name__ == name.split("/")[-1]
    assert found.__class__._TYPE_SUPPORT is not None


def test_a_missing_package_is_reported_with_a_solution():
    with pytest.raises(TypeNotInstalled) as caught:
        message_class("robots_msgs/msg/Costmap")
    assert_golden("ros", str(caught.value), "robots_msgs", "spec.monitor.image", "no package robots_msgs")


def test_a_misspelt_type_is_reported_with_a_similar_one():
    with pytest.raises(TypeNotInstalled, match="geometry_msgs has geometry_msgs/msg/TwistStamped"):
        message_class("geometry_msgs/msg/TwistStampd")


def test_a_package_without_types_of_the_kind_is_reported():
    with pytest.raises(TypeNotInstalled, match="geometry_msgs has no srv types"):
        interface_class("geometry_msgs/srv/Twist")


def test_a_class_that_is_not_a_ros_type_is_reported(monkeypatch):
    monkeypatch.setattr(geometry_msgs.msg, "Odd", type("Odd", (), {}), raising=False)
    with pytest.raises(TypeNotInstalled, match=r"geometry_msgs\.msg\.Odd is not a ROS type"):
        message_class("geometry_msgs/msg/Odd")


@pytest.mark.parametrize("layout", ["module.py", "package/__init__.py", "package/msg/__init__.py"])
@pytest.mark.parametrize("kind", ["msg", "srv", "action"])
def test_only_packages_of_ros_types_are_imported(layout, kind, tmp_path, monkeypatch):
    """A policy, or any participant of the DDS domain, chooses the names of types; importing a module executes it."""
    file = tmp_path / layout.replace("msg/", f"{kind}/").replace("package", "stranger").replace("module", "stranger")
    file.parent.mkdir(parents=True, exist_ok=True)
    trace = tmp_path / "executed"
    file.write_text(f"open({str(trace)!r}, 'w').close()\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(TypeNotInstalled) as caught:
        interface_class(f"stranger/{kind}/Name")
    assert not trace.exists()
    assert "stranger is not a package of ROS types" in str(caught.value)
    assert "stranger" not in sys.modules


@pytest.mark.parametrize("package", ["antigravity", "this", "rosidl_adapter", "understudy", "sys"])
def test_a_module_of_the_image_is_not_a_package_of_ros_types(package):
    """``rosidl_adapter`` has a module ``msg``; ``antigravity`` opens a browser."""
    loaded = set(sys.modules)
    with pytest.raises(TypeNotInstalled, match=f"{package} is not a package of ROS types"):
        interface_class(f"{package}/msg/Name")
    assert not {name for name in set(sys.modules) - loaded if name.split(".")[0] == package}


@pytest.mark.parametrize(
    "name",
    [
        "Twist",
        "geometry_msgs/Twist",
        "a/b/C",
        "a.b/msg/C",
        "/msg/C",
        "__main__/msg/C",
        "a/msg/c",
        "a/msg/__class__",
        "a/msg/C\n",
        "ａ/msg/C",
    ],
)
def test_an_invalid_name_is_refused(name):
    with pytest.raises(ValueError, match="write package/msg/Name"):
        interface_class(name)


def test_a_message_class_must_be_of_a_message():
    with pytest.raises(ValueError, match="not a message type"):
        message_class("std_srvs/srv/Trigger")

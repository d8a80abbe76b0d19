"""Types are found by name, and what is missing says what to do."""

import sys
from types import ModuleType

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


def test_a_package_without_ros_types_is_reported(monkeypatch):
    package, module = ModuleType("odd"), ModuleType("odd.msg")
    module.Name = type("Name", (), {})
    monkeypatch.setitem(sys.modules, "odd", package)
    monkeypatch.setitem(sys.modules, "odd.msg", module)
    with pytest.raises(TypeNotInstalled, match=r"odd\.msg\.Name is not a ROS type"):
        message_class("odd/msg/Name")


@pytest.mark.parametrize("name", ["Twist", "geometry_msgs/Twist", "a/b/C", "a.b/msg/C", "/msg/C"])
def test_an_invalid_name_is_refused(name):
    with pytest.raises(ValueError, match="write package/msg/Name"):
        interface_class(name)


def test_a_message_class_must_be_of_a_message():
    with pytest.raises(ValueError, match="not a message type"):
        message_class("std_srvs/srv/Trigger")

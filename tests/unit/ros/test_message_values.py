"""Messages from mappings and back."""

from __future__ import annotations

import time

import pytest

pytestmark = pytest.mark.ros


def test_a_message_has_the_given_fields_and_defaults_otherwise() -> None:
    from understudy.ros.runtime.interface_types import message_class
    from understudy.ros.runtime.message_values import to_mapping, to_message

    cls = message_class("test_msgs/msg/UnboundedSequences")
    values = {
        "float64_values": [1, 2.5],
        "byte_values": [1, 255],
        "uint8_values": b"ab",
        "string_values": ["x"],
        "basic_types_values": [{"float32_value": 1}, {"bool_value": True}],
    }

    found = to_mapping(to_message(cls, values))

    assert found["float64_values"] == [1.0, 2.5]
    assert found["byte_values"] == [b"\x01", b"\xff"]
    assert found["uint8_values"] == [97, 98]
    assert found["string_values"] == ["x"]
    assert [item["float32_value"] for item in found["basic_types_values"]] == [1.0, 0.0]
    assert found["int32_values"] == []


def test_now_is_replaced_by_the_present_time() -> None:
    from understudy.ros.runtime.interface_types import message_class
    from understudy.ros.runtime.message_values import to_message

    stamp = to_message(message_class("std_msgs/msg/Header"), {"stamp": "now"}).stamp

    assert abs(stamp.sec + stamp.nanosec * 1e-9 - time.time()) < 5


@pytest.mark.parametrize(
    ("type_name", "values", "message"),
    [
        ("std_msgs/msg/String", {"text": "x"}, "text: String has no field text; there are data"),
        ("std_msgs/msg/String", {"data": 1}, "data: expected string, found 1"),
        ("std_msgs/msg/UInt8", {"data": 256}, "data: expected uint8, found 256"),
        ("std_msgs/msg/Int32", {"data": True}, "data: expected int32, found True"),
        ("geometry_msgs/msg/Twist", {"linear": {"y": "fast"}}, "linear.y: expected double, found 'fast'"),
        ("geometry_msgs/msg/Twist", {"linear": 1}, "linear: expected a mapping of the fields of Vector3, found 1"),
        ("geometry_msgs/msg/PoseArray", {"poses": [{"position": {"q": 1}}]}, r"poses\[0\].position.q: Point has no"),
        ("geometry_msgs/msg/PoseWithCovariance", {"covariance": [1.0]}, r"covariance: expected double\[36\], found"),
        ("geometry_msgs/msg/PoseWithCovariance", {"covariance": 1.0}, "covariance: expected a list"),
    ],
)
def test_a_value_of_a_wrong_type_is_reported_with_its_field(
    type_name: str, values: dict[str, object], message: str
) -> None:
    from understudy.ros.runtime.interface_types import message_class
    from understudy.ros.runtime.message_values import MessageError, to_message

    with pytest.raises(MessageError, match=message):
        to_message(message_class(type_name), values)

"""The messages of kept samples, with the current time in their headers if the policy requires it."""

from __future__ import annotations

from typing import Any

from understudy.api.protocol.kept_state import KeptSample


def stamped(sample: KeptSample) -> bytes:
    """Return the message as it is published, with the current time in its header if the policy requires it.

    It loads rclpy. Raises CallFailed if the bytes are not of the sample's type, and TypeNotInstalled.
    """
    if sample.stamp != "now":
        return sample.data
    from rclpy.serialization import serialize_message

    from understudy.ros.runtime.message_values import now

    message = deserialized(sample)
    header = getattr(message, "header", None)
    if header is None or not hasattr(header, "stamp"):
        return sample.data
    header.stamp = now()
    return bytes(serialize_message(message))


def deserialized(sample: KeptSample) -> Any:
    """Return the message itself. It loads rclpy.

    Raises CallFailed if the bytes are not of its type, or the type is not installed.
    """
    from rclpy.serialization import deserialize_message

    from understudy.ros.actions.instance_calls import CallFailed
    from understudy.ros.runtime.interface_types import TypeNotInstalled, message_class

    try:
        return deserialize_message(sample.data, message_class(sample.type))
    except (TypeNotInstalled, ValueError) as error:
        raise CallFailed(str(error)) from error
    except Exception as error:  # rclpy has no exception type of its own for bytes that rmw refuses
        raise CallFailed(f"what is kept of {sample.topic} is no {sample.type}: {error}") from error

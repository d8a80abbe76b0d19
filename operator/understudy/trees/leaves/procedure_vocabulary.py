"""The leaves that only procedures and checks have, with what each is given."""

from __future__ import annotations

from collections.abc import Mapping

STEPS: Mapping[str, tuple[str, ...]] = {
    "set_lifecycle": ("node", "state"),
    "call_service": ("service", "type", "request", "expect", "repeat"),
    "publish": ("topic", "type", "message"),
    "set_parameters": ("node", "values"),
    "wait_for": ("topic", "type", "service", "node", "within"),
    "restore_state": ("only",),
    "resend_goals": (),
}
"""What is done, by its key in the short form, with the keys in it."""

LOOKS: Mapping[str, tuple[str, ...]] = {
    "lifecycle_is": ("node", "state"),
    "node_present": ("node",),
    "service_present": ("service",),
    "parameter_is": ("node", "name", "value"),
}
"""What is looked at once, unlike what the leaves of health trees watch."""

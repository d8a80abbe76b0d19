"""Label selectors: what they match, and their opposites."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_OPPOSITE = {"In": "NotIn", "NotIn": "In", "Exists": "DoesNotExist", "DoesNotExist": "Exists"}


def requirements(selector: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a selector as a list of expressions, all of which must match."""
    equal = selector.get("matchLabels") or {}
    found = [{"key": key, "operator": "In", "values": [equal[key]]} for key in sorted(equal)]
    return found + list(selector.get("matchExpressions") or [])


def opposite(requirement: Mapping[str, Any]) -> dict[str, Any]:
    """Return the expression that matches exactly if the given one does not."""
    turned = {"key": requirement["key"], "operator": _OPPOSITE[requirement["operator"]]}
    if requirement.get("values"):
        turned["values"] = list(requirement["values"])
    return turned


def matches(selector: Mapping[str, Any], labels: Mapping[str, str]) -> bool:
    """Whether a selector matches labels; an empty one matches everything."""
    return all(_holds(requirement, labels) for requirement in requirements(selector))


def _holds(requirement: Mapping[str, Any], labels: Mapping[str, str]) -> bool:
    key, values = requirement["key"], requirement.get("values") or []
    match requirement["operator"]:
        case "In":
            return key in labels and labels[key] in values
        case "NotIn":
            return key not in labels or labels[key] not in values
        case "Exists":
            return key in labels
        case "DoesNotExist":
            return key not in labels
    return False


def as_text(selector: Mapping[str, Any]) -> str:
    """Return a selector as text, for the ``labelSelector`` of a request and for a scale subresource."""
    return ",".join(_text(requirement) for requirement in requirements(selector))


def _text(requirement: Mapping[str, Any]) -> str:
    key, values = requirement["key"], requirement.get("values") or []
    match requirement["operator"]:
        case "In":
            return f"{key}={values[0]}" if len(values) == 1 else f"{key} in ({','.join(values)})"
        case "NotIn":
            return f"{key} notin ({','.join(values)})"
        case "Exists":
            return str(key)
    return f"!{key}"

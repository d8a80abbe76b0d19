"""YAML scalars as Kubernetes reads them, for trees and manifests that are read with lines and columns."""

from __future__ import annotations

from yaml.nodes import ScalarNode

TAG = "tag:yaml.org,2002:"
SCALARS = tuple(f"{TAG}{name}" for name in ("str", "bool", "int", "float", "null", "timestamp", "merge", "value"))
"""The tags that a scalar of a manifest can have."""


def plain(node: ScalarNode) -> bool | int | float | str | None:
    """Return a scalar as Kubernetes reads it: as in YAML 1.1, except that times and numbers with colons are texts."""
    text: str = node.value
    match node.tag.removeprefix(TAG):
        case "null":
            return None
        case "bool":
            return text.lower() in ("yes", "true", "on")
        case "int":
            return _whole(text)
        case "float":
            return _fraction(text)
    return text


def _whole(text: str) -> int | str:
    digits_only = text.replace("_", "").lower()
    sign, digits = (-1, digits_only[1:]) if digits_only.startswith("-") else (1, digits_only.removeprefix("+"))
    bases = {"0x": 16, "0b": 2, "0o": 8}
    try:
        if digits[:2] in bases:
            return sign * int(digits[2:], bases[digits[:2]])
        return sign * int(digits, 8 if digits.startswith("0") and len(digits) > 1 else 10)
    except ValueError:  # with colons, or longer than any number
        return text


def _fraction(text: str) -> float | str:
    try:
        return float(text.replace("_", "").lower().replace(".inf", "inf").replace(".nan", "nan"))
    except ValueError:
        return text

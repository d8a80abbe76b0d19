"""YAML scalars as Kubernetes reads them, for trees and manifests that are read with lines and columns."""

from __future__ import annotations

import math
import re

import yaml
from yaml.nodes import ScalarNode
from yaml.scanner import ScannerError

TAG = "tag:yaml.org,2002:"
SCALARS = tuple(f"{TAG}{name}" for name in ("str", "bool", "int", "float", "null", "timestamp", "merge", "value"))
"""The tags that a scalar of a manifest can have."""

LEAST, MOST = -(2**63), 2**64 - 1
"""The whole numbers that JSON of Kubernetes and the types of ROS can hold. Python writes no more than 4,300 digits."""

HALF_CHARACTER = "has half of a character (a surrogate) in it; write the whole character"
"""What is wrong with a text that :func:`has_half_character`."""

_SURROGATE = re.compile("[\ud800-\udfff]")
_DIGITS = re.compile(r"[-+]?(0x[0-9a-f]+|0b[01]+|[0-9]+)")


class Loader(yaml.SafeLoader):
    """Reads YAML into nodes. Every problem of a text is a MarkedYAMLError or a ReaderError."""

    def fetch_more_tokens(self) -> None:
        """Read the next tokens. PyYAML raises other errors for escapes beyond Unicode and for very long version numbers."""
        try:
            super().fetch_more_tokens()
        except (ValueError, OverflowError) as error:
            problem = "found an escape or a number that is out of range"
            raise ScannerError(None, None, problem, self.get_mark()) from error


def plain(node: ScalarNode) -> bool | int | float | str | None:
    """Return a scalar as Kubernetes reads it: as in YAML 1.1, except that times and numbers with colons are texts.

    A whole number with more than 64 bits becomes a fraction if it is decimal, and a text otherwise.
    """
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


def refusal(node: ScalarNode) -> str:
    """Return why a tree cannot have a scalar and what to write instead; empty if it can."""
    text: str = node.value
    if node.tag not in SCALARS:
        return f"found the tag {node.tag.replace(TAG, '!!'):.60}; remove it"
    if has_half_character(text):
        return HALF_CHARACTER
    found = plain(node)
    if isinstance(found, float) and not math.isfinite(found):
        return f"found {_short(text)}; give a number"
    if node.tag == f"{TAG}int" and not isinstance(found, int) and _DIGITS.fullmatch(_bare(text)):
        return too_large(text)
    return ""


def whole_json(text: str) -> int:
    """Return a whole number of JSON. Raises ValueError if it has more than 64 bits."""
    number = _bounded(text, 10)
    if number is None:
        raise ValueError(too_large(text))
    return number


def too_large(text: str) -> str:
    """Return the problem with a whole number of more than 64 bits."""
    return f"found {_short(text)}, which has more than 64 bits; give a smaller number, or write it in quotes if it is a text"


def has_half_character(text: str) -> bool:
    """Return whether a text cannot be encoded, because an escape in it stands for half of a character."""
    return _SURROGATE.search(text) is not None


def _short(text: str) -> str:
    return text if len(text) <= 24 else f"{text[:21]}..."


def _bare(text: str) -> str:
    return text.replace("_", "").lower()


def _whole(text: str) -> int | float | str:
    digits_only = _bare(text)
    sign, digits = (-1, digits_only[1:]) if digits_only.startswith("-") else (1, digits_only.removeprefix("+"))
    bases = {"0x": 16, "0b": 2, "0o": 8}
    written = digits[:2] in bases
    try:
        if written:
            number = _bounded(digits[2:], bases[digits[:2]], sign)
        else:
            number = _bounded(digits, 8 if digits.startswith("0") and len(digits) > 1 else 10, sign)
    except ValueError:  # with colons
        return text
    if number is not None:
        return number
    large = text if written else _fraction(text)
    return large if isinstance(large, float) and math.isfinite(large) else text


def _bounded(digits: str, base: int, sign: int = 1) -> int | None:
    """Return a number; None if it has more than 64 bits. Raises ValueError if it is none."""
    if len(digits.lstrip("-+0")) > 64:  # the time to convert decimal digits grows with the square of their number
        if not re.fullmatch(r"[-+]?[0-9a-f]+", digits):
            raise ValueError(digits[:64])
        return None
    number = sign * int(digits, base)
    return number if LEAST <= number <= MOST else None


def _fraction(text: str) -> float | str:
    try:
        return float(text.replace("_", "").lower().replace(".inf", "inf").replace(".nan", "nan"))
    except ValueError:
        return text

"""Reads values of steps from languages that only have texts, if the short form has another type."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from understudy.trees.languages.text.flow_values import structure_of


def names_of(text: str) -> list[str]:
    """Return the names of a list, separated by semicolons (as in BehaviorTree.CPP) or commas."""
    return re.split(r"\s*[;,]\s*", text.strip())


def whole_of(text: str) -> int | str:
    """Return a whole number. Other text is returned unchanged, and the short form then refuses it."""
    return int(text) if re.fullmatch(r"-?[0-9]{1,9}", text.strip(), re.ASCII) else text


READS: Mapping[str, Callable[[str], Any]] = {"structure": structure_of, "names": names_of}
"""By the type of a key, the parser of its values; values of other types stay texts. All parsers raise ValueError."""

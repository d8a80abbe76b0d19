"""Reads values of steps that are not texts in the short form from languages that only have texts."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from understudy.trees.languages.text.flow_values import structure_of


def names_of(text: str) -> list[str]:
    """Return the names of a list, separated by semicolons (as in BehaviorTree.CPP) or commas."""
    return re.split(r"\s*[;,]\s*", text.strip())


def whole_of(text: str) -> int | str:
    """Return a whole number, or the text itself if it is none, which the short form then refuses."""
    return int(text) if re.fullmatch(r"-?[0-9]{1,9}", text.strip(), re.ASCII) else text


READS: Mapping[str, Callable[[str], Any]] = {"structure": structure_of, "names": names_of}
"""What reads the text of a value, by the type of its key; types that are absent here stay texts. All raise ValueError."""

"""How languages that have only texts spell what is none in the short form of procedures."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from understudy.trees.languages.flow_values import structure_of


def names_of(text: str) -> list[str]:
    """Names in a list, between semicolons (as BehaviorTree.CPP has it) or commas."""
    return re.split(r"\s*[;,]\s*", text.strip())


def whole_of(text: str) -> int | str:
    """A whole number; what is none is left as it is, for the short form to refuse."""
    return int(text) if re.fullmatch(r"-?[0-9]{1,9}", text.strip(), re.ASCII) else text


READS: Mapping[str, Callable[[str], Any]] = {
    "call_service.request": structure_of,
    "call_service.expect": structure_of,
    "publish.message": structure_of,
    "set_parameters.values": structure_of,
    "restore_state.only": names_of,
    "parameter_is.value": structure_of,
    "retry.times": whole_of,
}
"""By path in the short form, what reads such a text. All of them raise ValueError."""

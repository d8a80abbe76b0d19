"""Reads the values of arguments and parameters, and converts them into the short form."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import NoReturn

from understudy.trees.languages.osc.grammar import Part
from understudy.trees.languages.osc.library import ENUMS
from understudy.trees.languages.osc.units import UNITS
from understudy.trees.source.problems import did_you_mean
from understudy.trees.source.value_reader import found_text


@dataclass(frozen=True)
class Constant:
    """A parameter of the scenario."""

    type: str
    value: str | None
    """Its value in the short form; None if it could not be read, which was reported already."""


Constants = Mapping[str, Constant]
"""By name."""

TYPES = ("string", "int", "float", *UNITS, *ENUMS)
"""The types that a value can have."""

RIGHT: Mapping[str, str] = {
    "string": 'a text in quotes, such as "/scan"',
    "int": "a whole number, such as 1",
    "float": "a number, such as 0.2",
    "time": "a time, such as 500ms or 2s",
    "frequency": "a frequency, such as 8Hz",
    **{name: f"one of {', '.join(f'{name}!{member}' for member in members)}" for name, members in ENUMS.items()},
}
"""How a value of each type is written."""

_LONGEST_NUMBER = 20
_LEAST, _MOST = Decimal("0.000001"), Decimal(10**9)
_NUMBER = re.compile(r"(?=.{1,20}$)[-+]?[0-9]*\.?[0-9]+([eE][-+]?[0-9]+)?")
_ESCAPE = re.compile(r"\\(.)", re.DOTALL)
_ESCAPES = {"\\": "\\", '"': '"', "'": "'", "n": "\n", "t": "\t"}


def read(value: Part, type_: str, constants: Constants) -> str | None:
    """Return a value of a type in the short form; None if it is a parameter that could not be read.

    Raises ValueError with what was found and what would be right.
    """
    while value.rule == "primaryExp" and len(value.parts) == 3:  # (in brackets)
        value = value.parts[1]
    word = value.parts[0] if len(value.parts) == 1 else value
    match value.rule:
        case "identifierReference" | "primaryExp" if re.fullmatch(r"\|.+\||\w+", value.text):
            return _referred(value.text, type_, constants)
        case "physicalLiteral" if type_ in UNITS:
            return _physical(value, type_)
        case "enumValueReference" if type_ in ENUMS and value.first("enumName") is not None:
            return _member(value, type_)
        case "integerLiteral" if type_ == "int" and len(value.text) <= _LONGEST_NUMBER:
            return str(int(value.text, 16 if "x" in value.text.lower() else 10))
        case "valueExp" | "integerLiteral" if type_ == "float" and _NUMBER.fullmatch(value.text):
            return value.text
        case "valueExp" if type_ == "string" and word.text[:1] in ("'", '"'):
            return _string(word.text)
    _no(value, type_)


def _no(value: Part, type_: str) -> NoReturn:
    found = value.text
    hint = ""
    if type_ in UNITS and value.rule == "integerLiteral":
        hint = ", which has no unit"
    elif type_ in UNITS and found[:1] in ("'", '"'):
        hint = ", which is a text; remove the quotes"
    raise ValueError(f"found {_shown(found)}{hint}; give {RIGHT[type_]}")


def _shown(text: str) -> str:
    """Return what was written, without enclosing quotes, because the text may contain its own."""
    text = " ".join(text.split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def _referred(name: str, type_: str, constants: Constants) -> str | None:
    known = constants.get(name)
    if known is None:
        members = [f"{enum}!{name}" for enum, values in ENUMS.items() if enum == type_ and name in values]
        if members:
            raise ValueError(f"found {name:.60}; did you mean {members[0]}?")
        hint = did_you_mean(name, constants) if constants else "; the scenario has none"
        raise ValueError(f"there is no parameter {found_text(name)}{hint}; give it, or {RIGHT[type_]}")
    if known.type != type_:
        raise ValueError(f"the parameter {name} is of type {known.type}; give {RIGHT[type_]}")
    return known.value


def _physical(value: Part, type_: str) -> str:
    name, number = value.text_of("unitName"), value.parts[0].text
    unit = UNITS[type_].get(name)
    if unit is None:
        if type_ == "time" and name == "m":
            raise ValueError(f"found {_shown(value.text)}, and m is the metre in OpenSCENARIO; write min for minutes")
        raise ValueError(
            f"found {_shown(value.text)}, and {name:.60} is no unit of {type_}{did_you_mean(name, UNITS[type_])}"
        )
    try:
        amount = Decimal(number) if len(number) <= _LONGEST_NUMBER else None
    except InvalidOperation:  # a hexadecimal number
        amount = None
    if amount is None or (amount and not _LEAST <= amount < _MOST):
        raise ValueError(f"found {_shown(value.text)}; give {RIGHT[type_]}, above 0 and below {_MOST}")
    return f"{amount * unit.scale:f}{unit.short}"


def _member(value: Part, type_: str) -> str:
    enum, member = value.text_of("enumName"), value.text_of("enumMemberName")
    if enum != type_:
        raise ValueError(f"found {_shown(value.text)}; give {RIGHT[type_]}")
    if member not in ENUMS[type_]:
        raise ValueError(f"found {_shown(value.text)}{_near(member, ENUMS[type_])}")
    return member


def _near(member: str, members: tuple[str, ...]) -> str:
    return did_you_mean(member.upper() if members[0].isupper() else member.lower(), members)


def _string(text: str) -> str:
    quote = text[0]
    if text.startswith(quote * 3) and len(text) >= 6:
        raise ValueError("found a text in three quotes; write it on one line, in one pair of quotes")
    inner = text[1:-1]
    for found in _ESCAPE.finditer(inner):
        if found[1] not in _ESCAPES:
            raise ValueError(f"found {found[0]!a} in a text; known are \\\\, \\\", \\', \\n and \\t")
    return _ESCAPE.sub(lambda found: _ESCAPES[found[1]], inner)

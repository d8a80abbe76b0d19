"""The values of expressions over a message: fields, arrays, numbers, and a truth with three values.

Comparisons raise :class:`Undefined` if they have no truth value. ``and``, ``or``, ``not``, ``any`` and ``all`` follow Kleene.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from numbers import Integral, Real
from typing import Any

MOST_ELEMENTS = 4096
"""Greatest number of elements of an array that are iterated: enough for the rays of a laser scan, not for the points of
a cloud."""

Evaluate = Callable[[Any, Any], Any]
"""Returns the value for a message and, inside ``any`` and ``all``, for an element."""

_NUMERIC = frozenset((int, float))
_OWN = frozenset((bool, int, float, str))


class Undefined(Exception):
    """A condition has no truth value for a message; the text says why."""


def field_of(evaluate: Evaluate, name: str) -> Evaluate:
    """Return a function that evaluates a field. Only fields of the message's type are accessible, and none of its
    class's attributes."""
    known: dict[type, bool] = {}

    def field(message: Any, element: Any) -> Any:
        value = evaluate(message, element)
        cls = type(value)
        if cls not in known:
            describe = getattr(cls, "get_fields_and_field_types", None)
            known[cls] = describe is not None and name in describe()
        if not known[cls]:
            raise Undefined(f"{cls.__name__} has no field {name}")
        return plain_value(getattr(value, name))

    return field


def plain_value(value: Any) -> Any:
    """Convert a field's value into a plain Python value: octets and numpy's scalars are not."""
    if type(value) in _OWN:
        return value
    if isinstance(value, bytes) and len(value) == 1:
        return value[0]
    if isinstance(value, Real):
        return int(value) if isinstance(value, Integral) else float(value)
    return value


def as_array(value: Any, text: str) -> Any:
    """Return an array. Raises Undefined."""
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return value
    if hasattr(value, "tolist") and getattr(value, "ndim", 0) == 1:
        return value
    raise Undefined(f"{text} is no array")


def bounded_elements(value: Any, text: str) -> Any:
    """Return an array that is not too large to be iterated. Raises Undefined."""
    values = as_array(value, text)
    if len(values) > MOST_ELEMENTS:
        raise Undefined(f"{text} has {len(values)} elements; up to {MOST_ELEMENTS} are gone through")
    return values


def length_of(value: Any, text: str) -> int:
    """Return the length of an array or a string. Raises Undefined."""
    return len(value) if isinstance(value, str) else len(as_array(value, text))


def as_number(value: Any, text: str) -> Any:
    """Return a number. Raises Undefined."""
    if type(value) not in _NUMERIC:
        raise Undefined(f"{text} is no number")
    return value


def as_truth(value: object, text: str) -> bool:
    """Return a truth value. Raises Undefined."""
    if value is not True and value is not False:
        raise Undefined(f"{text:.80} is neither true nor false")
    return value


def extreme_of(name: str, values: Sequence[float]) -> float:
    """Return the least or greatest value; NaN if one of them is NaN, because Python's own result then depends on their
    order."""
    if any(value != value for value in values):
        return math.nan
    return min(values) if name == "min" else max(values)


def is_finite(value: float) -> bool:
    """Return whether a number is finite."""
    return isinstance(value, int) or math.isfinite(value)  # an integer may be larger than any float


def root_of(evaluate: Evaluate, text: str) -> Evaluate:
    """Return a function that evaluates a square root."""

    def root(message: Any, element: Any) -> float:
        value = evaluate(message, element)
        try:
            return math.sqrt(value)
        except ValueError:
            raise Undefined(f"{text} is of a negative number") from None
        except OverflowError:
            raise Undefined(f"{text} is too large") from None

    return root


def value_or_undefined(evaluate: Evaluate, message: Any, element: Any) -> Any:
    """Return a value, or the Undefined that evaluating it raised."""
    try:
        return evaluate(message, element)
    except Undefined as error:
        return error


def comparison_of(
    compare: Callable[[Any, Any], bool], ordered: bool, values: Sequence[Evaluate], texts: Sequence[str]
) -> Evaluate:
    """Return a function that evaluates a comparison. The usual comparison, of two numbers, is fast, because it may run
    for each element of an array."""
    left, right = values

    def evaluate(message: Any, element: Any) -> bool:
        first, second = left(message, element), right(message, element)
        if type(first) in _NUMERIC and type(second) in _NUMERIC and first == first and second == second:
            return compare(first, second)
        return compared(compare, ordered, (first, second), texts)

    return evaluate


def compared(compare: Callable[[Any, Any], bool], ordered: bool, values: Sequence[Any], texts: Sequence[str]) -> bool:
    """Compare two values. Raises Undefined if the comparison has no truth value."""
    for value, text in zip(values, texts, strict=True):
        if isinstance(value, Undefined):
            raise value
        if isinstance(value, float) and math.isnan(value):
            raise Undefined(f"{text} is NaN")
        if ordered:
            as_number(value, text)
    first, second = values
    if isinstance(first, bool) and isinstance(second, bool):
        return compare(first, second)
    if isinstance(first, str) and isinstance(second, str):
        return compare(first, second)
    return compare(as_number(first, texts[0]), as_number(second, texts[1]))


# -- truth --------------------------------------------------------------------------------------------------------------


def all_of(parts: Sequence[Evaluate], conjunction: bool) -> Evaluate:
    """Return a function that evaluates ``and`` or ``or``: by the first condition that decides the result, else
    Undefined if any condition is."""

    def evaluate(message: Any, element: Any) -> bool:
        undefined: Undefined | None = None
        for part in parts:
            try:
                if as_truth(part(message, element), "a part of it") != conjunction:
                    return not conjunction
            except Undefined as error:
                undefined = undefined or error
        if undefined is not None:
            raise undefined
        return conjunction

    return evaluate


def negation_of(truth: Evaluate) -> Evaluate:
    """Return a function that evaluates ``not``."""
    return lambda message, element: not as_truth(truth(message, element), "a part of it")


def any_holds(message: Any, values: Iterable[Any], truth: Evaluate) -> bool:
    """Return whether a condition holds for any element."""
    undefined: Undefined | None = None
    for value in values:
        try:
            if truth(message, plain_value(value)):
                return True
        except Undefined as error:
            undefined = undefined or error
    if undefined is not None:
        raise undefined
    return False


def shown_value(value: bool | int | float | str) -> str:
    """Return a value in words."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return "NaN" if math.isnan(value) else f"{value:.4g}"
    text = repr(value) if isinstance(value, str) else str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."

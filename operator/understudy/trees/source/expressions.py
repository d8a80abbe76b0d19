"""Conditions over the fields of a message, such as ``percentage > 0.15 or charging``.

Python's grammar parses them, but Python does not evaluate them: each supported construct becomes a closure of its own,
and all others are refused when the expression is read. A name is a field of the message, so an expression can reach
only the message's own data. The work that an expression can cause is bounded.

Truth has three values: if a number is NaN, a divisor is 0 or an element is missing, a comparison has no truth value
(:class:`Undefined`). ``and``, ``or``, ``not``, ``any`` and ``all`` then follow Kleene: if one side decides the result
alone, the result is defined.
"""

from __future__ import annotations

import ast
import functools
import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from understudy.trees.source.expression_values import (
    Evaluate,
    Undefined,
    all_of,
    any_holds,
    as_array,
    as_number,
    as_truth,
    bounded_elements,
    compared,
    comparison_of,
    extreme_of,
    field_of,
    is_finite,
    length_of,
    negation_of,
    plain_value,
    root_of,
    shown_value,
    value_or_undefined,
)
from understudy.trees.source.problems import did_you_mean

LONGEST = 500
"""Most characters of an expression."""

MOST_NODES = 100
"""Greatest number of names, numbers and operations in an expression."""

DEEPEST = 24
"""Greatest depth of an expression."""

REMEMBERED = 2048
"""Number of conditions that are remembered once they are parsed. The largest tree has half as many."""

MOST_LOOPS = 4
"""Greatest number of ``any`` and ``all`` in an expression."""

LARGEST = 2.0**64
"""Greatest number that may be written: the end of the largest integer type."""

SHOWN = 3
"""How many values are shown for a condition that does not hold."""

Fields = Callable[[str], Mapping[str, str] | None]
"""Returns the fields of a message type with their types, as rosidl names them (``double``,
``sequence<geometry_msgs/Point>``); None if the type is not known here."""

_FIELD = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_ARRAY = re.compile(r"sequence<(.+?)(?:, \d+)?>|(.+)\[\d+\]")
_NESTED = re.compile(r"(\w+)/(\w+)")


class ExpressionError(ValueError):
    """An expression cannot be used; the text says what was found and what would be right."""


@dataclass(frozen=True)
class _Kind:
    """The type of a value, as far as it is known before the evaluation."""

    text: str
    item: _Kind | None = None
    """Of an array, the type of its elements."""
    message: str = ""
    """Of a message, its type."""


_ANY = _Kind("a value")
_NUMBER = _Kind("a number")
_TRUTH = _Kind("true or false")
_STRING = _Kind("a string")


def _kind_of(type_name: str) -> _Kind:
    """Return the kind of a field with a rosidl type."""
    if array := _ARRAY.fullmatch(type_name):
        return _Kind("an array", _kind_of(array[1] or array[2]))
    if nested := _NESTED.fullmatch(type_name):
        name = f"{nested[1]}/msg/{nested[2]}"
        return _Kind(f"a {name}", message=name)
    if type_name == "boolean":
        return _TRUTH
    return _STRING if type_name.startswith(("string", "wstring")) else _NUMBER


class Expression:
    """A parsed condition on the fields of a message."""

    def __init__(self, text: str, evaluate: Evaluate, shown: Sequence[tuple[str, Evaluate]]) -> None:
        self.text = text
        self._evaluate = evaluate
        self._shown = shown

    @classmethod
    def parse(cls, text: str, type_name: str = "", fields: Fields | None = None) -> Expression:
        """Parse a condition over messages of a type, whose fields are checked if they are known.

        Raises ExpressionError.
        """
        return _condition(text.strip(), type_name, fields)

    def holds(self, message: object) -> bool:
        """Return whether it holds for a message. Raises Undefined."""
        return as_truth(self._evaluate(message, None), self.text)

    def values(self, message: object) -> str:
        """Return the first few values that it reads, such as ``percentage is 0.12``; empty if there are none to
        show."""
        described = []
        for name, evaluate in self._shown:
            try:
                value = evaluate(message, None)
            except Undefined:
                continue
            if isinstance(value, bool | int | float | str):
                described.append(f"{name} is {shown_value(value)}")
        return ", ".join(described)


class Quantity:
    """A parsed numeric expression on the fields of a message, such as ``distance_remaining``."""

    def __init__(self, text: str, evaluate: Evaluate) -> None:
        self.text = text
        self._evaluate = evaluate

    @classmethod
    def parse(cls, text: str, type_name: str = "", fields: Fields | None = None) -> Quantity:
        """Parse a number over messages of a type, whose fields are checked if they are known. Raises
        ExpressionError."""
        return _quantity(text.strip(), type_name, fields)

    def value(self, message: object) -> float:
        """Return its value for a message, which is finite. Raises Undefined."""
        try:
            value = float(self._evaluate(message, None))
        except OverflowError:
            raise Undefined(f"{self.text:.80} is too large") from None
        if not math.isfinite(value):
            raise Undefined(f"{self.text:.80} is {value:g}")
        return value


@functools.lru_cache(maxsize=REMEMBERED)
def _condition(text: str, type_name: str, fields: Fields | None) -> Expression:
    compiler, tree = _read(text, type_name, fields, _EXAMPLE)
    evaluate = compiler.truth(tree, 1)
    return Expression(text, evaluate, compiler.shown[:SHOWN])


@functools.lru_cache(maxsize=REMEMBERED)
def _quantity(text: str, type_name: str, fields: Fields | None) -> Quantity:
    compiler, tree = _read(text, type_name, fields, "a number such as distance_remaining")
    return Quantity(text, compiler.number(tree, 1))


def _read(text: str, type_name: str, fields: Fields | None, example: str) -> tuple[_Compiler, ast.expr]:
    """Return the compiler and the syntax tree of an expression. Raises ExpressionError."""
    if len(text) > LONGEST:
        raise ExpressionError(f"it has {len(text)} characters; {LONGEST} are allowed")
    if "\\" in text:
        raise ExpressionError("found a backslash; write a string without one")
    try:
        tree = ast.parse(text, mode="eval").body
    except SyntaxError as error:
        place = f" at character {error.offset}" if error.offset else ""
        raise ExpressionError(f"{text!r:.80} cannot be read{place}; write {example}") from None
    except (ValueError, MemoryError, RecursionError):
        raise ExpressionError(f"{text!r:.80} cannot be read; write {example}") from None
    if sum(1 for _ in ast.walk(tree)) > 3 * MOST_NODES:  # Python counts operators and contexts as nodes too
        raise ExpressionError(f"it has more than {MOST_NODES} names, numbers and operations")
    return _Compiler(text, _Kind(f"a {type_name}" if type_name else "the message", message=type_name), fields), tree


_EXAMPLE = "a condition such as percentage > 0.15"

_OPERATIONS: dict[type[ast.operator], tuple[str, Callable[[Any, Any], Any]]] = {
    ast.Add: ("+", operator.add),
    ast.Sub: ("-", operator.sub),
    ast.Mult: ("*", operator.mul),
    ast.Div: ("/", operator.truediv),
    ast.Mod: ("%", operator.mod),
}
_COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
_FUNCTIONS = ("abs", "min", "max", "len", "sqrt", "isfinite", "any", "all")


class _Compiler:
    """Converts Python's syntax tree into closures, construct by construct."""

    def __init__(self, text: str, message: _Kind, fields: Fields | None) -> None:
        self.shown: list[tuple[str, Evaluate]] = []
        """The fields that are read, to be shown with a result."""
        self._text, self._message, self._fields = text, message, fields
        self._element: tuple[str, _Kind] | None = None
        """Name and kind of the element, inside of any and all."""
        self._nodes = self._loops = 0

    # -- kinds of values --------------------------------------------------------------------------------------------

    def truth(self, node: ast.expr, depth: int) -> Evaluate:
        """Return a function that evaluates a truth value."""
        return self._wanted(node, depth, _TRUTH, "compare it with something")

    def number(self, node: ast.expr, depth: int) -> Evaluate:
        """Return a function that evaluates a number."""
        evaluate, text = self._wanted(node, depth, _NUMBER, "calculate with numbers"), self._source(node)
        return lambda message, element: as_number(evaluate(message, element), text)

    def _wanted(self, node: ast.expr, depth: int, wanted: _Kind, way_out: str) -> Evaluate:
        kind, evaluate = self._value(node, depth)
        if kind not in (wanted, _ANY):
            raise ExpressionError(f"{self._source(node)} is {kind.text}, not {wanted.text}; {way_out}")
        return evaluate

    def _value(self, node: ast.expr, depth: int) -> tuple[_Kind, Evaluate]:
        self._nodes += 1
        if self._nodes > MOST_NODES:
            raise ExpressionError(f"it has more than {MOST_NODES} names, numbers and operations")
        if depth > DEEPEST:
            raise ExpressionError(f"it is more than {DEEPEST} levels deep")
        match node:
            case ast.Constant():
                return self._constant(node)
            case ast.Name() | ast.Attribute() | ast.Subscript():
                found = self._path(node, depth)
                self._show(node, found)
                return found
            case ast.BoolOp():
                return _TRUTH, all_of([self.truth(v, depth + 1) for v in node.values], isinstance(node.op, ast.And))
            case ast.UnaryOp():
                return self._unary(node, depth)
            case ast.BinOp():
                return _NUMBER, self._binary(node, depth)
            case ast.Compare():
                return _TRUTH, self._compare(node, depth)
            case ast.Call():
                return self._call(node, depth)
        raise ExpressionError(
            f"{self._source(node)} is not allowed; use fields, numbers, strings, comparisons, and, or, not, "
            f"+ - * / % and {', '.join(_FUNCTIONS)}"
        )

    def _constant(self, node: ast.Constant) -> tuple[_Kind, Evaluate]:
        value = node.value
        if isinstance(value, bool):
            return _TRUTH, lambda message, element: value
        if isinstance(value, str):
            return _STRING, lambda message, element: value
        if isinstance(value, int | float):
            if not abs(value) <= LARGEST:
                raise ExpressionError(f"{self._source(node):.40} is too large; a number is at most {LARGEST:.4g}")
            return _NUMBER, lambda message, element: value
        raise ExpressionError(f"{self._source(node)} is not allowed; write a number, a string, True or False")

    # -- fields -----------------------------------------------------------------------------------------------------

    def _path(self, node: ast.expr, depth: int) -> tuple[_Kind, Evaluate]:
        """Return a field, a field of a field, or an element of an array."""
        if depth > DEEPEST:
            raise ExpressionError(f"it is more than {DEEPEST} levels deep")
        if isinstance(node, ast.Name):
            if self._element is not None and node.id == self._element[0]:
                return self._element[1], lambda message, element: element
            return self._field(self._message, lambda message, element: message, node.id)
        if isinstance(node, ast.Attribute):
            kind, evaluate = self._path(node.value, depth + 1)
            return self._field(kind, evaluate, node.attr, self._source(node.value))
        if isinstance(node, ast.Subscript):
            return self._item(node, depth)
        raise ExpressionError(f"{self._source(node)} has no fields; only fields of the message can be used")

    def _field(self, kind: _Kind, evaluate: Evaluate, name: str, of: str = "") -> tuple[_Kind, Evaluate]:
        if not _FIELD.fullmatch(name):
            raise ExpressionError(f"{name!r} cannot be a field of a message; the name of a field begins with a letter")
        found = _ANY
        if kind.message:
            known = self._fields(kind.message) if self._fields is not None else None
            if known is not None:
                if name not in known:
                    raise ExpressionError(f"{kind.message} has no field {name!r}{did_you_mean(name, known)}")
                found = _kind_of(known[name])
        elif kind not in (_ANY, self._message):
            raise ExpressionError(f"{of} is {kind.text}, which has no field {name!r}")
        return found, field_of(evaluate, name)

    def _item(self, node: ast.Subscript, depth: int) -> tuple[_Kind, Evaluate]:
        kind, array = self._path(node.value, depth + 1)
        text = self._source(node.value)
        index = _index(node.slice)
        if index is None:
            raise ExpressionError(f"{self._source(node.slice)} is not an index; write a number, such as {text}[0]")
        if kind is not _ANY and kind.item is None:
            raise ExpressionError(f"{text} is {kind.text}, not an array; remove [{index}]")

        def evaluate(message: Any, element: Any) -> Any:
            values = as_array(array(message, element), text)
            try:
                return plain_value(values[index])
            except IndexError:
                raise Undefined(f"{text} has {len(values)} elements, and so no {text}[{index}]") from None

        return kind.item or _ANY, evaluate

    def _show(self, node: ast.expr, found: tuple[_Kind, Evaluate]) -> None:
        """Show a value, except if it belongs to an element."""
        kind, evaluate = found
        text = self._source(node)
        if self._element is None and kind in (_ANY, _NUMBER, _TRUTH, _STRING) and (text not in dict(self.shown)):
            self.shown.append((text, evaluate))

    # -- operations -------------------------------------------------------------------------------------------------

    def _unary(self, node: ast.UnaryOp, depth: int) -> tuple[_Kind, Evaluate]:
        if isinstance(node.op, ast.Not):
            truth, text = self.truth(node.operand, depth + 1), self._source(node.operand)
            return _TRUTH, lambda message, element: not as_truth(truth(message, element), text)
        if isinstance(node.op, ast.USub | ast.UAdd):
            number = self.number(node.operand, depth + 1)
            if isinstance(node.op, ast.UAdd):
                return _NUMBER, number
            return _NUMBER, lambda message, element: -number(message, element)
        raise ExpressionError(f"{self._source(node)} is not allowed; use not or -")

    def _binary(self, node: ast.BinOp, depth: int) -> Evaluate:
        if type(node.op) not in _OPERATIONS:
            signs = " ".join(sign for sign, _ in _OPERATIONS.values())
            raise ExpressionError(f"{self._source(node)} is not allowed; use {signs}")
        _, calculate = _OPERATIONS[type(node.op)]
        left, right, text = self.number(node.left, depth + 1), self.number(node.right, depth + 1), self._source(node)

        def evaluate(message: Any, element: Any) -> Any:
            try:
                return calculate(left(message, element), right(message, element))
            except ZeroDivisionError:
                raise Undefined(f"{text} divides by 0") from None
            except OverflowError:
                raise Undefined(f"{text} is too large") from None

        return evaluate

    def _compare(self, node: ast.Compare, depth: int) -> Evaluate:
        places = [node.left, *node.comparators]
        texts = [self._source(place) for place in places]
        kinds, values = zip(*(self._value(place, depth + 1) for place in places), strict=True)
        steps = []
        for index, sign in enumerate(node.ops):
            compare = _COMPARISONS.get(type(sign))
            if compare is None:
                raise ExpressionError(f"{self._source(node)} is not allowed; use < <= > >= == !=")
            ordered = not isinstance(sign, ast.Eq | ast.NotEq)
            self._comparable(kinds[index : index + 2], texts[index : index + 2], ordered)
            steps.append((compare, ordered))
        if len(steps) == 1:
            return comparison_of(*steps[0], values, texts)

        def evaluate(message: Any, element: Any) -> bool:
            undefined: Undefined | None = None
            found = [value_or_undefined(value, message, element) for value in values]
            for index, (compare, ordered) in enumerate(steps):
                try:
                    if not compared(compare, ordered, found[index : index + 2], texts[index : index + 2]):
                        return False
                except Undefined as error:
                    undefined = undefined or error
            if undefined is not None:
                raise undefined
            return True

        return evaluate

    def _comparable(self, kinds: Sequence[_Kind], texts: Sequence[str], ordered: bool) -> None:
        for kind, text in zip(kinds, texts, strict=True):
            if kind.item is not None or kind.message:
                raise ExpressionError(
                    f"{text} is {kind.text}, which cannot be compared; name a field or an element of it"
                )
            if ordered and kind not in (_NUMBER, _ANY):
                raise ExpressionError(f"{text} is {kind.text}, not a number; compare it by == or !=")
        first, second = kinds
        if first != second and _ANY not in kinds:
            raise ExpressionError(
                f"{texts[0]} is {first.text}, but {texts[1]} is {second.text}; compare values of the same type"
            )

    # -- functions --------------------------------------------------------------------------------------------------

    def _call(self, node: ast.Call, depth: int) -> tuple[_Kind, Evaluate]:
        name = node.func.id if isinstance(node.func, ast.Name) else self._source(node.func)
        if not isinstance(node.func, ast.Name) or name not in _FUNCTIONS:
            raise ExpressionError(f"there is no function {name!r:.60}{did_you_mean(name[:60], _FUNCTIONS)}")
        arguments, text = node.args, self._source(node)
        if node.keywords or not arguments or any(isinstance(value, ast.Starred) for value in arguments):
            raise ExpressionError(f"{text} is not allowed; {name} is given values, such as {_CALLS[name]}")
        if len(arguments) > 1 and name not in ("min", "max"):
            raise ExpressionError(f"{text} gives {name} {len(arguments)} values; it takes one, such as {_CALLS[name]}")
        if name in ("any", "all"):
            return _TRUTH, self._loop(arguments[0], name, depth)
        if name == "len" or (name in ("min", "max") and len(arguments) == 1):
            found = _NUMBER, self._of_array(name, arguments[0], depth)
            self._show(node, found)
            return found
        values = [self.number(value, depth + 1) for value in arguments]
        if name == "isfinite":
            return _TRUTH, lambda message, element: is_finite(values[0](message, element))
        if name == "abs":
            return _NUMBER, lambda message, element: abs(values[0](message, element))
        if name == "sqrt":
            return _NUMBER, root_of(values[0], text)
        return _NUMBER, lambda message, element: extreme_of(name, [value(message, element) for value in values])

    def _of_array(self, name: str, node: ast.expr, depth: int) -> Evaluate:
        kind, evaluate = self._path(node, depth + 1)
        text = self._source(node)
        if kind is not _ANY and kind.item is None and not (name == "len" and kind is _STRING):
            raise ExpressionError(f"{text} is {kind.text}; {name} is given {_CALLS[name]}")
        if name == "len":
            return lambda message, element: length_of(evaluate(message, element), text)
        if kind.item is not None and kind.item not in (_NUMBER, _ANY):
            raise ExpressionError(f"{text} has elements that are {kind.item.text}; {name} is of numbers")

        def extreme(message: Any, element: Any) -> float:
            values = bounded_elements(evaluate(message, element), text)
            if not len(values):
                raise Undefined(f"{text} has no elements")
            return extreme_of(name, [as_number(plain_value(value), f"an element of {text}") for value in values])

        return extreme

    def _loop(self, node: ast.expr, name: str, depth: int) -> Evaluate:
        """Return a function that evaluates ``any`` or ``all`` over the elements of one array that pass the filter."""
        if not isinstance(node, ast.GeneratorExp) or len(node.generators) != 1 or node.generators[0].is_async:
            raise ExpressionError(f"{self._source(node)} cannot be iterated; write {_CALLS[name]}")
        if self._element is not None:
            raise ExpressionError(f"{name} inside of any or all is not allowed")
        self._loops += 1
        if self._loops > MOST_LOOPS:
            raise ExpressionError(f"it has more than {MOST_LOOPS} any and all")
        loop = node.generators[0]
        if not isinstance(loop.target, ast.Name) or not _FIELD.fullmatch(loop.target.id):
            raise ExpressionError(f"{self._source(loop.target)} is not a name for an element; write {_CALLS[name]}")
        kind, array = self._path(loop.iter, depth + 1)
        text = self._source(loop.iter)
        if kind is not _ANY and kind.item is None:
            raise ExpressionError(f"{text} is {kind.text}, not an array; write {_CALLS[name]}")
        self._element = loop.target.id, kind.item or _ANY
        filters = [self.truth(condition, depth + 2) for condition in loop.ifs]
        truth = self.truth(node.elt, depth + 2)
        self._element = None
        wanted = name == "any"
        each = all_of([*filters, truth if wanted else negation_of(truth)], True)
        # all(c for e in a) equals not any(not c for e in a), so one search serves both.
        return lambda message, element: (
            any_holds(message, bounded_elements(array(message, element), text), each) == wanted
        )

    def _source(self, node: ast.expr) -> str:
        text = " ".join((ast.get_source_segment(self._text, node) or "it").split())
        return text if len(text) <= 80 else f"{text[:77]}..."


_CALLS = {
    "abs": "abs(x)",
    "min": "min(ranges) or min(a, b)",
    "max": "max(ranges) or max(a, b)",
    "len": "an array or a string, as in len(ranges)",
    "sqrt": "sqrt(x)",
    "isfinite": "isfinite(x)",
    "any": "any(r < 0.2 for r in ranges)",
    "all": "all(r > 0.2 for r in ranges)",
}


def _index(node: ast.expr) -> int | None:
    """Return the index of an element, counted from the end if it is negative."""
    sign = 1
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        sign, node = -1, node.operand
    if isinstance(node, ast.Constant) and type(node.value) is int and node.value <= 2**32:
        return sign * node.value
    return None

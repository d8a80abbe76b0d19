"""Evaluates the subset of CEL (KEP-2876, cel-spec) that the validation rules of Understudy's kinds use, as the API server does.

The rules are written once, in the models. A rule that needs more of the language raises Unsupported, and a test covers all
rules. CEL libraries bring command lines, parsers and time zones (30 MB), and the images have the same dependencies.
"""

from __future__ import annotations

import functools
import operator
import re
from collections.abc import Callable, Mapping
from typing import Any

from understudy.api.base import seconds


class Unsupported(ValueError):
    """The rule uses a part of the language that is not implemented."""


class Undecided(Exception):
    """The rule has no value for this object, for example because a field is missing."""


Scope = Mapping[str, Any]
Evaluate = Callable[[Scope], Any]

_TOKEN = re.compile(
    r"""\s*(?:
      (?P<raw>r'[^']*'|r"[^"]*")
    | (?P<text>'[^'\\]*'|"[^"\\]*")
    | (?P<number>[0-9]+)
    | (?P<word>[A-Za-z_][A-Za-z0-9_]*)
    | (?P<sign>&&|\|\||==|!=|<=|>=|[-+<>!?:.,()\[\]])
    )""",
    re.VERBOSE,
)


@functools.lru_cache(maxsize=512)
def compiled(text: str) -> Evaluate:
    """Compile an expression into a function of a scope such as ``{"self": ...}``, which may raise Undecided. Raises Unsupported."""
    parser = _Parser(text)
    found = parser.choice()
    parser.end()

    def evaluate(scope: Scope) -> Any:
        try:
            return found(scope)
        except (TypeError, KeyError, AttributeError, ValueError) as error:
            raise Undecided(str(error)) from error

    return evaluate


def matches(text: str, pattern: str) -> bool:
    """Return whether an RE2 pattern matches; its ``$`` does not match before a final line break, unlike Python's."""
    return re.search(pattern[:-1] + r"\Z" if pattern.endswith("$") else pattern, text) is not None


class _Parser:
    """Recursive descent: each method parses the next higher precedence and returns the evaluator."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._tokens: list[tuple[str, str]] = []
        position = 0
        while position < len(text.rstrip()):
            found = _TOKEN.match(text, position)
            if found is None or found.lastgroup is None:
                raise Unsupported(f"{text}: syntax error at character {position + 1}")
            self._tokens.append((found.lastgroup, found[found.lastgroup]))
            position = found.end()
        self._at = 0

    def end(self) -> None:
        if self._at < len(self._tokens):
            raise Unsupported(f"{self._text}: unexpected {self._tokens[self._at][1]!r}")

    def choice(self) -> Evaluate:
        condition = self._binary()
        if not self._take("?"):
            return condition
        so = self.choice()
        self._need(":")
        otherwise = self.choice()
        return lambda scope: so(scope) if condition(scope) else otherwise(scope)

    def _binary(self, least: int = 1) -> Evaluate:
        """Parse operators that bind at least as tightly as ``least``."""
        left = self._not()
        while self._at < len(self._tokens) and (sign := self._tokens[self._at][1]) in _OPERATORS:
            rank, combine = _OPERATORS[sign]
            if rank < least:
                break
            self._at += 1
            left = combine(left, self._binary(rank + 1))
        return left

    def _not(self) -> Evaluate:
        if self._take("!"):
            inner = self._not()
            return lambda scope: not inner(scope)
        return self._member()

    def _member(self) -> Evaluate:
        value = self._primary()
        while self._take("."):
            name = self._word()
            value = self._method(value, name) if self._take("(") else _field(value, name)
        return value

    def _method(self, value: Evaluate, name: str) -> Evaluate:
        if name in _MACROS:
            variable = self._word()
            self._need(",")
            body = self.choice()
            self._need(")")
            return _over(name, value, variable, body)
        arguments = self._arguments()
        if name == "size" and not arguments:
            return lambda scope: len(value(scope))
        if len(arguments) == 1 and name in _METHODS:
            return _applied(_METHODS[name])(value, *arguments)
        raise Unsupported(f"{self._text}: {name}() is not supported")

    def _arguments(self, closing: str = ")") -> list[Evaluate]:
        found: list[Evaluate] = []
        while not self._take(closing):
            if found:
                self._need(",")
            found.append(self.choice())
        return found

    def _primary(self) -> Evaluate:
        if self._take("("):
            inner = self.choice()
            self._need(")")
            return inner
        if self._take("["):
            items = self._arguments("]")
            return lambda scope: [item(scope) for item in items]
        kind, token = self._next()
        match kind:
            case "raw":
                return _constant(token[2:-1])
            case "text":
                return _constant(token[1:-1])
            case "number":
                return _constant(int(token))
            case "word" if token in ("true", "false"):
                return _constant(token == "true")
            case "word" if self._take("("):
                return self._function(token)
            case "word":
                return lambda scope: scope[token]
        raise Unsupported(f"{self._text}: unexpected {token!r}")

    def _function(self, name: str) -> Evaluate:
        if name == "has":
            value, field = self._primary(), ""
            while self._take("."):
                value, field = _field(value, field) if field else value, self._word()
            self._need(")")
            if not field:
                raise Unsupported(f"{self._text}: has() needs a field")
            return lambda scope: field in value(scope)
        arguments = self._arguments()
        functions: dict[str, Callable[[Any], Any]] = {"size": len, "duration": seconds}
        if name not in functions or len(arguments) != 1:
            raise Unsupported(f"{self._text}: {name}() is not supported")
        function, (argument,) = functions[name], arguments
        return lambda scope: function(argument(scope))

    # -- tokens -----------------------------------------------------------------------------------------------------

    def _next(self) -> tuple[str, str]:
        if self._at >= len(self._tokens):
            raise Unsupported(f"{self._text}: unexpected end")
        self._at += 1
        return self._tokens[self._at - 1]

    def _take(self, token: str) -> bool:
        if self._at < len(self._tokens) and self._tokens[self._at] in (("sign", token), ("word", token)):
            self._at += 1
            return True
        return False

    def _need(self, token: str) -> None:
        if not self._take(token):
            raise Unsupported(f"{self._text}: {token!r} is missing")

    def _word(self) -> str:
        kind, token = self._next()
        if kind != "word":
            raise Unsupported(f"{self._text}: {token!r} is not a name")
        return token


def _constant(value: Any) -> Evaluate:
    return lambda scope: value


def _field(value: Evaluate, name: str) -> Evaluate:
    return lambda scope: value(scope)[name]


def _over(name: str, value: Evaluate, variable: str, body: Evaluate) -> Evaluate:
    """Build a macro over the items of a list or the keys of a mapping."""

    def evaluate(scope: Scope) -> Any:
        items = list(value(scope))
        return _MACROS[name](items, [item for item in items if body({**scope, variable: item})])

    return evaluate


_MACROS: dict[str, Callable[[list[Any], list[Any]], Any]] = {
    "all": lambda items, held: len(held) == len(items),
    "exists": lambda items, held: bool(held),
    "exists_one": lambda items, held: len(held) == 1,
    "filter": lambda items, held: held,
}
"""From all items, and those for which the body holds."""

_METHODS: dict[str, Callable[[Any, Any], bool]] = {
    "matches": matches,
    "contains": operator.contains,
    "startsWith": str.startswith,
    "endsWith": str.endswith,
}


def _applied(function: Callable[[Any, Any], Any]) -> Callable[[Evaluate, Evaluate], Evaluate]:
    return lambda left, right: lambda scope: function(left(scope), right(scope))


_OPERATORS: dict[str, tuple[int, Callable[[Evaluate, Evaluate], Evaluate]]] = {
    "||": (1, lambda left, right: lambda scope: left(scope) or right(scope)),
    "&&": (2, lambda left, right: lambda scope: left(scope) and right(scope)),
    "==": (3, _applied(operator.eq)),
    "!=": (3, _applied(operator.ne)),
    "<=": (3, _applied(operator.le)),
    ">=": (3, _applied(operator.ge)),
    "<": (3, _applied(operator.lt)),
    ">": (3, _applied(operator.gt)),
    "in": (3, _applied(lambda item, items: item in items)),
    "+": (4, _applied(operator.add)),
}
"""Binary operators with their precedence; a higher one binds more tightly."""

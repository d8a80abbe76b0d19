"""Evaluates the subset of CEL (KEP-2876, cel-spec) that the validation rules of Understudy's kinds use, as the API server does.

The rules are written once, in the models. A rule that needs more of the language raises Unsupported, and a test covers all
rules. CEL libraries bring command lines, parsers and time zones (30 MB), and the images have the same dependencies.
"""

from __future__ import annotations

import functools
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

_COMPARISONS: dict[str, Callable[[Any, Any], bool]] = {
    "==": lambda a, b: bool(a == b),
    "!=": lambda a, b: bool(a != b),
    "<=": lambda a, b: bool(a <= b),
    ">=": lambda a, b: bool(a >= b),
    "<": lambda a, b: bool(a < b),
    ">": lambda a, b: bool(a > b),
    "in": lambda a, b: a in b,
}


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
        condition = self._either()
        if not self._take("?"):
            return condition
        so = self.choice()
        self._need(":")
        otherwise = self.choice()
        return lambda scope: so(scope) if condition(scope) else otherwise(scope)

    def _either(self) -> Evaluate:
        left = self._both()
        while self._take("||"):
            left = _either(left, self._both())
        return left

    def _both(self) -> Evaluate:
        left = self._comparison()
        while self._take("&&"):
            left = _both(left, self._comparison())
        return left

    def _comparison(self) -> Evaluate:
        left = self._sum()
        for sign, compare in _COMPARISONS.items():
            if self._take(sign):
                return _applied(compare, left, self._sum())
        return left

    def _sum(self) -> Evaluate:
        left = self._not()
        while self._take("+"):
            left = _applied(lambda a, b: a + b, left, self._not())
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
        if name in ("all", "exists", "exists_one", "filter"):
            variable = self._word()
            self._need(",")
            body = self.choice()
            self._need(")")
            return _over(name, value, variable, body)
        arguments = self._arguments()
        if name == "size" and not arguments:
            return lambda scope: len(value(scope))
        if len(arguments) == 1 and name in ("matches", "contains", "startsWith", "endsWith"):
            (argument,) = arguments
            function = {
                "matches": matches,
                "contains": lambda text, part: part in text,
                "startsWith": str.startswith,
                "endsWith": str.endswith,
            }[name]
            return _applied(function, value, argument)
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


def _applied(function: Callable[[Any, Any], Any], left: Evaluate, right: Evaluate) -> Evaluate:
    return lambda scope: function(left(scope), right(scope))


def _either(left: Evaluate, right: Evaluate) -> Evaluate:
    return lambda scope: left(scope) or right(scope)


def _both(left: Evaluate, right: Evaluate) -> Evaluate:
    return lambda scope: left(scope) and right(scope)


def _over(name: str, value: Evaluate, variable: str, body: Evaluate) -> Evaluate:
    """Build a macro over the items of a list or the keys of a mapping."""

    def evaluate(scope: Scope) -> Any:
        held = [item for item in value(scope) if body({**scope, variable: item})]
        match name:
            case "all":
                return len(held) == len(value(scope))
            case "exists":
                return bool(held)
            case "exists_one":
                return len(held) == 1
        return held

    return evaluate

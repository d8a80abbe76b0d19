"""Reads untrusted OpenSCENARIO 2 with the parser of scenario-execution, into plain parts with their positions.

Only its lexer and parser are used. Its model would follow imports into files, load the entry points of other installed
packages, and create the behaviours. The import of the parser takes 0.1 s and 15 MB, so it is imported only for a policy
in this language.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from understudy.api.durations import LONGEST_TEXT
from understudy.trees.languages.osc import tokens
from understudy.trees.languages.osc.dialects import Dialect
from understudy.trees.languages.osc.syntax_errors import FirstErrorListener
from understudy.trees.languages.osc.tokens import Token
from understudy.trees.source.positions import WHOLE_FILE, Malformed, TextOffset

_FETCHED = 1000
"""Tokens that are read from a text at once."""

_EXPRESSIONS = """
expression implication disjunction conjunction inversion relation sumExpression term factor postfixExp primaryExp valueExp
"""

_CHAIN = frozenset(_EXPRESSIONS.split())
"""Rules for the precedence of operators in expressions, which mean nothing by themselves."""


_REMEMBERED = 32
"""Texts whose parts are kept: more than the health trees of one policy."""

_NOT_INSTALLED = (
    "OpenSCENARIO 2 needs the Python package scenario-execution, which is not installed; install understudy with the extra osc: "
    "pip install '.[osc]' in its repository"
)

_alone = threading.Lock()
"""Held while the parser runs: its threads would share the tables that it fills."""


@dataclass(frozen=True, slots=True)
class Part:
    """The match of one rule of the grammar, or one word."""

    rule: str
    """Name of the rule in the grammar, such as ``behaviorInvocation``; empty for a word."""
    text: str
    """The matched text."""
    line: int
    column: int
    """Column of its first character in the file, counted from 1."""
    parts: tuple[Part, ...] = ()

    def all(self, *rules: str) -> Iterator[Part]:
        """Yield the parts of some rules."""
        return (part for part in self.parts if part.rule in rules)

    def first(self, rule: str) -> Part | None:
        """Return the first part of a rule."""
        return next(self.all(rule), None)

    def text_of(self, rule: str) -> str:
        """Return the text of the first part of a rule; empty if there is none."""
        found = self.first(rule)
        return found.text if found is not None else ""


@functools.lru_cache(maxsize=_REMEMBERED)
def parse(text: str, dialect: Dialect, begins: TextOffset = WHOLE_FILE) -> Part:
    """Parse a text that has only the words of a dialect, with the lines and columns of the file in which it ``begins``.

    The parser takes 0.3 s for the longest trees. The last texts are remembered, so that another thread can parse them ahead.
    Raises Malformed.
    """
    try:
        with _alone:
            return _parsed(text, dialect, begins)
    except Malformed as error:
        error.line += begins.lines
        error.column += begins.columns
        raise
    except RecursionError as error:  # too deep texts were refused before; this is for an unforeseen way to nest
        raise Malformed("the nesting is too deep") from error


def _parsed(text: str, dialect: Dialect, begins: TextOffset) -> Part:
    if len(text) > LONGEST_TEXT:
        raise Malformed(f"the text has {len(text)} characters; it may have {LONGEST_TEXT}")
    # Imported late because of its cost, see above.
    try:
        from antlr4 import CommonTokenStream, InputStream
        from scenario_execution.osc2_parsing.OpenSCENARIO2Lexer import OpenSCENARIO2Lexer
        from scenario_execution.osc2_parsing.OpenSCENARIO2Parser import OpenSCENARIO2Parser
    except ImportError as error:
        raise Malformed(_NOT_INSTALLED) from error

    complaints = FirstErrorListener()
    source = InputStream(text if text.endswith("\n") else f"{text}\n")
    lexer = OpenSCENARIO2Lexer(source)
    stream = CommonTokenStream(lexer)
    parser = OpenSCENARIO2Parser(stream)
    for recognizer in (lexer, parser):
        recognizer.removeErrorListeners()  # the default listeners print
        recognizer.addErrorListener(complaints)
    # Not all at once: the tokens of a text that has too many are not all needed to refuse it.
    stream.lazyInit()
    while len(stream.tokens) <= tokens.MOST and stream.fetch(_FETCHED) == _FETCHED:
        pass
    found = [_token(parser, token) for token in stream.tokens]
    tokens.check(found, dialect.subject, dialect.words)
    return _Parts(parser.ruleNames, source, begins).part(parser.osc_file())


def _token(parser: Any, found: Any) -> Token:
    literal = parser.literalNames[found.type] if 0 < found.type < len(parser.literalNames) else "<INVALID>"
    symbol = parser.symbolicNames[found.type] if found.type > 0 else "EOF"
    kind = literal.strip("'") if literal != "<INVALID>" else _SIGNS.get(symbol, symbol)
    return Token(kind, found.text, found.line, found.column + 1)


_SIGNS = {"OPEN_PAREN": "(", "CLOSE_PAREN": ")", "OPEN_BRACK": "[", "CLOSE_BRACK": "]"}


class _Parts:
    """Converts the parser's result into parts."""

    def __init__(self, rules: list[str], source: Any, begins: TextOffset) -> None:
        self._rules, self._source, self._begins = rules, source, begins

    def part(self, found: Any) -> Part:
        symbol = getattr(found, "symbol", None)
        if symbol is not None:
            return Part("", symbol.text, *self._place(symbol))
        rule = self._rules[found.getRuleIndex()]
        children = found.children or []
        if rule in _CHAIN and len(children) == 1 and getattr(children[0], "symbol", None) is None:
            return self.part(children[0])
        start, stop = found.start, found.stop or found.start
        if rule == "osc_file":  # otherwise the file begins at its first word
            place = (1 + self._begins.lines, 1 + self._begins.columns)
            return Part(rule, "", *place, tuple(self.part(child) for child in children))
        text = self._source.getText(start.start, max(start.start, stop.stop)) if rule in _WRITTEN else ""
        return Part(rule, text, *self._place(start), tuple(self.part(child) for child in children))

    def _place(self, symbol: Any) -> tuple[int, int]:
        return symbol.line + self._begins.lines, symbol.column + 1 + self._begins.columns


_NAMED = """
importReference structuredIdentifier qualifiedBehaviorName behaviorName modifierName labelName argumentName fieldName typeDeclarator
compositionOperator physicalLiteral unitName integerLiteral identifierReference enumValueReference enumName enumMemberName
functionApplicationExpression fieldAccessExpression
"""

_WRITTEN = _CHAIN | frozenset(_NAMED.split())
"""Rules whose text is needed; the text of the others is long."""

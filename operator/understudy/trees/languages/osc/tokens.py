"""Refuses a text by its tokens, before it is parsed: words that trees cannot have, and too deep nesting.

The remaining part of the language is small, so that a text cannot keep the parser busy, although it looks ahead without
a limit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from understudy.trees.languages.osc.library import WORDS
from understudy.trees.source.positions import Malformed
from understudy.trees.source.tree_kinds import TreeKind
from understudy.trees.source.value_reader import DEEPEST

MOST = 20_000
"""Greatest number of words and signs in a text: about forty for each of the nodes that a tree may have."""

DEEPEST_BLOCK = DEEPEST + 4
"""Greatest depth of nested blocks: the levels of the tree within those of the scenario."""

DEEPEST_BRACKETS = 4
"""Greatest depth of nested brackets: arguments have one pair."""

NEWLINE, INDENT, DEDENT = "NEWLINE", "INDENT", "DEDENT"

_TASK = "write while_task_active() in the node's with: for what only counts while the robot works on a task"
_JUDGES = "a health tree takes no action"
_DECLARES = "a policy can declare only one scenario and its parameters; all other names come with import osc.understudy"
_EVERYWHERE = "only one scenario and its parameters can be declared; all other names come with import osc.understudy"
_EVENTS = f"{_JUDGES}, and neither waits nor sends events; remove it. Use gap for how long something may be missing"
_CALCULATES = "calculations are not supported; write the value"

REFUSED: Mapping[str, str] = {
    **dict.fromkeys(("type", "unit", "enum", "struct", "actor", "action", "modifier", "global", "extend"), _DECLARES),
    "as": "imported names cannot be changed; remove it",
    "inherits": "a scenario cannot inherit from another one; remove it",
    **dict.fromkeys(
        ("wait", "emit", "event", "on", "until", "elapsed", "every", "rise", "fall", "sample", "@"), _EVENTS
    ),
    **dict.fromkeys(
        ("call", "def", "external", "expression", "undefined", "only"),
        f"{_JUDGES} and calls no functions; remove it",
    ),
    **dict.fromkeys(("keep", "default", "hard", "remove_default"), "constraints are not supported; write the value"),
    **dict.fromkeys(("cover", "record", "range", "var"), f"{_JUDGES} and records nothing; remove it"),
    **dict.fromkeys(("if", "?"), _TASK),
    **dict.fromkeys(("or", "and", "not"), "write one_of:, parallel:, or inverter() in the node's with:"),
    **dict.fromkeys(
        ("==", "!=", "<", "<=", ">", ">=", "in"), "write the comparison as a text, in the argument holds of value()"
    ),
    **dict.fromkeys(("+", "-", "*", "/", "%", "=>", "..", "it"), _CALCULATES),
    **dict.fromkeys(("list", "[", "]"), "a value cannot be a list; write the value"),
    **dict.fromkeys(
        ("bool", "uint"), "no value is of that type; write the type that the argument has in understudy.osc"
    ),
    "->": f"{_JUDGES} and calls no functions; remove it",
}
"""Words and signs of the language that no health tree has, and what to use instead."""

_NO_CALLS = "it calls no functions; remove it"
_WAITED = "use wait_for() to wait, and timeout() in the with: of a node to limit the time; remove it"
_CHECK_DOES_NOT_WAIT = "a check is evaluated in every period and does not wait; remove it"
_BRANCH = "write a one_of: with a serial: in it: first the condition, then what depends on it"
_COMPARED = "write what must hold as a condition, such as parameter_is() or value()"


def _refused(events: str) -> Mapping[str, str]:
    """Return the same for procedures and checks; ``events`` is the message for words that wait for events."""
    return {
        **REFUSED,
        **{word: _EVERYWHERE for word, why in REFUSED.items() if why == _DECLARES},
        **{word: events for word, why in REFUSED.items() if why == _EVENTS},
        **dict.fromkeys(("call", "def", "external", "expression", "undefined", "only", "->"), _NO_CALLS),
        **dict.fromkeys(("cover", "record", "range", "var"), "it records nothing; remove it"),
        **dict.fromkeys(("if", "?"), _BRANCH),
        **dict.fromkeys(("==", "!=", "<", "<=", ">", ">=", "in"), _COMPARED),
        **dict.fromkeys(("list", "[", "]"), "no value is a list; write a text, such as '/amcl_pose, /map'"),
    }


REFUSED_IN_PROCEDURES = _refused(_WAITED)
"""Words and signs that no procedure has."""

REFUSED_IN_CHECKS = _refused(_CHECK_DOES_NOT_WAIT)
"""Words and signs that no check has."""


@dataclass(frozen=True)
class Token:
    """A word or sign."""

    kind: str
    """``NEWLINE``, ``INDENT``, ``DEDENT``, or the type of a literal, such as ``StringLiteral``; otherwise the word
    itself."""
    text: str
    line: int
    column: int
    """Line and column count from 1."""


def check(tokens: Sequence[Token], subject: TreeKind, refused: Mapping[str, str]) -> None:
    """Refuse too many tokens, and all words that trees of this kind cannot have. Raises Malformed at the first."""
    if len(tokens) > MOST:
        last = tokens[MOST]
        raise Malformed(f"the text has more than {MOST} words and signs", last.line, last.column)
    _depths(tokens)
    _blocks(tokens)
    importing = False
    for before, token, after in _neighbours(tokens):
        importing = token.kind == "import" or (importing and token.kind != NEWLINE)
        message = _refusal(before, token, after, subject, refused)
        if message is not None and not (importing and token.kind == "."):
            raise _at(token, message)


def _refusal(before: Token, token: Token, after: Token, subject: TreeKind, refused: Mapping[str, str]) -> str | None:
    """Return why a word or sign cannot be at its place."""
    if token.kind == ".":
        return f"{subject.a} has no actors and no fields; remove the dot and what is before it"
    if token.kind == "(" and before.kind == ")":
        return f"'(' is not for {subject.many}: {_CALCULATES}"
    if token.kind in WORDS and after.kind == ":" and before.kind in ("(", ","):
        return f"{token.text!r} is a word of OpenSCENARIO and no argument{_RIGHT.get(token.text, '')}"
    if token.kind in WORDS - _OPEN and after.kind == ":" and before.kind in (NEWLINE, INDENT, DEDENT, "do"):
        return f"{token.text!r} is a word of OpenSCENARIO and no name; write |{token.text}|"
    if token.kind in refused:
        return f"{token.text!r} is not for {subject.many}: {refused[token.kind]}"
    return None


_OPEN = frozenset({"serial", "parallel", "one_of", "with"})
"""Words that are followed by a colon."""

_RIGHT = {
    "type": "; write topic_type, or action_type of an action",
    "action": "; write action_name",
    "default": "; remove it",
    "only": "; write names",
    "wait": "; write pause",
}


def _at(token: Token, message: str) -> Malformed:
    return Malformed(message, token.line, token.column)


def _neighbours(tokens: Sequence[Token]) -> Iterable[tuple[Token, Token, Token]]:
    edge = Token(NEWLINE, "", 1, 1)
    for index, token in enumerate(tokens):
        after = tokens[index + 1] if index + 1 < len(tokens) else edge
        yield (tokens[index - 1] if index else edge), token, after


def _depths(tokens: Sequence[Token]) -> None:
    brackets = blocks = 0
    for token in tokens:
        brackets += (token.kind == "(") - (token.kind == ")")
        blocks += (token.kind == INDENT) - (token.kind == DEDENT)
        if brackets > DEEPEST_BRACKETS:
            raise _at(token, f"more than {DEEPEST_BRACKETS} nested brackets")
        if brackets < 0:
            raise _at(token, "closes a bracket that is not open; remove it")
        if blocks > DEEPEST_BLOCK:
            raise _at(token, f"more than {DEEPEST_BLOCK} nested blocks")


def _blocks(tokens: Sequence[Token]) -> None:
    """Refuse a line whose indentation is between those of its block and the block around it, because its block cannot
    be determined."""
    columns, first = [1], True
    for token, after in pairwise(tokens):
        if token.kind == INDENT:
            columns.append(after.column)
        elif token.kind == DEDENT:
            columns.pop()
            if after.kind not in (INDENT, DEDENT, NEWLINE, "EOF") and after.column != columns[-1]:
                raise _at(
                    after,
                    "is indented like none of the blocks around it; begin the lines of a block in the same column",
                )
        elif first and token.kind != NEWLINE and token.column != columns[0]:
            raise _at(token, "the first line is indented; begin it in the first column of the text")
        first = first and token.kind == NEWLINE

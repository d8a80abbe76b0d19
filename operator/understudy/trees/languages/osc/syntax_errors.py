"""Formats the errors of lexer and parser as messages."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from understudy.trees.languages.osc.tokens import REFUSED
from understudy.trees.source.positions import Malformed

_NAMES = {
    "Identifier": "a name",
    "StringLiteral": "a text in quotes",
    "UintLiteral": "a number",
    "NEWLINE": "the end of the line",
    "INDENT": "an indented line",
    "DEDENT": "the end of the block",
    "<EOF>": "the end of the text",
}
"""Names of expected tokens in messages; a token that is missing here is named by its word."""

_UNTOLD = frozenset(
    {"FloatLiteral", "HexUintLiteral", "IntLiteral", "BoolLiteral", "'import'", *(f"'{word}'" for word in REFUSED)}
)
"""Expected tokens that messages omit: another word means the same, or health trees cannot have them."""

_UNREAD = re.compile(r"token recognition error at: '(.*)'", re.DOTALL)
_EXPECTED = re.compile(r"(?:expecting|missing) (\{.*?\}|'[^']+'|\w+)( at|$)", re.DOTALL)


class FirstErrorListener:
    """Ends the parsing at the first error, because the following ones are usually its consequences."""

    def syntaxError(self, recognizer: Any, symbol: Any, line: int, column: int, message: str, error: Any) -> None:
        """Raise the error; called by lexer and parser."""
        if (unread := _UNREAD.fullmatch(message)) is not None:
            raise Malformed(_unread(unread[1]), line, column + 1)
        tokens = recognizer.getTokenStream().tokens
        if (place := _without_colon(symbol, tokens)) is not None:
            raise Malformed(
                "this is not OpenSCENARIO 2: an indented block follows, so this line must end with ':'", *place
            )
        found, line, column = _found(symbol, tokens)
        raise Malformed(f"this is not OpenSCENARIO 2: found {found}{_expected(message, symbol.text)}", line, column)

    def reportAmbiguity(self, *_: Any) -> None:
        """Ignore that a text can be read in two ways; the parser takes the first."""

    def reportAttemptingFullContext(self, *_: Any) -> None:
        """Ignore that the parser looks further ahead."""

    def reportContextSensitivity(self, *_: Any) -> None:
        """Ignore that the parser ends looking further ahead."""


def _unread(text: str) -> str:
    if text[:1] in ("'", '"'):
        hint = "close the quotes, and write \\ before quotes in it"
        return f"this is not OpenSCENARIO 2: the string that begins here is not closed on its line; {hint}"
    if text[:1] == "|":
        return "this is not OpenSCENARIO 2: the name that begins here is not closed; close it with |"
    return f"this is not OpenSCENARIO 2: found {text[:1]!a}, with which no word of the language begins; remove it"


def _found(symbol: Any, tokens: Sequence[Any]) -> tuple[str, int, int]:
    """Return what was found and its position. The end of a line or of a block is placed behind the last word before
    it."""
    if symbol.text.strip() and symbol.text != "<EOF>":
        return repr(symbol.text if len(symbol.text) <= 60 else f"{symbol.text[:57]}..."), symbol.line, symbol.column + 1
    read_tokens = _read(symbol, tokens)
    indented = _is_indented(symbol)
    if indented or not read_tokens:
        what = "an indented line" if indented else "the end of the text"
        return what, symbol.line, symbol.column + 1
    return "the end of the line", *_behind(read_tokens[-1])


def _without_colon(symbol: Any, tokens: Sequence[Any]) -> tuple[int, int] | None:
    """Return the end of the line in front of an indented one, if it lacks the colon that begins a block."""
    read_tokens = _read(symbol, tokens)
    if not _is_indented(symbol) or not read_tokens or read_tokens[-1].text == ":":
        return None
    return _behind(read_tokens[-1])


def _is_indented(symbol: Any) -> bool:
    return bool(symbol.text.strip("\n\r\f")) and not symbol.text.strip()


def _read(symbol: Any, tokens: Sequence[Any]) -> list[Any]:
    """Return the words in front of a token."""
    return [token for token in tokens[: symbol.tokenIndex] if token.text.strip()]


def _behind(token: Any) -> tuple[int, int]:
    return token.line, token.column + len(token.text) + 1


def _expected(message: str, found: str) -> str:
    """Return what could be there instead, limited to what a health tree can have."""
    match = _EXPECTED.search(message)
    if found == "=":
        return "; write ':' between the name of an argument and its value"
    if match is None:
        return ", which cannot be here; check the brackets, and for a ':' in front of it"
    listed = [part.strip() for part in re.split(r", (?=['\w<])", match[1].strip("{}"))]
    known = list(dict.fromkeys(_NAMES.get(part, part) for part in listed if part not in _UNTOLD))
    if not known:
        return "; remove it"
    return f"; there should be {' or '.join(filter(None, [', '.join(known[:-1]), known[-1]]))}"

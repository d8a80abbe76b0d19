"""Reads untrusted XML, with the position of each element.

Without a document type there are no entities except XML's own five, so nothing is expanded or fetched. Texts with a
document type are refused before they are parsed: expat continues to the end of a text after a handler has raised.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from xml.parsers import expat

from understudy.api.durations import LONGEST_TEXT
from understudy.trees.source.positions import WHOLE_FILE, Malformed, TextOffset

DEEPEST = 64
"""Greatest depth of nested elements."""

MOST = 4096
"""Greatest number of elements in a text: more than a tree has, to allow for the models that Groot 2 adds for nodes of
other libraries."""

_DOCTYPE = "<!DOCTYPE"


@dataclass(frozen=True)
class Element:
    """One element with its contents."""

    tag: str
    attributes: dict[str, str]
    line: int
    """Line of its first character; the first line of the file is 1."""
    column: int
    """Column of its first character, counted in characters from 1."""
    children: list[Element] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)
    """The texts between its elements, except white space."""


_INVALID_TOKEN = expat.errors.codes[expat.errors.XML_ERROR_INVALID_TOKEN]


def parse(text: str, begins: TextOffset = WHOLE_FILE) -> Element:
    """Return the root element, with the lines and columns of the file in which the text ``begins``. Raises
    Malformed."""
    try:
        return _parsed(text, begins)
    except Malformed as error:
        error.line += begins.lines
        error.column += begins.columns
        raise


def _parsed(text: str, begins: TextOffset) -> Element:
    if len(text) > LONGEST_TEXT:
        raise Malformed(f"the text has {len(text)} characters; it may have {LONGEST_TEXT}")
    if (start := text.find(_DOCTYPE)) >= 0:
        line, column = text.count("\n", 0, start) + 1, start - text.rfind("\n", 0, start)
        raise Malformed("a document type can have entities and name files to read; remove it", line, column)
    return _Builder(begins).parse(text)


def _hint(text: str, error: expat.ExpatError) -> str:
    """Say how to write a character that XML uses itself, if that is what is wrong."""
    lines = text.split("\n")
    line = lines[error.lineno - 1] if error.lineno <= len(lines) else ""
    if error.code == _INVALID_TOKEN and line[error.offset : error.offset + 1] == "<":
        return "; write &lt; for < in the value of an attribute"
    if line[: error.offset + 1].rstrip(" ").endswith("&"):
        return "; write &amp; for &"
    return ""


class _Builder:
    def __init__(self, begins: TextOffset) -> None:
        self._begins = begins
        self._open: list[Element] = []
        self._outermost: Element | None = None
        self._count = 0
        self._parser = expat.ParserCreate()
        self._parser.buffer_text = True
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.CharacterDataHandler = self._text

    def parse(self, text: str) -> Element:
        try:
            self._parser.Parse(text, True)
        except expat.ExpatError as error:
            message = f"this is not XML: {expat.ErrorString(error.code)}{_hint(text, error)}"
            raise Malformed(message, error.lineno, error.offset + 1) from error
        except UnicodeEncodeError as error:
            raise Malformed("this is not XML: it has a lone surrogate") from error
        assert self._outermost is not None, "what is well-formed has one"
        return self._outermost

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        line, column = self._parser.CurrentLineNumber, self._parser.CurrentColumnNumber + 1
        self._count += 1
        if self._count > MOST:
            raise Malformed(f"the text has more than {MOST} elements", line, column)
        if len(self._open) >= DEEPEST:
            raise Malformed(f"more than {DEEPEST} nested elements", line, column)
        element = Element(tag, attributes, line + self._begins.lines, column + self._begins.columns)
        if self._open:
            self._open[-1].children.append(element)
        else:
            self._outermost = element
        self._open.append(element)

    def _end(self, tag: str) -> None:
        self._open.pop()

    def _text(self, text: str) -> None:
        if self._open and (stripped := text.strip()):
            self._open[-1].texts.append(stripped)

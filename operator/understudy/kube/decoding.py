"""Decodes what the API server sends, whatever an object contains.

Values that are nested too deeply are replaced by null, so that neither decoding nor anything else that is done with objects
ends with a RecursionError. The field that contained them is still too deep, so the models refuse it (api/nesting.py).
"""

from __future__ import annotations

import contextlib
import gc
import json
import re
from collections.abc import Iterator
from typing import Any

from understudy.api.nesting import DEEPEST_OBJECT, is_too_deep

LONG = 100_000
"""Characters of a text from which on collections of garbage would take long."""

_DECODER = json.JSONDecoder()
_BETWEEN = re.compile(r"[\s,]*")
_TOKEN = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"|[][{}]')
"""A string, in which brackets do not count, or a bracket."""


def decode(text: str | bytes) -> Any:
    """Return the decoded text, with null for values that are nested more than DEEPEST_OBJECT levels deep. Raises ValueError."""
    text = text if isinstance(text, str) else text.decode()
    with _uncollected(text):
        try:
            value = json.loads(text)
        except RecursionError:
            return json.loads(_cut(text))
        return json.loads(_cut(text)) if _is_deep(value, text, 0, len(text)) else value


def decode_each(text: str) -> Iterator[Any]:
    """Yield the values of a text that contains several with commas between them, each as :func:`decode` does."""
    at = _after(text, 0)
    while at < len(text):
        with _uncollected(text):
            try:
                value, end = _DECODER.raw_decode(text, at)
            except RecursionError:
                text, at = _cut(text[at:]), 0
                continue
            value = json.loads(_cut(text[at:end])) if _is_deep(value, text, at, end) else value
        yield value
        at = _after(text, end)


def bounded(text: str) -> str:
    """Return the text of a value as :func:`decode` would read it, for a decoder that is not ours. Raises ValueError."""
    with _uncollected(text):
        try:
            deep = _has_many(text, 0, len(text)) and is_too_deep(json.loads(text), DEEPEST_OBJECT)
        except RecursionError:
            deep = True
        return _cut(text) if deep else text


@contextlib.contextmanager
def _uncollected(text: str) -> Iterator[None]:
    """Collect no garbage while a long text is decoded, and exempt the result from later collections.

    A collection begins after every 700 new mappings and lists. Of a text with 250,000 of them it finds nothing, and takes five
    times as long as decoding it. The result has no cycles, so it is freed when nothing refers to it.
    """
    paused = len(text) >= LONG and gc.isenabled()
    if paused:
        gc.collect(1)  # so that no young garbage is exempt
        gc.disable()
    try:
        yield
    finally:
        if paused:
            gc.freeze()
            gc.enable()


def _is_deep(value: Any, text: str, begin: int, end: int) -> bool:
    """Whether the value of a text is nested too deeply."""
    return _has_many(text, begin, end) and is_too_deep(value, DEEPEST_OBJECT)


def _has_many(text: str, begin: int, end: int) -> bool:
    """Whether a text has so many mappings and lists that it could be too deep. Few objects do, and counting costs little."""
    opened = sum(text.count(bracket, begin, end) for bracket in "{[")
    return opened - sum(text.count(empty, begin, end) for empty in ("{}", "[]")) >= DEEPEST_OBJECT


def _cut(text: str) -> str:
    """Return the text with null for values that are nested too deeply. This takes several times as long as decoding it."""
    kept, depth, begin = [], 0, 0
    for token in _TOKEN.finditer(text):
        bracket = text[token.start()]
        if bracket in "{[":
            depth += 1
            if depth == DEEPEST_OBJECT + 1:
                kept.append(text[begin : token.start()])
        elif bracket in "}]":
            if depth == DEEPEST_OBJECT + 1:
                begin = token.end()
            depth -= 1
    return "null".join([*kept, text[begin:]])


def _after(text: str, at: int) -> int:
    """Return the position at which the text between two values ends."""
    found = _BETWEEN.match(text, at)
    assert found is not None, "nothing is between them, at least"
    return found.end()

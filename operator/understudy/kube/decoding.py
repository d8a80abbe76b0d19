"""Decodes what the API server sends, whatever an object contains.

Values that are nested too deeply are replaced by null, so that neither decoding nor anything else that is done with objects
ends with a RecursionError. The field that contained them is still too deep, so the models refuse it (api/nesting.py).
"""

from __future__ import annotations

import contextlib
import gc
import itertools
import json
import re
from array import array
from collections.abc import Iterator
from typing import Any

from understudy.api.nesting import DEEPEST_OBJECT

LONG = 100_000
"""Characters of a text from which on collections of garbage would take long."""

_DECODER = json.JSONDecoder()
_ONE_KIND = bytes.maketrans(b"{}", b"[]")
_OTHERS = bytes(set(range(256)) - set(b"[]{}"))
_STEPS = bytes.maketrans(b"[]", b"\x01\xff")
"""What each bracket adds to the depth, as signed bytes."""
_BETWEEN = re.compile(r"[\s,]*")
_TOKEN = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"|[][{}]')
"""A string, in which brackets do not count, or a bracket."""


def decode(text: str | bytes) -> Any:
    """Return the decoded text, with null for values that are nested more than DEEPEST_OBJECT levels deep. Raises ValueError."""
    text = text if isinstance(text, str) else text.decode()
    with _uncollected(text):
        return json.loads(bounded(text))


def decode_each(text: str) -> Iterator[Any]:
    """Yield the values of a text that contains several with commas between them, each as :func:`decode` does."""
    text = bounded(text)
    at = _after(text, 0)
    while at < len(text):
        with _uncollected(text):
            value, end = _DECODER.raw_decode(text, at)
        yield value
        at = _after(text, end)


def bounded(text: str) -> str:
    """Return the text of values with null for those that are nested too deeply."""
    return _cut(text) if _is_deep(text) else text


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


def _is_deep(text: str) -> bool:
    """Whether values of a text are nested too deeply.

    The text itself is counted, without a loop over its values in Python: half a million of them fit into an object. Few objects have
    enough mappings and lists to be too deep.
    """
    if sum(text.count(bracket) for bracket in "{[") <= DEEPEST_OBJECT:
        return False
    outside_strings = "".join(text.replace("\\\\", "").replace('\\"', "").split('"')[::2])
    brackets = outside_strings.encode().translate(_ONE_KIND, _OTHERS)
    # The innermost level is most of what a wide object has.
    steps = array("b", brackets.replace(b"[]", b"").translate(_STEPS))
    return max(itertools.accumulate(steps), default=0) >= DEEPEST_OBJECT


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

"""Decodes what the API server sends, whatever an object contains.

Values that are nested too deeply are replaced by null, so that neither decoding nor anything else that is done with objects
ends with a RecursionError. The field that contained them is still too deep, so the models refuse it (api/nesting.py).
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import itertools
import json
import re
import threading
from array import array
from collections.abc import Iterator
from typing import Any

from understudy.api.nesting import DEEPEST_OBJECT

LONG = 100_000
"""Characters of a text from which on decoding it, and collections of garbage meanwhile, would take long."""

_DECODER = json.JSONDecoder()
_BRACKET = re.compile(r"[][{}]")
_OTHERS = bytes(set(range(256)) - set(b"[]{}"))
_STEPS = bytes.maketrans(b"[{]}", b"\x01\x01\xff\xff")
"""What each bracket adds to the depth, as signed bytes."""
_BETWEEN = re.compile(r"[\s,]*")


def decode(text: str | bytes) -> Any:
    """Return the decoded text, with null for values that are nested more than DEEPEST_OBJECT levels deep. Raises ValueError."""
    text = text if isinstance(text, str) else text.decode()
    with _uncollected(text):
        return json.loads(bounded(text))


async def decoded(text: str | bytes) -> Any:
    """Return what :func:`decode` returns. Others run while a long text is decoded: 1.4 MB take 0.1 s, and 0.3 s at worst."""
    return decode(text) if len(text) < LONG else await asyncio.to_thread(decode, text)


def decode_each(text: str) -> Iterator[Any]:
    """Yield the values of a text that contains several with commas between them, each as :func:`decode` does."""
    at = _after(text, 0)
    while at < len(text):
        with _uncollected(text):
            try:
                value, end = _DECODER.raw_decode(text, at)
            except RecursionError:
                text, at = bounded(text[at:]), 0
                continue
            # Only this value is counted: whoever takes the values may let others run between two of them.
            whole = text[at:end]
            if (cut := bounded(whole)) is not whole:
                value = json.loads(cut)
        yield value
        at = _after(text, end)


def bounded(text: str) -> str:
    """Return the text of values with null for those that are nested too deeply.

    Half a million values fit into an object, so no loop in Python visits them all. Few objects have enough mappings and lists to be too
    deep.
    """
    if sum(text.count(bracket) for bracket in "{[") <= DEEPEST_OBJECT:
        return text
    parts = text.replace("\\\\", "__").replace('\\"', "__").split('"')
    parts[1::2] = map("_".__mul__, map(len, parts[1::2]))  # brackets in strings do not count
    without_strings = '"'.join(parts)
    depths = list(itertools.accumulate(array("b", without_strings.encode().translate(_STEPS, _OTHERS))))
    if max(depths, default=0) <= DEEPEST_OBJECT:
        return text
    kept, end, places = [], 0, _Places(without_strings)
    for first, last in _spans(depths):
        kept.append(text[end : places.of(first)])
        end = places.of(last) + 1
    return "null".join([*kept, text[end:]])


def _spans(depths: list[int]) -> Iterator[tuple[int, int]]:
    """Yield the first and the last bracket of each value that is too deep, given the depth after each bracket."""
    depths.append(DEEPEST_OBJECT)  # a malformed text may end within such a value
    last = -1
    with contextlib.suppress(ValueError):  # there are no more
        while True:
            first = depths.index(DEEPEST_OBJECT + 1, last + 1)
            last = depths.index(DEEPEST_OBJECT, first)
            yield first, last


class _Places:
    """Where the brackets of a text are, asked for in ascending order."""

    def __init__(self, text: str) -> None:
        self._text, self._brackets, self._next = text, _BRACKET.finditer(text), 0

    def of(self, number: int) -> int:
        """Return the place of a bracket; the end of the text if it has fewer."""
        found = next(itertools.islice(self._brackets, number - self._next, None), None)
        self._next = number + 1
        return len(self._text) if found is None else found.start()


@contextlib.contextmanager
def _uncollected(text: str) -> Iterator[None]:
    """Collect no garbage while a long text is decoded, and exempt the result from later collections.

    A collection begins after every 700 new mappings and lists. Of a text with 250,000 of them it finds nothing, and takes five
    times as long as decoding it. The result has no cycles, so it is freed when nothing refers to it.
    """
    if len(text) < LONG:
        yield
        return
    _PAUSE.begin()
    try:
        yield
    finally:
        _PAUSE.end()


class _Pause:
    """Collects no garbage while one or more threads decode."""

    def __init__(self) -> None:
        self._lock, self._threads, self._was_enabled = threading.Lock(), 0, True

    def begin(self) -> None:
        with self._lock:
            if not self._threads:
                self._was_enabled = gc.isenabled()
                gc.collect(1)  # so that no young garbage is exempt
                gc.disable()
            self._threads += 1

    def end(self) -> None:
        with self._lock:
            self._threads -= 1
            if not self._threads and self._was_enabled:
                gc.freeze()
                gc.enable()


_PAUSE = _Pause()


def _after(text: str, at: int) -> int:
    """Return the position at which the text between two values ends."""
    found = _BETWEEN.match(text, at)
    assert found is not None, "nothing is between them, at least"
    return found.end()

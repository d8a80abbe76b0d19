"""Texts of others without control characters. Does not import pydantic, because agents use it."""

from __future__ import annotations

import re

_NOT_PLAIN = re.compile(r"[^ -~]")
_BREAK = re.compile("[ ]*[\t-\r\x1c-\x1e\x85\u2028\u2029]\\s*")


def plain(text: object) -> str:
    """Escape control characters: names and messages come from others and must not move a terminal's cursor."""
    return _NOT_PLAIN.sub(_escaped, str(text))


def one_line(text: str, most: int) -> str:
    """Return a text in one line, without control characters and with at most so many characters.

    For reports that quote others, such as the log of a robot's node or the last words of a container. Users read them in
    terminals, also by kubectl, which prints some of them unchanged.
    """
    line = plain(_BREAK.sub(" ", text[: 2 * most]).strip())
    return line if len(line) <= most else f"{line[: most - 1]}…"


def _escaped(found: re.Match[str]) -> str:
    character = found[0]
    return character if character.isprintable() else character.encode("unicode_escape").decode("ascii")

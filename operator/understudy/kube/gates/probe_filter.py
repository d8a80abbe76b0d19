"""A filter of the kernel that discards datagrams before they take a place in a socket's buffer.

It compares what somebody without a key cannot know: the names of the keys that count. So a flood of other datagrams, at whatever rate the
network carries, does not keep those of the agents out. It needs no privilege (Linux, socket(7), SO_ATTACH_FILTER).
"""

from __future__ import annotations

import contextlib
import logging
import socket
from collections.abc import Collection
from dataclasses import dataclass

from understudy.kernel_programs import EQUAL, GO, LOAD_WORD, instruction
from understudy.kernel_programs import attach as attach_program

_logger = logging.getLogger(__name__)

MOST_NAMES = 256
"""Names that a filter compares. If there are more, datagrams of all names pass: the kernel keeps 20 KB for the filters of a socket, and two
while one replaces the other."""

_SO_ATTACH_FILTER = getattr(socket, "SO_ATTACH_FILTER", 26)
_SO_DETACH_FILTER = getattr(socket, "SO_DETACH_FILTER", 27)
_LENGTH, _RETURN = 0x80, 0x06
"""Codes of instructions: load the length, return."""

_UDP = 8
"""Bytes of the header of UDP, with which what a filter sees begins."""


@dataclass(frozen=True)
class Form:
    """Datagrams of one length that begin with four bytes, and continue with one of several names if there are any."""

    length: int
    magic: bytes
    names: Collection[bytes] = ()
    """Only the first four bytes are compared: a guess is right once in four billion times."""


def program(forms: Collection[Form]) -> bytes:
    """Return a program that admits the datagrams of these forms and no others. No two have the same length."""
    whole = [instruction(_LENGTH)]
    for form in forms:
        body = [instruction(LOAD_WORD, _UDP), instruction(EQUAL, _word(form.magic), 1, 0), _DISCARD]
        names = form.names if len(form.names) <= MOST_NAMES else ()
        body += [instruction(LOAD_WORD, _UDP + len(form.magic))] if names else []
        for name in names:
            body += [instruction(EQUAL, _word(name[:4]), 0, 1), _ADMIT]
        body.append(_DISCARD if names else _ADMIT)
        # A comparison jumps over 255 instructions at most.
        whole += [instruction(EQUAL, _UDP + form.length, 1, 0), instruction(GO, len(body)), *body]
    return b"".join([*whole, _DISCARD])


def attach(sock: socket.socket, code: bytes) -> None:
    """Let a socket receive only what a program admits, instead of what an earlier one did."""
    try:
        attach_program(sock, _SO_ATTACH_FILTER, code)
    except OSError as error:  # such as in a sandbox that has no filters
        _logger.info("the kernel does not filter datagrams (%s): a flood may keep others out", error)
        with contextlib.suppress(OSError):  # there is none
            sock.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)


def _word(text: bytes) -> int:
    return int.from_bytes(text, "big")


_ADMIT, _DISCARD = instruction(_RETURN, 0xFFFFFFFF), instruction(_RETURN, 0)

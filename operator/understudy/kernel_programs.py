"""Programs that the kernel runs for a socket, in classic BPF (Linux, socket(7)). They need no privilege."""

from __future__ import annotations

import ctypes
import socket
import struct

LOAD_WORD, EQUAL, GO = 0x20, 0x15, 0x05
"""Codes of instructions: load a word, compare, jump (linux/bpf_common.h)."""

_INSTRUCTION = struct.Struct("=HBBI")


def instruction(code: int, value: int = 0, if_true: int = 0, if_false: int = 0) -> bytes:
    """Return one instruction. ``if_true`` and ``if_false`` are the instructions over which a comparison jumps."""
    return _INSTRUCTION.pack(code, if_true, if_false, value)


def attach(sock: socket.socket, option: int, program: bytes) -> None:
    """Set a socket option whose value is a program. Raises OSError if the kernel has no such option, or refuses the program."""
    buffer = ctypes.create_string_buffer(program, len(program))
    described = struct.pack("@HP", len(program) // _INSTRUCTION.size, ctypes.addressof(buffer))
    sock.setsockopt(socket.SOL_SOCKET, option, described)

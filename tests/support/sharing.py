"""Shares something between several test processes: the first one makes it, and the last one restores the former
state."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def shared(folder: Path, name: str, make: Callable[[], Any], restore: Callable[[Any], None]) -> Iterator[None]:
    """Hold something for the duration of the context, and make it unless another process holds it.

    Args:
        folder: a folder for files that all these processes can access.
        name: the name of the shared thing; part of the files' names.
        make: makes it, and returns as JSON data what is needed to restore the former state. Its exceptions are raised; the
            next process then tries again.
        restore: the last process that held it calls this with that data, even if another process made it. A process that
            is killed holds it no longer.
    """
    memory = folder / f"{name}.json"
    with (folder / f"{name}.holders").open("w") as holders:
        with _turn(folder, name):
            if _alone(holders.fileno()):
                memory.write_text(json.dumps(make()))
            fcntl.flock(holders, fcntl.LOCK_SH)
        try:
            yield
        finally:
            with _turn(folder, name):
                if _alone(holders.fileno()):
                    restore(json.loads(memory.read_text()))


@contextmanager
def _turn(folder: Path, name: str) -> Iterator[None]:
    """Let one process at a time enter or leave."""
    with (folder / f"{name}.turn").open("w") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        yield


def _alone(descriptor: int) -> bool:
    """Return whether no other process holds it. The check also releases the caller's own hold."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True

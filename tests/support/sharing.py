"""What several test processes use at once: the first of them makes it, the last one puts things back."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def shared(folder: Path, name: str, make: Callable[[], Any], restore: Callable[[Any], None]) -> Iterator[None]:
    """Hold something for the time of a block, which is made unless another process holds it.

    Args:
        folder: of files that all these processes see.
        name: of what is shared; part of the files' names.
        make: makes it, and answers with what must be remembered to put things back, as JSON. What it raises is raised; the next
            process then tries.
        restore: is called with that by the last process that held it, which needn't be the one that made it. A process that is
            killed holds it no longer.
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
    """One process at a time comes or goes."""
    with (folder / f"{name}.turn").open("w") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        yield


def _alone(descriptor: int) -> bool:
    """Whether no other process holds it. One that does isn't held any more by the one that asks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True

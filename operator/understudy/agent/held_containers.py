"""The agent's end of held containers: finds which ones wait, and starts them.

For the other end, see api/protocol/hold_script.py.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path

from understudy.api.protocol import hold_script
from understudy.process.file_replacement import replace_file


def make_fifo(path: Path) -> None:
    """Create a FIFO that all users can open, since the containers have users of their own. Raises OSError."""
    umask = os.umask(0)
    try:
        os.mkfifo(path, 0o666)
    except FileExistsError:
        pass
    finally:
        os.umask(umask)


def open_fifo(path: Path) -> int | None:
    """Return a FIFO opened for writing, or None if nobody reads it. Raises OSError."""
    try:
        fifo = os.open(path, os.O_WRONLY | os.O_NONBLOCK)
    except OSError as error:
        if error.errno in (errno.ENXIO, errno.ENOENT):
            return None
        raise
    if not stat.S_ISFIFO(os.fstat(fifo).st_mode):
        os.close(fifo)
        raise OSError(errno.EINVAL, f"{path.name} in the shared volume is no FIFO")
    return fifo


def wake_fifo(path: Path) -> bool:
    """Wake the reader of a FIFO; returns whether there is one. Can be repeated. Raises OSError."""
    fifo = open_fifo(path)
    if fifo is None:
        return False
    # Either the FIFO is full of earlier bytes, which have the same effect, or the reader has just gone.
    with contextlib.suppress(BlockingIOError, BrokenPipeError):
        os.write(fifo, b"\n")
    os.close(fifo)
    return True


class HeldContainers:
    """The held containers of this pod; empty in a pod that is not held."""

    def __init__(self, directory: Path, containers: Sequence[str]) -> None:
        self._directory = directory
        self.containers = tuple(containers)

    def prepare(self) -> None:
        """Create the FIFOs, for images that cannot create them, and before them what such a container runs to preload modules."""
        if self.containers:
            source = Path(__file__).with_name(hold_script.PRELOADED_INTERPRETER)
            replace_file(self._directory / source.name, source.read_text(), mode=0o644)
        for container in self.containers:
            make_fifo(self._directory / hold_script.wake_name(container))

    def missing(self) -> list[str]:
        """Return the containers that do not wait (yet).

        They are still being created, are reading their warm paths, or have ended.
        """
        return [container for container in self.containers if not self._waits(container)]

    def start(self, environment: Mapping[str, Mapping[str, str]]) -> None:
        """Start every container that was not started yet, each with its environment. Raises ValueError and OSError.

        All environments are created before the first is written: if a variable is invalid, nothing starts.
        """
        files = {container: hold_script.env_file(environment.get(container, {})) for container in self.containers}
        for container, text in files.items():
            path = self._directory / hold_script.env_name(container)
            if not path.exists():
                # The containers have users of their own; the volume is in this pod only.
                replace_file(path, text, mode=0o644)
        self.wake()

    def wake(self) -> None:
        """Let waiting containers look for their environment. Can be repeated."""
        for container in self.containers:
            wake_fifo(self._directory / hold_script.wake_name(container))

    def _waits(self, container: str) -> bool:
        """Whether the container's script has the FIFO open, which it has only while it waits."""
        try:
            fifo = open_fifo(self._directory / hold_script.wake_name(container))
        except OSError:
            return False
        if fifo is None:
            return False
        os.close(fifo)
        return True

"""The agent's end of held containers: knows which ones wait, and starts them (see api/protocol/hold_script.py for the other end)."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path

from understudy.api.protocol import hold_script


def write_atomically(path: Path, text: str, mode: int) -> None:
    """Write a file that is there in full or not at all. Raises OSError."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.unlink(missing_ok=True)
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    try:
        with os.fdopen(descriptor, "w") as file:
            os.fchmod(descriptor, mode)  # whatever the umask
            file.write(text)
        temporary.rename(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def make_fifo(path: Path) -> None:
    """Make a FIFO that is open to all, since the containers run as users of their own. Raises OSError."""
    umask = os.umask(0)
    try:
        os.mkfifo(path, 0o666)
    except FileExistsError:
        pass
    finally:
        os.umask(umask)


def open_fifo(path: Path) -> int | None:
    """A FIFO for writing, None when nobody reads it. Raises OSError."""
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
    """Have who reads a FIFO look; whether anybody does. Harmless when repeated. Raises OSError."""
    fifo = open_fifo(path)
    if fifo is None:
        return False
    # Full of earlier ones, which do as well; or who read it has just gone.
    with contextlib.suppress(BlockingIOError, BrokenPipeError):
        os.write(fifo, b"\n")
    os.close(fifo)
    return True


class HeldContainers:
    """The held containers of this pod; none of them in a pod that is not held."""

    def __init__(self, directory: Path, containers: Sequence[str]) -> None:
        self._directory = directory
        self.containers = tuple(containers)

    def prepare(self) -> None:
        """Make the FIFOs for images that cannot."""
        for container in self.containers:
            make_fifo(self._directory / hold_script.wake_name(container))

    def missing(self) -> list[str]:
        """Containers that do not wait (yet): still being created, reading their warm paths, or ended."""
        return [container for container in self.containers if not self._waits(container)]

    def start(self, environment: Mapping[str, Mapping[str, str]]) -> None:
        """Start every container that has not been, each with its environment. Raises ValueError and OSError.

        All environments are made before the first is written: with a bad variable nothing starts.
        """
        files = {container: hold_script.env_file(environment.get(container, {})) for container in self.containers}
        for container, text in files.items():
            path = self._directory / hold_script.env_name(container)
            if not path.exists():
                # Other users must read it; the volume is in this pod only.
                write_atomically(path, text, 0o644)
        self.wake()

    def wake(self) -> None:
        """Have waiting containers look for their environment. Harmless when repeated."""
        for container in self.containers:
            wake_fifo(self._directory / hold_script.wake_name(container))

    def _waits(self, container: str) -> bool:
        """Whether its script has said so and still has the FIFO open."""
        if not (self._directory / hold_script.waiting_name(container)).exists():
            return False
        try:
            fifo = open_fifo(self._directory / hold_script.wake_name(container))
        except OSError:
            return False
        if fifo is None:
            return False
        os.close(fifo)
        return True

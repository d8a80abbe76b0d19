"""Locks between runs of these programs, by name. The kernel releases a lock when its holder ends, for any reason."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager

from testcluster.paths import cache
from testcluster.progress import Progress


@contextmanager
def held(name: str, progress: Progress | None = None) -> Iterator[None]:
    """Hold a lock for the duration of the block. Waits for it without a limit.

    Args:
        name: what is protected; part of a file's name.
        progress: reports that another process holds it.
    """
    folder = cache() / "locks"
    folder.mkdir(exist_ok=True)
    with (folder / name).open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if progress:
                progress(f"waiting for another run (lock {folder / name})")
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield

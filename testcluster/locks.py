"""Locks between runs of these programs, by name. The kernel frees one when its holder ends, however it ends."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager

from testcluster.paths import cache
from testcluster.progress import Progress


@contextmanager
def held(name: str, progress: Progress | None = None) -> Iterator[None]:
    """Holds a lock for the time of a block, after waiting for it as long as need be.

    Args:
        name: what is protected; part of a file's name.
        progress: where to say that somebody else holds it.
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

"""Files and folders that are there whole or not at all, whenever their writer is interrupted.

They are made beside their place under a name with the writer's process id, and renamed when they are complete. What an
interrupted writer left is removed by the next; a program it had started may still be writing there, which does no harm.
"""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_MARK = ".partial."


def is_partial(path: Path) -> bool:
    """Whether a path is one of those that are still being written."""
    return _MARK in path.name


def _remove_stale(destination: Path) -> None:
    for path in destination.parent.glob(f"{destination.name}{_MARK}*"):
        writer = path.name.partition(_MARK)[2].partition(".")[0]
        try:
            os.kill(int(writer), 0)
        except (ProcessLookupError, ValueError):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
        except PermissionError:
            continue


@contextmanager
def folder(destination: Path) -> Iterator[Path]:
    """Gives an empty folder that becomes the destination at the end of the block, unless the block fails."""
    destination.parent.mkdir(parents=True, exist_ok=True)
    _remove_stale(destination)
    partial = Path(tempfile.mkdtemp(prefix=f"{destination.name}{_MARK}{os.getpid()}.", dir=destination.parent))
    try:
        yield partial
        partial.chmod(0o755)
        partial.rename(destination)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


@contextmanager
def file(destination: Path) -> Iterator[Path]:
    """Gives a path for a file that becomes the destination at the end of the block, unless the block fails."""
    destination.parent.mkdir(parents=True, exist_ok=True)
    _remove_stale(destination)
    handle, name = tempfile.mkstemp(prefix=f"{destination.name}{_MARK}{os.getpid()}.", dir=destination.parent)
    os.close(handle)
    partial = Path(name)
    try:
        yield partial
        partial.rename(destination)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def write(destination: Path, content: str | bytes, mode: int = 0o644) -> None:
    """Writes a file, or replaces it."""
    with file(destination) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
        partial.chmod(mode)


def link(destination: Path, target: Path) -> None:
    """Makes a symbolic link, or points it elsewhere."""
    with file(destination) as partial:
        partial.unlink()
        partial.symlink_to(target)

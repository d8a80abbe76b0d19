"""Writes files and folders completely or not at all, even if the writer is interrupted.

A writer makes them beside their place under a name with its process id, and renames them when they are complete. The
next writer removes what an interrupted one left. A program that the interrupted writer had started may still write
there, which does no harm.
"""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_MARK = ".partial."


def is_partial(path: Path) -> bool:
    """Return whether a path is still being written."""
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
    """Provide an empty folder that becomes the destination at the end of the block, unless the block fails."""
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
    """Provide a path for a file that becomes the destination at the end of the block, unless the block fails."""
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
    """Write a file, or replace it."""
    with file(destination) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
        partial.chmod(mode)


def link(destination: Path, target: Path) -> None:
    """Make a symbolic link, or change its target."""
    with file(destination) as partial:
        partial.unlink()
        partial.symlink_to(target)

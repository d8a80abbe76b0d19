"""Replaces a file completely or not at all, so that neither a reader nor the next process finds a part of one."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

NEW = ".new"
"""Ending of a file that is being written. A killed process leaves one."""


@contextlib.contextmanager
def replaced_file(
    path: Path, *, mode: int | None = None, shared: bool = False, synced: bool = False
) -> Iterator[BinaryIO]:
    """Yield an empty file that takes the place of ``path`` when the block ends; if the block raises, ``path`` stays as it was.

    ``mode``: the permissions, whatever the umask is.
    ``shared``: other processes may replace the same file at the same time.
    ``synced``: the file survives a lost node, too.

    Raises OSError.
    """
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}{NEW}" if shared else f"{path.name}{NEW}")
    try:
        temporary.unlink(missing_ok=True)
        with open(temporary, "xb") as file:  # "x" follows no link that another container has put there
            if mode is not None:
                os.fchmod(file.fileno(), mode)
            yield file
            if synced:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    if synced:
        _sync_folder(path.parent)


def replace_file(
    path: Path, content: bytes | str, *, mode: int | None = None, shared: bool = False, synced: bool = False
) -> None:
    """Replace a file by this content, as ``replaced_file`` does. Raises OSError."""
    with replaced_file(path, mode=mode, shared=shared, synced=synced) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def _sync_folder(path: Path) -> None:
    folder = os.open(path, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)

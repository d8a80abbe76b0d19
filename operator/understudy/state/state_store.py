"""Kept state in files that survive a restart of the monitor's container.

One file has everything small, with a checksum over all of it. A large message has a file of its own, which is named by its checksum and
written once. Each file is replaced atomically and the first is written last, so that a process that is killed at any moment leaves a state
that was once kept. Files are not synced: this guards against a killed process. Checksums detect files that a lost node damaged, and these
are left out.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import struct
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from understudy.clock import boot_id
from understudy.process.file_replacement import NEW, replaced_file
from understudy.state.state_capture import Key, Version

_logger = logging.getLogger(__name__)

LARGE = 64 * 1024
"""Minimum size in bytes of a message that has a file of its own."""

ABANDONED = 60.0
"""Seconds after which a file that is not finished is not being written any more."""

_MAGIC = b"USK1"
_HEADER = struct.Struct(">4s32sI")
"""Magic, SHA-256 of all that follows it, length of the JSON part; the messages follow."""


@dataclass(frozen=True)
class StateSource:
    """The instance from which state is kept, and its processes."""

    uid: str
    restarts: int
    """How often its containers had been restarted."""
    processes: frozenset[bytes] = frozenset()
    """What identifies its processes in the GIDs of their writers."""


class StateStore:
    """A directory of kept state."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._blobs: set[str] = set()
        self._boot = boot_id()
        self._made = False
        self._known: tuple[int, ...] = ()
        """What identifies the index that this process loaded or saved last."""
        self.source: StateSource | None = None
        """The instance from which the loaded state is; None if that is not known."""

    @property
    def _index(self) -> Path:
        return self._directory / "kept"

    def save(self, kept: Mapping[Key, Sequence[Version]], source: StateSource | None = None) -> None:
        """Replace the stored state, which is from an instance. Raises OSError."""
        if not self._made:
            self._directory.mkdir(parents=True, exist_ok=True)
        self._made = False  # until everything is written
        parts: list[bytes] = []
        entries: list[list[object]] = []
        needed: set[str] = set()
        for key, versions in kept.items():
            listed: list[tuple[float, float, int, int | str]] = []
            types = [version.type for version in versions]
            before: bytes | None = None
            where: int | str = 0
            for version in versions:
                if version.data is not before:
                    before, where = version.data, self._place(version.data, parts, needed)
                listed.append((version.taken_at, version.good_from, len(version.data), where))
            same = types[0] if len(set(types)) == 1 else types
            entries.append([key.kind, key.name, same, listed])
        clock = {"boot": self._boot, "offset": time.time() - time.clock_gettime(time.CLOCK_BOOTTIME)}
        document: dict[str, object] = {"clock": clock, "entries": entries}
        if source is not None:
            processes = sorted(process.hex() for process in source.processes)
            document["source"] = {"uid": source.uid, "restarts": source.restarts, "processes": processes}
        text = json.dumps(document, separators=(",", ":")).encode()
        body = struct.pack(">I", len(text)) + text + b"".join(parts)
        self._known = _replace(self._index, _MAGIC + hashlib.sha256(body).digest() + body)
        for name in self._blobs - needed:
            (self._directory / name).unlink(missing_ok=True)
        self._blobs, self._made = needed, True

    def _place(self, data: bytes, parts: list[bytes], needed: set[str]) -> int | str:
        """Return where a message is stored: its index among the small ones, or the name of its file."""
        if len(data) < LARGE:
            parts.append(data)
            return len(parts) - 1
        name = f"{hashlib.sha256(data).hexdigest()}.message"
        if name not in self._blobs | needed:
            _replace(self._directory / name, data)
        needed.add(name)
        return name

    def load(self) -> dict[Key, list[Version]]:
        """Return the stored state, with its times adjusted if the clock was set since. Damaged state is left out."""
        self._tidy()
        return self._load()

    def load_foreign(self, uid: str) -> dict[Key, list[Version]]:
        """Return the state of an instance if another process has stored it since this one loaded or saved last; empty otherwise."""
        try:
            if _identity(os.stat(self._index)) == self._known:
                return {}
        except OSError:
            return {}
        found = self._load()
        return found if self.source is not None and self.source.uid == uid else {}

    def _load(self) -> dict[Key, list[Version]]:
        self.source = None
        try:
            # Before it is read: if it is replaced meanwhile, it is read again.
            self._known = _identity(os.stat(self._index))
            raw = self._index.read_bytes()
        except FileNotFoundError:
            return {}
        except OSError as error:
            _logger.error("kept state cannot be read: %s", error)
            return {}
        try:
            return self._read(raw)
        except (ValueError, KeyError, TypeError, IndexError, struct.error) as error:
            _logger.error("kept state in %s is damaged and left out: %s", self._index, error)
            return {}

    def _read(self, raw: bytes) -> dict[Key, list[Version]]:
        magic, digest, length = _HEADER.unpack_from(raw)
        if magic != _MAGIC:
            raise ValueError("it is not of this version")
        if hashlib.sha256(memoryview(raw)[_HEADER.size - 4 :]).digest() != digest:
            raise ValueError("the checksum is wrong")
        document = json.loads(raw[_HEADER.size : _HEADER.size + length])
        step = _clock_step(document["clock"])
        place, parts = _HEADER.size + length, dict[object, bytes | None]()
        found: dict[Key, list[Version]] = {}
        for kind, name, types, versions in document["entries"]:
            for index, (taken_at, good_from, size, where) in enumerate(versions):
                if where not in parts:
                    if isinstance(where, str):
                        parts[where] = self._blob(where)
                    else:
                        parts[where] = raw[place : place + size]
                        place += size
                data, type_ = parts[where], types if isinstance(types, str) else types[index]
                if data is not None:
                    version = Version(taken_at + step, good_from + step, data, type_)
                    found.setdefault(Key(kind, name), []).append(version)
        if (source := document.get("source")) is not None:
            processes = frozenset(bytes.fromhex(process) for process in source["processes"])
            self.source = StateSource(source["uid"], source["restarts"], processes)
        return found

    def _blob(self, name: str) -> bytes | None:
        try:
            data = (self._directory / Path(name).name).read_bytes()
        except OSError as error:
            _logger.error("a kept message cannot be read and is left out: %s", error)
            return None
        if f"{hashlib.sha256(data).hexdigest()}.message" != name:
            _logger.error("a kept message in %s is damaged and left out", name)
            return None
        self._blobs.add(name)
        return data

    def _tidy(self) -> None:
        """Remove files that a killed process began to write. The next save removes messages that nothing refers to."""
        try:
            for path in self._directory.glob(f"*{NEW}"):
                with contextlib.suppress(FileNotFoundError):  # another monitor has just finished it
                    if time.time() - path.stat().st_mtime >= ABANDONED:
                        path.unlink()
            self._blobs = {path.name for path in self._directory.glob("*.message")}
        except OSError as error:
            _logger.warning("%s: %s", self._directory, error)


def _identity(found: os.stat_result) -> tuple[int, ...]:
    return found.st_ino, found.st_mtime_ns, found.st_size


def _replace(path: Path, data: bytes) -> tuple[int, ...]:
    """Replace a file, and return the new one's identity."""
    with replaced_file(path, shared=True) as file:  # two monitors may share the volume for a while
        file.write(data)
        file.flush()
        return _identity(os.fstat(file.fileno()))


def _clock_step(clock: Mapping[str, object]) -> float:
    """Return by how many seconds this node's clock was set since then. 0 if this is another node, or the node was restarted."""
    if not clock["boot"] or clock["boot"] != boot_id():
        return 0.0
    step = time.time() - time.clock_gettime(time.CLOCK_BOOTTIME) - float(str(clock["offset"]))
    return step if abs(step) > 0.05 else 0.0

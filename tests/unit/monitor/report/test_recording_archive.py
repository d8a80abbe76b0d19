"""Recordings on a disk: whole or not there, a few of them, of a bounded size; whatever the disk does."""

from __future__ import annotations

import errno
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import IO

import pytest

from understudy.api.kinds.recording_spec import Recording
from understudy.monitor.report.recording_archive import RecordingArchive, TooBig


def recording(number: int) -> Recording:
    failed = f"2026-11-22T19:{number:02}:00.000000Z"
    return Recording(
        id=f"id{number}", number=number, failed=failed, reason="/cmd_vel is silent", result="Recovered", messages=0, size=0, sha256="",
    )  # fmt: skip


def of(size: int) -> Callable[[IO[bytes]], int]:
    def write(file: IO[bytes]) -> int:
        for _ in range(size // 100):
            file.write(b"x" * 100)
        assert file.tell() == size
        return size // 100

    return write


def keep(
    archive: RecordingArchive, number: int, size: int = 1000, *, most: int = 5, most_bytes: int = 100_000
) -> Recording:
    return archive.keep(recording(number), of(size), most=most, most_bytes=most_bytes)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_recording_is_listed_with_its_size_and_checksum(tmp_path: Path) -> None:
    archive = RecordingArchive(tmp_path / "recordings")
    assert not archive.recordings
    assert not (tmp_path / "recordings").exists(), "nothing is made before something fails"
    kept = keep(archive, 1)
    assert (kept.messages, kept.size, kept.sha256) == (10, 1000, hashlib.sha256(b"x" * 1000).hexdigest())
    assert archive.path(kept).read_bytes() == b"x" * 1000
    assert RecordingArchive(tmp_path / "recordings").recordings == archive.recordings == [kept]


def test_the_oldest_recordings_beyond_the_number_are_deleted(tmp_path: Path) -> None:
    archive = RecordingArchive(tmp_path)
    for number in range(1, 6):
        keep(archive, number, most=3)
    assert [one.number for one in archive.recordings] == [5, 4, 3]
    assert names(tmp_path) == ["id3.json", "id3.mcap", "id4.json", "id4.mcap", "id5.json", "id5.mcap"]
    assert [one.number for one in RecordingArchive(tmp_path).recordings] == [5, 4, 3]


def test_the_oldest_recordings_beyond_the_size_are_deleted(tmp_path: Path) -> None:
    archive = RecordingArchive(tmp_path)
    for number, size in enumerate((4000, 3000, 2000, 5000), 1):
        keep(archive, number, size, most_bytes=9000)
    assert [one.number for one in archive.recordings] == [4, 3]


def test_a_recording_that_is_too_large_removes_no_other(tmp_path: Path) -> None:
    archive = RecordingArchive(tmp_path)
    keep(archive, 1)
    with pytest.raises(TooBig, match=r"it has 9000 bytes, and blackBox.maxSize is 5000"):
        keep(archive, 2, 9000, most_bytes=5000)
    assert [one.number for one in archive.recordings] == [1]
    assert names(tmp_path) == ["id1.json", "id1.mcap"]


def test_a_full_disk_leaves_no_partial_file_and_keeps_the_other_recordings(tmp_path: Path) -> None:
    archive = RecordingArchive(tmp_path)
    keep(archive, 1, most=1)

    def full(file: IO[bytes]) -> int:
        file.write(b"x" * 100)
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left on device"):
        archive.keep(recording(2), full, most=1, most_bytes=100_000)
    assert names(tmp_path) == ["id1.json", "id1.mcap"]
    assert [one.number for one in archive.recordings] == [1]
    keep(archive, 3, most=1)
    assert [one.number for one in archive.recordings] == [3]


def test_a_folder_that_cannot_be_created_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    archive = RecordingArchive(tmp_path / "file" / "recordings")
    assert not archive.recordings
    with pytest.raises(OSError, match="Not a directory"):
        keep(archive, 1)


def test_files_of_a_killed_monitor_are_removed(tmp_path: Path) -> None:
    keep(RecordingArchive(tmp_path), 1)
    (tmp_path / "id2.mcap.new").write_bytes(b"half")
    (tmp_path / "id3.json").write_text(recording(3).model_dump_json())  # it was killed between the two
    (tmp_path / "id4.json").write_text("{")
    (tmp_path / "id4.mcap").write_bytes(b"?")
    assert [one.number for one in RecordingArchive(tmp_path).recordings] == [1]
    assert names(tmp_path) == ["id1.json", "id1.mcap"]


def test_a_recording_stays_in_its_folder_for_any_id(tmp_path: Path) -> None:
    archive = RecordingArchive(tmp_path / "recordings")
    evil = recording(1).model_copy(update={"id": "../../evil"})
    archive.keep(evil, of(100), most=1, most_bytes=1000)
    assert names(tmp_path) == ["recordings"]

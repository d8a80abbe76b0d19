"""Files and folders that are there whole or not at all."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from testcluster import atomic

REPOSITORY = Path(__file__).resolve().parents[3]


def test_a_folder_appears_when_it_is_complete(tmp_path: Path) -> None:
    with atomic.folder(tmp_path / "made") as partial:
        (partial / "file").write_text("content")
        assert not (tmp_path / "made").exists()
    assert (tmp_path / "made" / "file").read_text() == "content"
    assert list(tmp_path.iterdir()) == [tmp_path / "made"]


def test_nothing_remains_after_a_failure(tmp_path: Path) -> None:
    def begin_folder() -> None:
        with atomic.folder(tmp_path / "made") as partial:
            (partial / "file").write_text("content")
            raise RuntimeError

    def begin_file() -> None:
        with atomic.file(tmp_path / "made") as partial:
            partial.write_text("content")
            raise RuntimeError

    for begin in (begin_folder, begin_file):
        with pytest.raises(RuntimeError):
            begin()
    assert list(tmp_path.iterdir()) == []


def test_a_file_keeps_its_content_if_writing_it_again_fails(tmp_path: Path) -> None:
    atomic.write(tmp_path / "file", "former")

    def fail() -> None:
        with atomic.file(tmp_path / "file") as partial:
            partial.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert (tmp_path / "file").read_text() == "former"


def test_the_next_writer_removes_the_files_of_a_killed_one(tmp_path: Path) -> None:
    killed = (
        "import os, sys; from pathlib import Path; from testcluster import atomic\n"
        "with atomic.folder(Path(sys.argv[1])) as partial: (partial / 'file').touch(); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", killed, str(tmp_path / "made")], cwd=REPOSITORY)
    assert [atomic.is_partial(path) for path in tmp_path.iterdir()] == [True]
    with atomic.folder(tmp_path / "made"):
        pass
    assert list(tmp_path.iterdir()) == [tmp_path / "made"]


def test_the_files_of_a_running_writer_are_kept(tmp_path: Path) -> None:
    with atomic.file(tmp_path / "file") as first:
        with atomic.file(tmp_path / "file") as second:
            assert first.exists()
            assert first != second
        assert first.exists()


def test_an_existing_link_can_point_to_another_target(tmp_path: Path) -> None:
    atomic.link(tmp_path / "link", tmp_path / "one")
    atomic.link(tmp_path / "link", tmp_path / "other")
    assert (tmp_path / "link").readlink() == tmp_path / "other"

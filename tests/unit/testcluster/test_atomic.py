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


def test_nothing_stays_of_what_failed(tmp_path: Path) -> None:
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


def test_a_file_that_fails_to_be_written_anew_keeps_its_content(tmp_path: Path) -> None:
    atomic.write(tmp_path / "file", "former")

    def fail() -> None:
        with atomic.file(tmp_path / "file") as partial:
            partial.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert (tmp_path / "file").read_text() == "former"


def test_what_a_killed_writer_left_is_removed_by_the_next(tmp_path: Path) -> None:
    killed = (
        "import os, sys; from pathlib import Path; from testcluster import atomic\n"
        "with atomic.folder(Path(sys.argv[1])) as partial: (partial / 'file').touch(); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", killed, str(tmp_path / "made")], cwd=REPOSITORY)
    assert [atomic.is_partial(path) for path in tmp_path.iterdir()] == [True]
    with atomic.folder(tmp_path / "made"):
        pass
    assert list(tmp_path.iterdir()) == [tmp_path / "made"]


def test_what_a_living_writer_makes_is_left_alone(tmp_path: Path) -> None:
    with atomic.file(tmp_path / "file") as first:
        with atomic.file(tmp_path / "file") as second:
            assert first.exists()
            assert first != second
        assert first.exists()


def test_a_link_is_pointed_elsewhere(tmp_path: Path) -> None:
    atomic.link(tmp_path / "link", tmp_path / "one")
    atomic.link(tmp_path / "link", tmp_path / "other")
    assert (tmp_path / "link").readlink() == tmp_path / "other"

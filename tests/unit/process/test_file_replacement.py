"""Replacing files: whole or not at all, with these permissions, and through no link."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from understudy.process.file_replacement import NEW, replace_file, replaced_file


def test_a_file_is_replaced_with_the_content_and_the_permissions(tmp_path: Path) -> None:
    path = tmp_path / "one"
    path.write_text("a longer text of before")
    umask = os.umask(0o077)
    try:
        replace_file(path, "new", mode=0o644)
    finally:
        os.umask(umask)
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o644
    assert [each.name for each in tmp_path.iterdir()] == ["one"]


def test_a_reader_finds_the_file_of_before_until_the_block_ends(tmp_path: Path) -> None:
    path = tmp_path / "one"
    path.write_bytes(b"before")
    with replaced_file(path, synced=True) as file:
        file.write(b"after")
        file.flush()
        assert path.read_bytes() == b"before"
    assert path.read_bytes() == b"after"


@pytest.mark.parametrize("shared", [False, True])
def test_an_error_leaves_the_file_as_it_was_and_nothing_beside_it(tmp_path: Path, *, shared: bool) -> None:
    path = tmp_path / "one"
    path.write_bytes(b"before")

    def fail() -> None:
        with replaced_file(path, shared=shared) as file:
            file.write(b"after")
            raise ValueError("the block failed")

    with pytest.raises(ValueError, match="the block failed"):
        fail()
    assert path.read_bytes() == b"before"
    assert [each.name for each in tmp_path.iterdir()] == ["one"]


def test_processes_that_share_a_file_do_not_write_into_each_others(tmp_path: Path) -> None:
    path = tmp_path / "one"
    with replaced_file(path, shared=True) as first, replaced_file(path, shared=True) as second:
        first.write(b"first")
        second.write(b"second")
    assert path.read_bytes() == b"first"


def test_what_a_killed_process_left_is_in_nobodys_way(tmp_path: Path) -> None:
    path = tmp_path / "one"
    path.with_name(f"one{NEW}").write_bytes(b"a part")
    replace_file(path, b"whole")
    assert [each.name for each in tmp_path.iterdir()] == ["one"]
    assert path.read_bytes() == b"whole"


def test_nothing_is_written_through_a_link_that_another_container_has_put_there(tmp_path: Path) -> None:
    path, other = tmp_path / "one", tmp_path / "other"
    other.write_bytes(b"untouched")
    path.with_name(f"one{NEW}").symlink_to(other)
    replace_file(path, b"whole", mode=0o600)
    assert other.read_bytes() == b"untouched"
    assert path.read_bytes() == b"whole"
    assert not path.is_symlink()

"""Kept state outlasts the process, whole or not at all."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from understudy import clock
from understudy.state import state_store as module
from understudy.state.state_capture import Key, Version
from understudy.state.state_store import LARGE, StateSource, StateStore

POSE, MAP, NODE = Key("Topic", "/amcl_pose"), Key("Topic", "/map"), Key("Lifecycle", "/amcl")
CHART = os.urandom(LARGE + 5)


def versions() -> dict[Key, list[Version]]:
    now = time.time()
    same = b"same"
    return {
        POSE: [Version(now - i, now - i + 0.5, bytes([i]) * i, "a/msg/B") for i in range(20, 0, -1)],
        MAP: [Version(now - 9, now - 8, CHART, "n/msg/Map"), Version(now - 3, now - 2, os.urandom(LARGE), "n/msg/Map")],
        NODE: [Version(now - 5, now - 5, same), Version(now - 1, now - 1, same)],
    }


def test_saved_state_is_loaded(tmp_path: Path) -> None:
    kept = versions()
    StateStore(tmp_path / "state").save(kept)
    assert StateStore(tmp_path / "state").load() == kept


@pytest.mark.parametrize("source", [None, StateSource("uid-1", 2, frozenset({b"12 bytes long", b"another"}))])
def test_the_instance_from_which_state_is_kept_is_loaded_with_it(tmp_path: Path, source: StateSource | None) -> None:
    StateStore(tmp_path).save(versions(), source)
    later = StateStore(tmp_path)
    assert later.source is None
    assert later.load()
    assert later.source == source


def test_what_another_process_has_stored_of_an_instance_since_is_loaded_once(tmp_path: Path) -> None:
    here, other, kept = StateStore(tmp_path), StateStore(tmp_path), versions()
    other.save(kept, StateSource("uid-1", 0))
    assert here.load() == kept
    assert here.load_foreign("uid-1") == {}, "it is known"
    other.save(kept, StateSource("uid-0", 0))
    assert here.load_foreign("uid-1") == {}, "it is of a former instance"
    other.save(fewer := {POSE: kept[POSE]}, StateSource("uid-1", 3))
    assert here.load_foreign("uid-1") == fewer
    assert here.source == StateSource("uid-1", 3)
    here.save(kept, here.source)
    assert here.load_foreign("uid-1") == {}, "it is this one's own"


def test_an_empty_store_has_no_state(tmp_path: Path) -> None:
    assert StateStore(tmp_path / "none").load() == {}


def test_large_messages_are_written_once_and_deleted_when_no_longer_kept(tmp_path: Path) -> None:
    shelf, kept = StateStore(tmp_path), versions()
    shelf.save(kept)
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.message")}
    assert len(before) == 2
    shelf.save({MAP: kept[MAP][:1], POSE: kept[POSE]})
    after = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.message")}
    assert len(after) == 1
    assert after.items() <= before.items()


def test_a_new_process_uses_the_existing_large_messages(tmp_path: Path) -> None:
    kept = versions()
    StateStore(tmp_path).save(kept)
    stray = tmp_path / f"{'0' * 64}.message"
    stray.write_bytes(b"of an index that was never written")
    later = StateStore(tmp_path)
    assert later.load() == kept
    later.save({MAP: kept[MAP][1:]})
    assert [path.stat().st_size for path in tmp_path.glob("*.message")] == [LARGE]


@pytest.mark.parametrize("place", [0, 10, 40, 200, -1])
def test_a_damaged_file_is_ignored(tmp_path: Path, place: int) -> None:
    StateStore(tmp_path).save(versions())
    raw = bytearray((tmp_path / "kept").read_bytes())
    raw[place] ^= 0xFF
    (tmp_path / "kept").write_bytes(raw)
    assert StateStore(tmp_path).load() == {}


@pytest.mark.parametrize("length", [0, 3, 39, 60, 500])
def test_a_truncated_file_is_ignored(tmp_path: Path, length: int) -> None:
    StateStore(tmp_path).save(versions())
    os.truncate(tmp_path / "kept", length)
    assert StateStore(tmp_path).load() == {}


def test_only_a_damaged_message_is_omitted(tmp_path: Path) -> None:
    kept = versions()
    StateStore(tmp_path).save(kept)
    for path in tmp_path.glob("*.message"):
        if path.stat().st_size == LARGE:
            path.write_bytes(b"torn")
        else:
            assert path.read_bytes() == CHART
    assert StateStore(tmp_path).load() == kept | {MAP: kept[MAP][:1]}


def test_a_process_that_is_killed_while_it_saves_leaves_the_previous_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = versions()
    StateStore(tmp_path).save(kept)
    monkeypatch.setattr(module, "ABANDONED", 0.0)

    def killed(source: Path, target: Path) -> None:
        raise KeyboardInterrupt

    for _ in range(2):
        with monkeypatch.context() as patch:
            patch.setattr(module.os, "replace", killed)
            with pytest.raises(KeyboardInterrupt):
                StateStore(tmp_path).save({POSE: kept[POSE][:1], MAP: [Version(1.0, 1.0, os.urandom(2 * LARGE))]})
        assert StateStore(tmp_path).load() == kept
        assert not list(tmp_path.glob("*.new"))


def test_a_store_does_not_disturb_another_process_that_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept, replace = versions(), os.replace

    def interrupted(source: str, target: str) -> None:
        monkeypatch.setattr(module.os, "replace", replace)
        other = StateStore(tmp_path)
        other.load()
        other.save({POSE: kept[POSE][:1]})
        replace(source, target)

    monkeypatch.setattr(module.os, "replace", interrupted)
    StateStore(tmp_path).save({POSE: kept[POSE]})
    assert StateStore(tmp_path).load() == {POSE: kept[POSE]}


def test_loaded_times_follow_a_clock_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = versions()
    StateStore(tmp_path).save(kept)
    real = time.time
    monkeypatch.setattr(module.time, "time", lambda: real() + 3600)
    found = StateStore(tmp_path).load()
    assert [v.taken_at for v in found[POSE]] == pytest.approx([v.taken_at + 3600 for v in kept[POSE]], abs=1)


def test_on_another_node_loaded_times_are_unchanged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = versions()
    StateStore(tmp_path).save(kept)
    other = tmp_path / "boot"
    other.write_text("another\n")
    monkeypatch.setattr(clock, "_BOOT", other)
    real = time.time
    monkeypatch.setattr(module.time, "time", lambda: real() + 3600)
    assert StateStore(tmp_path).load() == kept

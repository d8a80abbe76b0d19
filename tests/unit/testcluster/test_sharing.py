"""What test processes share is made by the first and put back by the last of them, however they end."""

from __future__ import annotations

import multiprocessing
import os
import signal
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

from tests.support.sharing import shared

_PROCESSES = multiprocessing.get_context("spawn")


def _hold(folder: Path, name: str, end: Connection) -> None:
    """Hold it until told to end, and write down what is made and put back."""

    def note(text: str) -> None:
        with (folder / "notes").open("a") as notes:
            notes.write(f"{text}\n")

    def make() -> Any:
        note(f"{name} makes")
        return {"by": name}

    with shared(folder, "thing", make, lambda before: note(f"{name} puts back what was before {before['by']}")):
        end.send("held")
        end.recv()


class Holder:
    """A process that holds it."""

    def __init__(self, folder: Path, name: str) -> None:
        self._end, other = _PROCESSES.Pipe()
        self.process = _PROCESSES.Process(target=_hold, args=(folder, name, other))
        self.process.start()
        assert self._end.poll(60)
        assert self._end.recv() == "held"

    def release(self) -> None:
        self._end.send("end")
        self.process.join(60)
        assert self.process.exitcode == 0

    def kill(self) -> None:
        assert self.process.pid is not None
        os.kill(self.process.pid, signal.SIGKILL)
        self.process.join(60)


def _notes(folder: Path) -> list[str]:
    return (folder / "notes").read_text().splitlines()


def test_the_first_process_creates_the_resource_and_the_last_one_restores_the_previous_state(tmp_path: Path) -> None:
    first, second = Holder(tmp_path, "first"), Holder(tmp_path, "second")
    first.release()
    assert _notes(tmp_path) == ["first makes"]
    second.release()
    assert _notes(tmp_path) == ["first makes", "second puts back what was before first"]


def test_a_killed_process_no_longer_holds_the_resource(tmp_path: Path) -> None:
    first, second = Holder(tmp_path, "first"), Holder(tmp_path, "second")
    first.kill()
    second.release()
    assert _notes(tmp_path) == ["first makes", "second puts back what was before first"]


def test_a_failed_creation_is_not_undone_and_the_next_process_tries_again(tmp_path: Path) -> None:
    def fail() -> None:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"), shared(tmp_path, "thing", fail, lambda _: pytest.fail("put back")):
        pytest.fail("held")
    Holder(tmp_path, "next").release()
    assert _notes(tmp_path) == ["next makes", "next puts back what was before next"]

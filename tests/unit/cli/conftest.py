from __future__ import annotations

import time
from pathlib import Path

import pytest

from tests.support import fleet
from tests.support.fake_kubectl import FakeKubectl


@pytest.fixture(autouse=True)
def no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines have no width, whatever the process that runs the tests says of a terminal."""
    monkeypatch.delenv("COLUMNS", raising=False)


@pytest.fixture
def stand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeKubectl:
    """kubectl on the PATH, in front of a fleet."""
    made = FakeKubectl(tmp_path)
    made.tell(fleet.fleet())
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    return made


@pytest.fixture
def in_the_present(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock stands still at the fleet's present, in a terminal of a certain width."""
    monkeypatch.setattr(time, "time", lambda: fleet.NOW)
    monkeypatch.setenv("COLUMNS", "110")

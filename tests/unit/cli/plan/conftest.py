from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def _no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is printed goes to no terminal, whatever the process that runs the tests says of one."""
    monkeypatch.delenv("COLUMNS", raising=False)

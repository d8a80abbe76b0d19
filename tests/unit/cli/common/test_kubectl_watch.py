"""Watches of kubectl: they report changes, they end, and they may be forbidden."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

from understudy.cli.common.cluster_access import kubectl_watch
from understudy.cli.common.cluster_access.kubectl_watch import Watch, waiting

LONG = 30.0
"""Seconds that are waited for anything."""


def program(folder: Path, name: str, body: str) -> tuple[Watch, Path]:
    """A watch that counts in a file how often it was begun, and then does what the body says."""
    log = folder / name
    begin = f"import sys, time\nopen({str(log)!r}, 'a').write('begun ')\n"
    return Watch([sys.executable, "-c", begin + body]), log


def silent(folder: Path) -> Watch:
    return program(folder, "silent", "time.sleep(600)")[0]


def test_each_watch_reports_a_change_once(tmp_path: Path) -> None:
    telling, _ = program(tmp_path, "telling", "sys.stdout.write('changed\\n')\nsys.stdout.flush()\ntime.sleep(600)")
    with waiting(silent(tmp_path), telling) as changed:
        assert changed(LONG)
        started_at = time.monotonic()
        assert not changed(0.2), "once for each change"
        assert time.monotonic() - started_at >= 0.2


def test_a_forbidden_watch_reports_nothing_and_restarts_after_a_pause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kubectl_watch, "PAUSE", 600.0)
    refused, log = program(tmp_path, "refused", "sys.exit('Forbidden')")
    with waiting(silent(tmp_path), refused) as changed:
        end = time.monotonic() + LONG
        while refused.output is not None and time.monotonic() < end:
            assert not changed(0.05)
        assert not changed(0.1)
        assert log.read_text() == "begun "
        monkeypatch.setattr(kubectl_watch, "PAUSE", 0.0)
        while log.read_text() == "begun " and time.monotonic() < end:
            assert not changed(0.05)
        assert log.read_text().startswith("begun begun ")


def test_the_end_of_the_first_watch_counts_as_a_change(tmp_path: Path) -> None:
    ending, log = program(tmp_path, "ending", "sys.exit()")
    with waiting(ending, silent(tmp_path)) as changed:
        assert changed(0.5)
        assert changed(0.5)
        assert log.read_text().count("begun") >= 2


def test_the_watches_end_with_the_context(tmp_path: Path) -> None:
    watches = silent(tmp_path), silent(tmp_path)
    with waiting(*watches):
        assert all(one.output is not None for one in watches)
    assert all(one.output is None for one in watches)

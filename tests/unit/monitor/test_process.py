"""How the monitor's process ends."""

from __future__ import annotations

import asyncio
import os
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from understudy.monitor import process
from understudy.monitor.judge.deafness import Deaf
from understudy.process import cpu_scheduling, json_logs

pytestmark = pytest.mark.ros


def test_a_deaf_monitor_ends_with_an_error_code_and_one_line_in_the_log(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    ended = []

    async def watch_workload() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            ended.append("watch")

    async def protect(workload: str, namespace: str, state: Path) -> None:
        async def look() -> None:
            await asyncio.sleep(0)
            raise Deaf("deaf for w-1")

        async with asyncio.TaskGroup() as group:
            group.create_task(look())
            await watch_workload()

    monkeypatch.setattr(process, "_protect", protect)
    # Both change the process of the tests for good.
    monkeypatch.setattr(json_logs, "configure", lambda level: None)
    monkeypatch.setattr(cpu_scheduling, "ask_for_short_slices", lambda: None)
    for name, value in {"WORKLOAD": "w", "NAMESPACE": "fleet", "STATE": str(tmp_path)}.items():
        monkeypatch.setenv(f"UNDERSTUDY_{name}", value)
    assert process.main([]) == os.EX_TEMPFAIL
    assert ended == ["watch"]
    (record,) = (one for one in caplog.records if one.name == process.__name__)
    assert (record.levelname, record.getMessage(), record.exc_info) == ("ERROR", "deaf for w-1", None)


def test_a_monitor_ends_although_a_thread_that_stores_state_does_not(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As on a volume that hangs."""
    goes_on = threading.Event()

    async def protect(workload: str, namespace: str, state: Path) -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(asyncio.to_thread(goes_on.wait, 60))
            await asyncio.sleep(0.05)
            raise Deaf("deaf for w-1")

    monkeypatch.setattr(process, "_protect", protect)
    monkeypatch.setattr(json_logs, "configure", lambda level: None)
    monkeypatch.setattr(cpu_scheduling, "ask_for_short_slices", lambda: None)
    for name, value in {"WORKLOAD": "w", "NAMESPACE": "fleet", "STATE": str(tmp_path)}.items():
        monkeypatch.setenv(f"UNDERSTUDY_{name}", value)
    began = time.monotonic()
    try:
        assert process.main([]) == os.EX_TEMPFAIL
        assert time.monotonic() - began < 50
    finally:
        goes_on.set()

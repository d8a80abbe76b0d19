"""How the monitor's process ends."""

from __future__ import annotations

import asyncio
import os
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

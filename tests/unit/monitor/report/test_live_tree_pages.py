"""The monitor's page, in a real browser: what the monitor says, drawn, and nothing that others said carried out."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.support.golden import assert_golden
from tests.unit.monitor.cluster_objects import ClusterObjects
from tests.unit.monitor.senses import GivenObserver
from tests.unit.trees.world import START, World
from understudy.api.conditions import condition
from understudy.api.kinds.robot_workload import GateStatus
from understudy.monitor.notices import Notices, PublishedStatus
from understudy.monitor.report.live_tree_pages import LiveTreePages
from understudy.process.http_pages import Answer, serve
from understudy.trees.core.snapshots import snapshot

EVIL = "</script><img src=x onerror=\"document.title='carried out'\">"
TREE: dict[str, Any] = {
    "parallel": [
        {"topic": {"name": "/scan", "gap": "1s"}},
        {"name": "driving", "while": {"task_active": {"action": "/go"}}, "do": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}},
        {"value": {"topic": "/battery", "type": "sensor_msgs/msg/BatteryState", "holds": "percentage > 0.2"}},
    ]
}  # fmt: skip


def showing(now: float, **more: Any) -> LiveTreePages:
    world = World(TREE)
    world.hear("/scan", 1.0).hear("/scan", 1.4).battery(1.0, 0.8)
    world.at(1.4)
    world.battery(1.5, 0.1).at(now)
    objects, observer = ClusterObjects(workload="robot-1-drive"), GivenObserver()
    objects.put_workload(failurePolicyRef={"name": "navigation"})
    observer.tree = snapshot(world.tree, world.observed(), START + now)
    observer.troubles = [EVIL]
    enforced = condition("GateEnforced", True, "Enforced", "Two probes of it were seen.")
    published = PublishedStatus(
        health="Failed",
        active="robot-1-drive-abc",
        gate=GateStatus(epoch=3),
        strategy="Executing",
        count=2,
        by_type={enforced.type: enforced},
    )
    return LiveTreePages(objects.view, observer, Notices(replace(published, **more)))


def test_the_state_in_json_is_complete() -> None:
    status, text, kind = showing(2.0).tree()  # type: ignore[misc]
    assert (status, kind) == (200, "application/json")
    found = json.loads(text)
    assert (found["workload"], found["policy"], found["health"], found["epoch"]) == (
        "robot-1-drive", "navigation", "Failed", 3,
    )  # fmt: skip
    assert [node["state"] for node in found["tree"]["children"]] == ["Healthy", "Idle", "Failed"]
    assert found["conditions"] == [
        {"type": "GateEnforced", "status": "True", "reason": "Enforced", "message": "Two probes of it were seen."}
    ]


async def browser_document(pages: dict[str, Callable[[], Answer]], folder: Path, *more: str) -> str:
    """The page's document after some seconds of a browser's time."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("there is no Chromium")
    server = await serve(pages, 0, host="127.0.0.1")
    port = server.sockets[0].getsockname()[1]
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", f"--user-data-dir={folder}"]
    command = [browser, *options, "--virtual-time-budget=4000", *more, "--dump-dom", f"http://127.0.0.1:{port}/"]
    running = await asyncio.create_subprocess_exec(
        *command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env={"HOME": str(folder), "PATH": "/usr/bin:/bin"}
    )
    try:
        async with asyncio.timeout(120):
            document, _ = await running.communicate()
    finally:
        if running.returncode is None:
            running.kill()
            await running.wait()
        server.close()
    return document.decode()


async def test_a_browser_draws_the_tree_with_its_states_and_reasons(tmp_path: Path) -> None:
    shown = showing(2.0)
    looks = 0

    def tree() -> Answer:
        nonlocal looks
        looks += 1
        state = shown.state()
        state["time"] = START + looks / 2
        state["tree"]["children"][0]["received"] = 10 * looks
        return 200, json.dumps(state), "application/json"

    document = await browser_document({"/": shown.page, "/tree": tree}, tmp_path)
    assert looks >= 3, "it looks again and again"
    assert "<title>robot-1-drive: Failed</title>" in document
    text = re.sub(r"<[^>]+>", " ", document.partition("<main>")[2].partition("<script>")[0])
    words = " ".join(text.split())
    for expected in (
        "fleet/robot-1-drive Failed",
        "In control robot-1-drive-abc Epoch 3 Policy navigation If it failed now Executing Recoveries 2",
        "scan topic 20 Hz, 600 ms ago",
        "driving while /go is active no task",
        "percentage &gt; 0.2",
        "GateEnforced True Enforced: Two probes of it were seen.",
    ):
        assert expected in words, words
    assert re.findall(r'data-state="(\w+)"', document) == ["Failed", "Healthy", "Idle", "Idle", "Failed"]
    assert "<img" not in document.partition("<main>")[2], "texts of others are texts"
    assert document.count("<svg") == 3


async def test_the_page_reports_that_the_monitor_does_not_answer(tmp_path: Path) -> None:
    shown = showing(2.0)
    document = await browser_document({"/": shown.page, "/tree": lambda: (503, "no")}, tmp_path)
    assert_golden("monitor", re.findall(r"the monitor can't be reached: [^<]*", document), "can't be reached")

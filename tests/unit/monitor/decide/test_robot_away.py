"""While a robot cannot be reached, an instance that falls silent is not replaced: the next one would receive as little."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest

from tests.unit.monitor.gates import Packets
from tests.unit.monitor.limited_monitor import World
from understudy.failover.decide import Trigger
from understudy.monitor.judge.failure_detection import Failure


def test_a_failure_waits_until_the_mux_at_the_robot_reports_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    world, now = World(monkeypatch, tmp_path), time.time()
    failure = Failure("no /cmd_vel for 500 ms", now - 0.5, now)
    monkeypatch.setattr(Packets, "is_away", True)
    assert world.recovered(failure, now) is None
    assert world.notices.conditions["Recovering"][:2] == ("False", "RobotAway")
    assert world.notices.status.health == "Failed"
    assert world.recovered(replace(failure, trigger=Trigger.POD_LOST), now) is not None
    monkeypatch.setattr(Packets, "is_away", False)
    assert world.recovered(failure, now) is not None

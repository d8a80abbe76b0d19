"""In a storm a monitor goes by what the policy says: a standby that is ready takes over at once, everything else waits, for a while."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from tests.unit.monitor.limited_monitor import ACTIVE, RESTART, World
from understudy.api.conditions import condition
from understudy.failover.interfaces import Instance
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.restart import Restart
from understudy.failover.strategies.uninitialized import UninitializedFallback
from understudy.monitor.judge.failure_detection import Failure

MESSAGE = "4 of 6 workloads fail."
LIMITS = {"budget": None, "stormGuard": {"holdFor": "1m"}}


STANDBY = Instance(name="w-2", uid="uid-2", ip="10.0.0.2", pool="hot", running=True, ready=True)
FALLBACK = {"type": "Fallback", "poolRef": {"name": "hot"}}
SPARE = {"type": "Fallback", "poolRef": {"name": "spare"}}
POOLS = [{"name": "hot", "readiness": "Executing"}, {"name": "spare", "readiness": "Uninitialized"}]


class Storm(World):
    """The policy's condition Storm is true."""

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        folder: Path,
        *strategies: dict[str, Any],
        standby: Instance | None = None,
        **limits: Any,
    ) -> None:
        super().__init__(monkeypatch, folder, *strategies, **{**LIMITS, **limits})
        self.objects.put_settings(pools=POOLS)
        self.objects.put_pods(ACTIVE, *([standby] if standby is not None else []))
        self.say("True")

    def say(self, status: str) -> None:
        self.objects.put_policy(self.policy, conditions=[condition("Storm", status == "True", "ManyFail", MESSAGE)])


def failure(now: float) -> Failure:
    return Failure("no /cmd_vel for 500 ms", now - 0.5, now)


@pytest.mark.parametrize("others", [(), (FALLBACK,), (FALLBACK, SPARE)])
def test_without_a_ready_standby_a_failure_waits_and_is_reported_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, others: tuple[dict[str, Any], ...]
) -> None:
    world, now = Storm(monkeypatch, tmp_path, *others, RESTART), time.time()
    for _ in range(2):
        assert world.recovered(failure(now), now) is None
    status, reason, message = world.notices.conditions["Recovering"]
    assert (status, reason) == ("False", "Storm")
    assert MESSAGE in message
    assert [reason for _, reason, _ in world.notices.events] == ["RecoveryPostponed"]
    assert world.objects.commits == [], "it isn't fenced: maybe it is well, and can't be heard"


def test_a_ready_standby_takes_over_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    world, now = Storm(monkeypatch, tmp_path, SPARE, FALLBACK, standby=STANDBY), time.time()
    assert world.recovered(failure(now), now) is not None
    assert world.loop.decide.options.holds(ExecutingFallback("hot")) is None
    assert MESSAGE in (world.loop.decide.options.holds(UninitializedFallback("spare")) or "")
    assert world.loop.decide.options.holds(Restart()) is not None


def test_an_endless_storm_holds_a_recovery_only_for_hold_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    world, now = Storm(monkeypatch, tmp_path, RESTART), time.time()
    assert world.recovered(failure(now), now + 50) is None
    assert world.recovered(failure(now), now + 61) is not None


def test_after_a_storm_remaining_failures_are_recovered(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    world, now = Storm(monkeypatch, tmp_path, RESTART), time.time()
    assert world.recovered(failure(now), now) is None
    world.say("False")
    assert world.recovered(failure(now), now) is not None


@pytest.mark.parametrize("absent", ["guard", "condition", "policy"])
def test_without_a_guard_a_condition_or_a_policy_nothing_waits(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, absent: str
) -> None:
    world, now = (
        Storm(monkeypatch, tmp_path, RESTART, **({"stormGuard": None} if absent == "guard" else {})),
        time.time(),
    )
    if absent == "condition":
        world.objects.put_policy(world.policy)
    if absent == "policy":
        world.objects.view.policies.items.clear()
    assert world.recovered(failure(now), now) is not None
    assert world.loop.decide.options.holds(Restart()) is None

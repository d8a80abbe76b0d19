"""In a storm a monitor goes by what the policy says: a standby that is ready takes over at once, everything else waits, for a while."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import pytest

from tests.unit.monitor.limited import World
from understudy.api.conditions import condition
from understudy.failover.availability import STANDBY_NOT_READY, Availability
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.restart import Restart
from understudy.failover.strategies.uninitialized import UninitializedFallback
from understudy.monitor.decide import strategy_options
from understudy.monitor.judge.failure_detection import Failure

MESSAGE = "4 of 6 workloads fail."
LIMITS = {"budget": None, "stormGuard": {"holdFor": "1m"}}


class Storm(World):
    """The policy's condition Storm is true."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *available: Any, **limits: Any) -> None:
        super().__init__(monkeypatch, **{**LIMITS, **limits})
        self.spec.failure_policy_ref = SimpleNamespace(name="policy")
        self.view.policies = SimpleNamespace(items={})
        self.say("True")
        monkeypatch.setattr(
            strategy_options, "choices", lambda *_: [SimpleNamespace(strategy=one) for one in available]
        )

    def say(self, status: str) -> None:
        said = condition("Storm", status == "True", "ManyFail", MESSAGE)
        self.view.policies.items["policy"] = {"status": {"conditions": [said.to_wire()]}}


class Ready(ExecutingFallback):
    def availability(self, *_: Any) -> Availability:
        return Availability(True)


class Absent(ExecutingFallback):
    def availability(self, *_: Any) -> Availability:
        return Availability(False, STANDBY_NOT_READY, "pool hot has no standby for this workload")


def failure(now: float) -> Failure:
    return Failure("no /cmd_vel for 500 ms", now - 0.5, now)


@pytest.mark.parametrize("others", [(), (Absent("hot"),), (Absent("hot"), UninitializedFallback("spare"))])
def test_without_a_standby_that_is_ready_a_failure_waits_and_that_is_told_once(
    monkeypatch: pytest.MonkeyPatch, others: tuple[Any, ...]
) -> None:
    world, now = Storm(monkeypatch, *others, Restart()), time.time()
    for _ in range(2):
        assert world.recovered(failure(now), now) is None
    status, reason, message = world.told.conditions["Recovering"]
    assert (status, reason) == ("False", "Storm")
    assert MESSAGE in message
    assert [reason for _, reason, _ in world.told.events] == ["RecoveryPostponed"]
    assert world.gate.committed == [], "it isn't fenced: maybe it is well, and can't be heard"


def test_a_standby_that_is_ready_takes_over_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    world, now = Storm(monkeypatch, UninitializedFallback("spare"), Ready("hot")), time.time()
    assert world.recovered(failure(now), now) is not None
    assert world.watching.decide.options.holds(Ready("hot")) is None
    assert MESSAGE in (world.watching.decide.options.holds(UninitializedFallback("spare")) or "")
    assert world.watching.decide.options.holds(Restart()) is not None


def test_it_waits_no_longer_than_it_is_to_though_nobody_says_that_it_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    world, now = Storm(monkeypatch, Restart()), time.time()
    assert world.recovered(failure(now), now + 50) is None
    assert world.recovered(failure(now), now + 61) is not None


def test_once_it_is_over_what_still_fails_is_recovered(monkeypatch: pytest.MonkeyPatch) -> None:
    world, now = Storm(monkeypatch, Restart()), time.time()
    assert world.recovered(failure(now), now) is None
    world.say("False")
    assert world.recovered(failure(now), now) is not None


@pytest.mark.parametrize("absent", ["guard", "condition", "policy"])
def test_where_nothing_is_said_nothing_waits(monkeypatch: pytest.MonkeyPatch, absent: str) -> None:
    world, now = Storm(monkeypatch, Restart(), **({"stormGuard": None} if absent == "guard" else {})), time.time()
    if absent == "condition":
        world.view.policies.items["policy"] = {}
    if absent == "policy":
        world.view.policies.items.clear()
    assert world.recovered(failure(now), now) is not None
    assert world.watching.decide.options.holds(Restart()) is None

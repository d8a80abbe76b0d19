"""A recovery without success is reported and tried again later, longer each time, but at once if its cause may have been corrected."""

from __future__ import annotations

import time
from typing import Any

import pytest

from tests.support.clock import Clock, set_clock
from tests.support.golden import assert_golden
from tests.support.notices import RecordedNotices
from tests.unit.monitor.cluster_objects import ClusterObjects
from tests.unit.monitor.takeovers import policy, took_over
from understudy.api.kinds.robot_workload import Attempt, Recovery
from understudy.clock import CLOCK
from understudy.failover.limits.backoff import FIRST as BACKOFF_FIRST
from understudy.failover.limits.backoff import MOST as BACKOFF_MOST
from understudy.monitor.act.recovery.recovery_messages import describe, unverified
from understudy.monitor.decide import retry_backoff
from understudy.monitor.decide.retry_backoff import RetryBackoff
from understudy.monitor.judge.failure_detection import Failure

FAILURE = "no /cmd_vel for 500 ms"
NOW = 1_000_000.0


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retry_backoff, "time", Clock(NOW))


class World:
    """The retries of a workload whose policy has two strategies."""

    def __init__(self, **more: Any) -> None:
        self.notices = RecordedNotices()
        self.objects = ClusterObjects(notices=self.notices)
        self.policy = policy(**more)
        self.objects.put_policy(self.policy)
        self.objects.put_workload()
        self.objects.put_settings()
        self.retries = RetryBackoff(self.objects.view, self.notices)
        self.retries.update(None, NOW)

    def correct(self, what: str) -> None:
        """Change one of the objects that a failure may come from."""
        if what == "policy":
            self.objects.put_policy(policy(priority="Safety"))
        elif what == "spec":
            self.objects.put_workload(bringUp={"yaml": {"wait_for": {"node": "/nav"}}})
        else:
            self.objects.put_settings(pools=[{"name": "hot", "readiness": "Executing"}])

    def first(self, onset: float) -> int | None:
        """The strategy with which a recovery begins, or that is put off, as the monitor does it."""
        first = self.retries.first(onset, "uid-1")
        if first is None:
            self.retries.crash_looping(FAILURE)
        else:
            self.retries.begin(Failure(FAILURE, onset, onset), "uid-1")
        return first

    def waits(self) -> float:
        """Seconds for which nothing is begun yet."""
        return self.retries.not_before - NOW

    def in_vain(self, times: int) -> None:
        for _ in range(times):
            self.retries.after_nothing_verified(self.policy)


def test_the_backoff_grows_with_each_failed_recovery_until_one_succeeds() -> None:
    world = World()
    for wait in (BACKOFF_FIRST, 2 * BACKOFF_FIRST, 4 * BACKOFF_FIRST):
        world.in_vain(1)
        assert world.waits() == wait
    world.in_vain(5)
    assert world.waits() == BACKOFF_MOST
    world.retries.healthy()
    world.in_vain(1)
    assert world.waits() == BACKOFF_FIRST


@pytest.mark.parametrize("what", ["policy", "spec", "settings"])
def test_a_correction_ends_the_backoff(what: str) -> None:
    world = World()
    world.in_vain(3)
    world.correct(what)
    world.retries.update(None, NOW + 1)
    assert world.waits() == 1
    world.in_vain(1)
    assert world.waits() == BACKOFF_FIRST


def test_an_unchanged_object_does_not_end_the_backoff() -> None:
    world = World()
    world.in_vain(3)
    before = world.retries.not_before
    world.objects.put_policy(world.policy)  # as after a change of its status
    world.retries.update(None, NOW)
    assert world.retries.not_before == before


def test_a_correction_does_not_end_the_cooldown() -> None:
    world = World()
    world.retries.after(60.0)
    world.correct("policy")
    world.retries.update(None, NOW)
    assert world.waits() == 60


def test_a_resume_ends_the_backoff_once() -> None:
    world, now = World(), NOW
    world.in_vain(3)
    before = world.retries.not_before
    world.retries.update(None, now)
    assert world.retries.not_before == before
    world.retries.update(now, now)
    assert world.retries.not_before == now
    world.retries.after(10.0)
    world.retries.update(now, now)
    assert world.retries.not_before == now + 10, "once"


def test_a_clock_that_is_set_back_does_not_prolong_the_wait() -> None:
    world = World()
    world.retries.after(10.0)
    world.retries.update(None, NOW - 3600)
    assert world.retries.not_before == NOW - 3600 + 10


@pytest.mark.parametrize(("priority", "later"), [("Normal", 4 * BACKOFF_FIRST), ("Safety", BACKOFF_FIRST)])
def test_with_priority_safety_the_backoff_does_not_grow(priority: str, later: float) -> None:
    world = World(priority=priority)
    world.in_vain(3)
    assert world.waits() == later


def test_a_backoff_is_reported_after_the_instance_of_every_strategy_failed_at_once() -> None:
    world, now = World(), NOW
    world.retries.note(took_over(0, now))
    assert world.first(now + 1) == 1
    world.retries.note(took_over(1, now))
    assert world.first(now + 1) is None
    status, reason, message = world.notices.conditions["Recovering"]
    assert (status, reason) == ("False", "CrashLooping")
    assert f"{FAILURE}, as soon as it was active" in message
    assert f"again in {BACKOFF_FIRST:g} s" in message
    assert ("Warning", "CrashLooping") in [(kind, reason) for kind, reason, _ in world.notices.events]
    assert world.waits() == BACKOFF_FIRST
    assert world.first(now + 1) == 0, "and then the first one is tried again"


def test_an_instance_that_fails_within_the_healthy_delay_leads_to_the_next_strategy() -> None:
    world, now = World(limits={"healthyDelay": "1m"}), NOW
    world.retries.note(took_over(0, now))
    assert world.first(now + 30) == 1
    ((kind, reason, message),) = world.notices.events
    assert (kind, reason) == ("Warning", "Relapsed")
    assert_golden("monitor", message, "30.0 s", "limits.healthyDelay", "1m")
    world.retries.note(took_over(0, now))
    assert world.first(now + 60) == 0


@pytest.mark.parametrize("step", [-7200.0, 0.0, 7200.0])
@pytest.mark.parametrize(("drove", "strategy"), [(3600.0, 0), (1.0, 1)])
def test_a_step_of_the_clock_does_not_change_how_long_an_instance_was_active(
    monkeypatch: pytest.MonkeyPatch, drove: float, strategy: int, step: float
) -> None:
    world = World(limits={"healthyDelay": "1m"})
    world.retries.note(took_over(0, CLOCK.now() - drove))
    set_clock(monkeypatch, step)
    assert world.first(time.time()) == strategy
    assert world.notices.reasons == (["Relapsed"] if strategy else [])


def test_a_recovery_reports_its_failed_attempts() -> None:
    hung = "strategies[0].recovery.sequence[0].wait_for: node /nobody is not there within 14 s"
    recovery = Recovery(
        id="1",
        reason="/cmd_vel is silent",
        result="Recovered",
        strategy="Restart",
        from_pod="w-1",
        to_pod="w-3",
        recovery_seconds=16.0,
        attempts=[
            Attempt(strategy="Fallback", result="NotAvailable", message="no pool"),
            Attempt(strategy="Fallback/Initialized", pod="w-2", result="NotVerified", message=hung),
            Attempt(strategy="Restart", pod="w-3", result="Verified"),
        ],
    )
    message = f"Fallback/Initialized with w-2 did not succeed: {hung}"
    assert unverified(recovery) == [message]
    assert describe(recovery).endswith(f"with strategy Restart in 16.000 s (gate epoch 0). Before that: {message}")

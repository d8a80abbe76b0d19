"""Repairs are made at once while they are few, and are made again once they have become rare."""

from __future__ import annotations

from understudy.controller.reconcile.contention import AT_ONCE, EVERY, RepairCounts

PLACE = ("deployments", "fleet", "w-monitor")


class Clock:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


def contended(clock: Clock) -> RepairCounts:
    made = RepairCounts(clock=clock)
    for _ in range(1 + AT_ONCE):
        assert not made.wait(PLACE, "a")
        made.written(PLACE, "a")
    return made


def test_one_repair_is_made_after_each_waiting_time() -> None:
    clock = Clock()
    made = contended(clock)
    assert made.wait(PLACE, "a")
    clock.now += EVERY
    assert not made.wait(PLACE, "a")
    made.written(PLACE, "a")
    assert made.wait(PLACE, "a")


def test_a_change_of_the_desired_state_does_not_wait() -> None:
    made = contended(Clock())
    assert not made.wait(PLACE, "b")
    made.written(PLACE, "b")
    assert not made.wait(PLACE, "b")


def test_rare_repairs_never_wait() -> None:
    clock = Clock()
    made = contended(clock)
    for _ in range(10):
        clock.now += 2 * AT_ONCE * EVERY
        assert not made.wait(PLACE, "a")
        made.written(PLACE, "a")

"""What a monitor sees of the workloads that its own depends on, and how long it holds a failure of its own because of them."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.support.golden import assert_golden
from tests.support.notices import RecordedNotices
from tests.unit.monitor.cluster_objects import settings_of
from tests.unit.monitor.gates import gate
from tests.unit.monitor.pool_views import view
from tests.unit.monitor.upstream import NOW, Upstream, active, recovery
from understudy.failover.progress import rfc3339
from understudy.kube.events import Recorder
from understudy.monitor.notices import Notices, PublishedStatus
from understudy.monitor.report.status_writer import QUIET, StatusWriter


async def test_a_failure_is_held_for_a_moment_and_recovered_if_no_dependency_has_failed() -> None:
    world = Upstream()
    await world.report_health("Healthy")
    world.dependencies.notice(NOW - 0.5, NOW)
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW) == pytest.approx(NOW + 0.3)
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW + 0.31) is None
    assert world.notices.status.find("DependencyFailed") is None, "nothing is said of a look"


async def test_a_failure_is_held_as_soon_as_the_gate_of_the_dependency_shows_its_failure() -> None:
    world = Upstream()
    await world.report_health("Healthy")
    world.dependencies.notice(NOW - 0.5, NOW)
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW) is not None
    world.objects.wakeups.evaluation.clear()
    await world.committed(recovery("r1", onset=NOW - 0.52, result="Running"), NOW + 0.05)
    assert world.objects.wakeups.evaluation.is_set(), "and it is looked at once"
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW + 0.05) == pytest.approx(NOW + 120)
    status, reason, message = world.condition()
    assert (status, reason) == ("True", "Held")
    assert_golden("monitor", message, "/plan", "500 ms", "localization", "Recovering", "14:04:11")
    assert [event[1] for event in world.notices.events] == ["DependencyFailed"]


async def test_after_the_settling_time_the_failure_is_acted_on() -> None:
    world = Upstream({"name": "localization"})
    await world.report_health("Healthy")
    world.dependencies.notice(NOW - 0.5, NOW)
    await world.committed(recovery("r1", onset=NOW - 0.52, result="Running"), NOW + 0.05)
    world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW + 0.05)
    await world.report_health("Healthy", recovery("r1", onset=NOW - 0.52, verified=NOW + 4), now=NOW + 5)
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW + 5) == pytest.approx(NOW + 14)
    assert world.condition()[:2] == ("True", "Settling")
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW + 14.1) is None
    assert world.condition()[:2] == ("False", "OwnFailure")
    assert len(world.notices.events) == 1, "it is told once"


async def test_the_message_of_a_held_failure_does_not_change_with_its_figures() -> None:
    world = Upstream()
    await world.report_health("Failed", failing_since=rfc3339(NOW - 1))
    world.dependencies.notice(NOW - 0.5, NOW)
    for rate in ("3.9", "3.7"):
        world.dependencies.hold(f"/plan at {rate} Hz, below 5 Hz over 2 s", NOW - 0.5, NOW + 1)
        assert world.condition()[2].startswith("/plan at 3.9 Hz, below 5 Hz")


async def test_a_failure_that_ends_is_no_longer_held() -> None:
    world = Upstream()
    await world.report_health("Failed", failing_since=rfc3339(NOW - 1))
    world.dependencies.notice(NOW - 0.5, NOW)
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW) is not None
    world.dependencies.well("planning-1")
    assert world.condition()[:2] == ("False", "HealthyAgain")


async def test_a_failure_that_precedes_that_of_the_dependency_is_not_held() -> None:
    world = Upstream()
    await world.report_health("Failed", failing_since=rfc3339(NOW - 1))
    world.dependencies.notice(NOW - 2, NOW - 1.5)
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 2, NOW) is None


async def test_a_failure_is_written_to_the_status_at_once_for_dependent_workloads() -> None:
    world = Upstream()
    flushed = asyncio.Event()

    class Writer(StatusWriter):
        async def flush(self) -> None:
            flushed.set()

    recorder = Recorder(world.objects.client, "understudy-monitor", "monitor")
    writer = Writer(world.objects.client, world.objects.view, recorder, world.notices)
    world.dependencies.notice(NOW - 0.5, NOW)
    world.notices.set(health="Failed")
    assert world.notices.status.failing_since == NOW - 0.5
    writing = asyncio.create_task(writer.run())
    async with asyncio.timeout(QUIET / 2):
        await flushed.wait()
    writing.cancel()


async def test_without_dependencies_nothing_is_watched_reported_or_held() -> None:
    world = Upstream()
    await world.report_health("Failed", failing_since=rfc3339(NOW - 1))
    world.dependencies.follow(settings_of("planning"))
    world.dependencies.update(NOW)
    world.dependencies.notice(NOW, NOW)
    assert world.dependencies.hold("no /plan for 500 ms", NOW, NOW) is None
    assert world.dependencies.due(active(), NOW) is None
    assert world.notices.status.followed == ()
    assert world.notices.status.failing_since is None


def test_the_start_of_a_failure_stays_in_the_status_until_it_ends() -> None:
    notices = RecordedNotices()
    notices.set(health="Failed", failing_since=NOW)
    notices.set(health="Recovering", failing_since=NOW + 5)
    status = notices.status.to_wire()
    assert status["failingSince"] == rfc3339(NOW)
    following_it = Notices(PublishedStatus.adopt({"status": status}))
    assert following_it.status.failing_since == NOW
    for each in (notices, following_it):
        each.set(health="Healthy")
        assert "failingSince" not in each.status.to_wire()


class TestUpstreamMonitor:
    """What one writes is what the other reads: without that nobody would be held, and nothing be done."""

    async def test_the_first_commit_of_a_recovery_shows_the_failure_to_dependents(self, tmp_path: Path) -> None:
        world = Upstream()
        client = world.objects.client
        switch = await gate(client, view(client, "localization"), tmp_path)
        await world.report_health("Healthy")
        world.dependencies.notice(NOW - 0.5, NOW)
        await switch.commit(None, recovery("r1", onset=NOW - 0.52, result="Running"))
        await world.take_in(NOW + 0.05)
        world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW + 0.05)
        assert world.condition()[:2] == ("True", "Held")

    async def test_the_record_of_a_recovery_leads_to_a_reaction_of_dependents(self) -> None:
        first, world = RecordedNotices(), Upstream(adopted="")
        first.set(health="Recovering", failing_since=NOW - 5)
        await world.write_status(first)
        assert world.dependencies.hold("no /plan for 500 ms", NOW - 4, NOW) is not None
        assert world.dependencies.due(active(), NOW) is None, "not before it is over"
        first.record(recovery("r1", onset=NOW - 5, verified=NOW - 1))
        first.set(health="Healthy")
        await world.write_status(first)
        found = world.dependencies.due(active(), NOW)
        assert found is not None
        assert (found.follows[0].recovery, found.since) == ("r1", pytest.approx(NOW - 1))

    async def test_a_held_failure_holds_those_of_dependents_too(self) -> None:
        """Of a chain the middle one commits nothing: its status has to tell."""
        middle, last = Upstream(), Upstream()
        await middle.report_health("Failed", failing_since=rfc3339(NOW - 1))
        middle.notices.set(health="Failed")
        middle.dependencies.notice(NOW - 0.7, NOW)
        await last.write_status(middle.notices)
        last.dependencies.notice(NOW - 0.4, NOW + 0.1)
        last.dependencies.hold("no /cmd_vel for 500 ms", NOW - 0.4, NOW + 0.1)
        assert last.condition()[:2] == ("True", "Held")

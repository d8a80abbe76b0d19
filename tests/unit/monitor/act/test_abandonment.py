"""The record beside the gate of an abandoned recovery is marked, whatever the API server does meanwhile; nothing newer is touched."""

from __future__ import annotations

import asyncio
import errno
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.unit.kube.memory import MemoryClient
from tests.unit.monitor.abandoned_recoveries import (
    AWAY,
    DENIED,
    STANDBY,
    THIRD,
    Monitor,
    monitor_of,
    started_recovery,
    written,
)
from understudy.api import names
from understudy.failover.abandoned import AbandonedRecovery
from understudy.failover.interfaces import Instance, Superseded
from understudy.failover.journal import Journal
from understudy.failover.pool_queue import Waiter
from understudy.failover.progress import beside
from understudy.kube.client import ApiError, Object
from understudy.kube.gates.base import GateRecord
from understudy.kube.gates.kinds.network_policy import GATE


@pytest.fixture
def monitor(tmp_path: Path) -> Monitor:
    return monitor_of(MemoryClient(), tmp_path)


@pytest.mark.parametrize("last", [None, STANDBY])
async def test_a_recovery_stopped_by_an_error_after_its_commit_is_marked_as_abandoned(
    monitor: Monitor, last: Instance | None
) -> None:
    progress = await monitor.recover(None, last, DENIED)
    assert monitor.ended == ["Stopped"]
    assert monitor.upstream_state().failing, "as long as nobody has said otherwise"
    epoch, selector = GateRecord.of(monitor.policy).epoch, monitor.policy["spec"]
    await monitor.look()
    assert not monitor.upstream_state().failing
    record = GateRecord.of(monitor.policy)
    found = beside(record.recovery)
    assert found is not None
    assert (found.id, found.result, found.failed) == (progress.id, "Failed", progress.failed)
    assert (record.epoch, record.active, monitor.policy["spec"]) == (epoch, last.name if last else "", selector)


async def test_a_recovery_stopped_by_a_refused_commit_is_marked_as_abandoned(monitor: Monitor) -> None:
    progress = started_recovery()
    await monitor.gate.commit(None, progress)
    monitor.fail("PATCH", DENIED)
    await monitor.recover(STANDBY, progress=progress)
    assert monitor.ended == ["Stopped"]
    monitor.fail("PATCH", None)
    await monitor.look()
    assert not monitor.upstream_state().failing


async def test_a_recovery_stopped_before_its_commit_needs_no_request(monitor: Monitor) -> None:
    await monitor.recover(DENIED)
    before = len(monitor.client.requests)
    await monitor.look()
    assert (len(monitor.client.requests), monitor.journal.given_up()) == (before, [])


async def test_an_abandoned_recovery_leaves_the_queue_of_its_pool(monitor: Monitor) -> None:
    progress = started_recovery()
    progress.waiting = Waiter(workload="w", pool="spare", priority=0, since=2.0, until=1e11)
    await monitor.recover(None, DENIED, progress=progress)
    assert monitor.policy["metadata"]["labels"][names.WAITS_FOR] == "spare"
    await monitor.look()
    found = beside(GateRecord.of(monitor.policy).recovery)
    assert found is not None
    assert found.waiting is None
    assert names.WAITS_FOR not in monitor.policy["metadata"]["labels"]


@pytest.mark.parametrize("error", [DENIED, AWAY, ApiError(503, "Busy", "try again"), TimeoutError()])
async def test_the_mark_is_retried_until_the_api_server_accepts_it_once(monitor: Monitor, error: Exception) -> None:
    await monitor.recover(None, DENIED)
    monitor.fail("PATCH", error)
    for _ in range(3):
        await monitor.look()
    assert monitor.upstream_state().failing
    monitor.fail("PATCH", None)
    await monitor.look()
    assert not monitor.upstream_state().failing
    done = written(monitor.client)
    for _ in range(3):
        await monitor.look()
    assert written(monitor.client) == done
    assert monitor.journal.given_up() == []


async def test_a_slow_mark_delays_nothing_and_is_requested_once_at_a_time(
    monitor: Monitor, monkeypatch: pytest.MonkeyPatch
) -> None:
    await monitor.recover(None, DENIED)
    asked, answered, real = 0, asyncio.Event(), GATE.write

    async def slow(client: Any, namespace: str, workload: str, patch: Object) -> Object:
        nonlocal asked
        if names.EPOCH not in patch["metadata"]["annotations"]:  # not a commit
            asked += 1
            await answered.wait()
        return await real(client, namespace, workload, patch)

    monkeypatch.setattr(GATE, "write", slow)
    for _ in range(3):
        monitor.abandonment.update()
        await asyncio.sleep(0)
    assert asked == 1
    next_one = started_recovery(STANDBY)
    async with asyncio.timeout(1):
        await monitor.gate.commit(THIRD, next_one)  # while it is under way
    answered.set()
    await monitor.look()
    found = beside(GateRecord.of(monitor.policy).recovery)
    assert found is not None
    assert (found.id, found.result, monitor.gate.state.active) == (next_one.id, "Running", THIRD.name)


async def test_a_commit_right_after_the_mark_is_not_blocked_by_it(monitor: Monitor) -> None:
    await monitor.recover(None, DENIED)
    before = dict(monitor.view.gates.items)
    await monitor.look()
    monitor.view.gates.items = before  # its answer has not come yet, nor has the watch told
    next_one = started_recovery()
    await monitor.gate.commit(STANDBY, next_one)
    found = beside(GateRecord.of(monitor.policy).recovery)
    assert found is not None
    assert (found.id, found.result, GateRecord.of(monitor.policy).epoch) == (next_one.id, "Running", 6)


@pytest.mark.parametrize("noticed", [True, False])
async def test_the_record_of_a_newer_recovery_is_not_overwritten(
    monitor: Monitor, tmp_path: Path, noticed: bool
) -> None:
    await monitor.recover(None, DENIED)
    other, newer = monitor.successor(tmp_path / "elsewhere"), started_recovery()
    await other.gate.commit(STANDBY, newer)
    if noticed:
        monitor.watch()
    await monitor.look()
    found = beside(GateRecord.of(monitor.policy).recovery)
    assert found is not None
    assert (found.id, found.result) == (newer.id, "Running")
    monitor.watch()
    await monitor.look()
    assert (monitor.abandonment.ids, monitor.journal.given_up()) == (set(), []), (
        "the gate can't come to tell of it any more"
    )


async def test_a_recovery_that_another_monitor_resumed_is_not_marked(monitor: Monitor, tmp_path: Path) -> None:
    progress = await monitor.recover(None, DENIED)
    other = monitor.successor(tmp_path / "elsewhere")
    taken_up = other.interrupted()
    assert taken_up is not None
    assert taken_up.id == progress.id, "it has another volume, and can't know"
    await other.gate.commit(STANDBY, taken_up)
    monitor.watch()
    await monitor.look()
    found = beside(GateRecord.of(monitor.policy).recovery)
    assert found is not None
    assert (found.resumed, found.result) == (True, "Running")


async def test_a_restarted_monitor_does_not_continue_an_abandoned_recovery_and_marks_it(
    monitor: Monitor, tmp_path: Path
) -> None:
    await monitor.recover(None, STANDBY, DENIED)
    monitor.fail("PATCH", AWAY)
    await monitor.look()
    monitor.fail("PATCH", None)
    later = monitor.successor(tmp_path)
    assert later.interrupted() is None, "whoever failed may be well again since"
    await later.look()
    assert not later.upstream_state().failing
    assert later.successor(tmp_path).interrupted() is None
    assert later.successor(tmp_path / "elsewhere").interrupted() is None, "the gate says it to everybody"


async def test_a_resumed_recovery_that_stops_before_its_commit_is_abandoned_too(
    monitor: Monitor, tmp_path: Path
) -> None:
    progress = started_recovery()
    await monitor.gate.commit(None, progress)
    later = monitor.successor(tmp_path)
    taken_up = later.interrupted()
    assert taken_up is not None
    await later.recover(DENIED, progress=taken_up)
    await later.look()
    assert not later.upstream_state().failing


@pytest.fixture
def late(monkeypatch: pytest.MonkeyPatch) -> list[Callable[[], Any]]:
    """Commits that the API server has not carried out yet, although their sender has an answer."""
    real = GATE.write
    late: list[Callable[[], Any]] = []

    async def unanswered(client: Any, namespace: str, workload: str, patch: Object) -> Object:
        if names.EPOCH not in patch["metadata"]["annotations"]:  # not a commit
            return await real(client, namespace, workload, patch)
        late.append(lambda: real(client, namespace, workload, patch))
        raise DENIED  # by somebody in between, such as a proxy

    monkeypatch.setattr(GATE, "write", unanswered)
    return late


async def test_a_late_commit_of_an_abandoned_recovery_is_refused(
    monitor: Monitor, late: list[Callable[[], Any]]
) -> None:
    await monitor.recover(None)
    await monitor.look()
    with pytest.raises(ApiError, match="409"):
        await late[0]()
    before = written(monitor.client)
    await monitor.look()
    assert (written(monitor.client), monitor.journal.given_up()) == (before, []), "one write is enough"


async def test_a_commit_that_takes_effect_before_it_is_overtaken_is_marked(
    monitor: Monitor, late: list[Callable[[], Any]]
) -> None:
    await monitor.recover(None)
    assert not monitor.upstream_state().failing
    await late[0]()
    monitor.watch()
    assert monitor.upstream_state().failing
    await monitor.look()
    assert not monitor.upstream_state().failing


async def test_an_unmarked_abandoned_recovery_is_remembered_with_later_ones(monitor: Monitor, tmp_path: Path) -> None:
    first = await monitor.recover(STANDBY, DENIED)
    monitor.fail("PATCH", DENIED)
    for _ in range(5):
        await monitor.recover(None, progress=started_recovery(STANDBY))
        await monitor.look()
    assert monitor.ended == ["Stopped"] * 6
    assert first.id in monitor.abandonment.ids
    assert len(monitor.journal.given_up()) == 2, "however often it is tried"
    monitor.fail("PATCH", None)
    later = monitor.successor(tmp_path)
    await later.look()
    assert not later.upstream_state().failing


async def test_the_mark_does_not_open_a_gate_that_somebody_fenced(monitor: Monitor) -> None:
    progress = started_recovery()
    await monitor.gate.commit(STANDBY, progress)
    over = GateRecord.of(monitor.policy)
    await GATE.write(monitor.client, "fleet", "w", GATE.commitment("w", over=over, recovery=over.recovery))
    monitor.watch()
    await monitor.recover(DENIED, progress=progress)
    await monitor.look()
    record = GateRecord.of(monitor.policy)
    assert (record.epoch, record.active, GATE.let_through(monitor.policy)) == (6, "", ())
    assert not monitor.upstream_state().failing


async def test_a_full_volume_does_not_prevent_the_mark(monitor: Monitor, monkeypatch: pytest.MonkeyPatch) -> None:
    await monitor.gate.commit(None, progress := started_recovery())

    def full(given_up: Sequence[AbandonedRecovery]) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(monitor.journal, "give_up", full)
    monitor.abandonment.abandon(progress)
    await monitor.look()
    assert not monitor.upstream_state().failing


def test_abandoned_recoveries_survive_a_restart_and_a_damaged_file_is_ignored(tmp_path: Path) -> None:
    journal, kept = Journal(tmp_path / "recovery.json"), [AbandonedRecovery(id="r1", epoch=4, sent="{}")]
    assert journal.given_up() == []
    journal.give_up(kept)
    journal.save(started_recovery())
    journal.clear()
    assert Journal(tmp_path / "recovery.json").given_up() == kept
    (tmp_path / "recovery.given-up").write_text("[{")
    assert journal.given_up() == []
    journal.give_up([])
    assert list(tmp_path.iterdir()) == []


async def test_a_superseded_recovery_does_not_change_the_commit_of_the_other_monitor(
    monitor: Monitor, tmp_path: Path
) -> None:
    other = monitor.successor(tmp_path / "elsewhere")
    mine, theirs = started_recovery(), started_recovery()
    await monitor.gate.commit(None, mine)
    other.watch()
    await other.gate.commit(STANDBY, theirs.model_copy(update={"result": "Failed"}))
    with pytest.raises(Superseded):
        await monitor.gate.commit(THIRD, mine)
    monitor.abandonment.abandon(mine)
    await monitor.look()
    assert GateRecord.of(monitor.policy).active == STANDBY.name
    assert monitor.abandonment.ids == set()

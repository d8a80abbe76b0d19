"""The record beside the gate of an abandoned recovery is marked, whatever the API server does meanwhile; nothing newer is touched."""

from __future__ import annotations

import asyncio
import errno
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import aiohttp
import pytest

from tests.unit.interleavings.blanks import Keeping
from tests.unit.kube.memory import MemoryClient
from tests.unit.monitor.gates import gate as open_gate
from understudy.api import names
from understudy.api.kinds.robot_workload import Recovery, RobotWorkloadStatus
from understudy.failover.abandoned import GivenUp
from understudy.failover.availability import Availability
from understudy.failover.dependency import Seen
from understudy.failover.interfaces import Instance, Superseded
from understudy.failover.journal import Journal
from understudy.failover.pool_queue import Waiter
from understudy.failover.progress import LASTS, PodIdentity, Progress, beside
from understudy.failover.strategies.base import Choice, Means, Strategy
from understudy.kube.client import NETWORK_POLICIES, ApiError, Object
from understudy.kube.gates.base import GateRecord
from understudy.kube.gates.kinds.network_policy import GATE
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.act.recovery import abandonment
from understudy.monitor.act.recovery.abandonment import Abandonment
from understudy.monitor.act.recovery.recovery_journal import RecoveryJournal
from understudy.monitor.act.recovery.recovery_runner import RecoveryRunner
from understudy.monitor.notices import Notices
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.objects import interrupted_recovery
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups

FAILED = Instance(name="w-1", uid="u1")
STANDBY = Instance(name="w-2", uid="u2")
THIRD = Instance(name="w-3", uid="u3")
DENIED = ApiError(403, "Forbidden", "no role allows it")
AWAY = aiohttp.ClientConnectionError("refused")

Steps = Sequence[Instance | Exception | None]


class Does(Strategy):
    """Commits, for these instances or for none, and fails by what comes among them."""

    name = "Restart"

    def __init__(self, steps: Steps) -> None:
        self._steps = steps

    def availability(self, means: Means, progress: Progress | None = None) -> Availability:
        return Availability(True)

    async def prepare(self, progress: Progress, means: Means, *, within: float) -> Instance:
        for step in self._steps:
            if isinstance(step, Exception):
                raise step
            await means.gate.commit(step, progress)
        raise AssertionError("it ends by an error")


class Monitor:
    """What one monitor has for its recoveries: a client, a view and a gate of its own, and a folder that outlasts it."""

    def __init__(self, client: MemoryClient, view: ClusterView, gate: GateControl, folder: Path) -> None:
        self.client, self.view, self.gate = client, view, gate
        self.journal = Journal(folder / "recovery.json")
        self.recoveries: list[Recovery] = []
        self.notices = Notices()
        crash_points: Any = SimpleNamespace(step=lambda _: None)
        self.abandonment = Abandonment(gate, RecoveryJournal(self.journal, crash_points), self.notices)
        self.ended: list[str] = []

    async def recover(self, *steps: Instance | Exception | None, progress: Progress | None = None) -> Progress:
        """Carry a recovery out, which an error ends."""
        recovery = progress or begun()
        options: Any = SimpleNamespace(choices=lambda: [Choice(Does(steps), 5.0)], means=self._means)
        view: Any = SimpleNamespace(spec=None)
        keeping: Any = Keeping()
        policy: Any = None
        recoveries = RecoveryRunner(view, options, keeping, CurrentRecovery(), self.abandonment, self.notices)
        self.ended.append((await recoveries.carry_out(recovery, policy)).kind)
        return recovery

    def _means(self) -> Means:
        no: Any = None
        fleet: Any = SimpleNamespace(of_workload=lambda: ())
        return Means(
            gate=self.gate,
            instances=fleet,
            agents=no,
            outputs=no,
            queue=no,
            clock=lambda: 2.0,
            save=self.journal.save,
            workload_uid="uid-w",
        )

    async def look(self) -> None:
        """As in the housekeeping, and wait for what that has begun."""
        self.abandonment.look()
        if self.abandonment._status_conditions is not None:
            await self.abandonment._status_conditions

    def interrupted(self) -> Progress | None:
        """What a monitor that starts now would go on with."""
        return interrupted_recovery.interrupted(self.journal, self.gate, self.notices.status, self.abandonment.ids)

    def seen(self) -> Seen:
        """What those that depend on it make of its gate and of its status, once that says that it is well."""
        recovery = beside(GateRecord.of(self.policy).recovery)
        return Seen.of(RobotWorkloadStatus(health="Healthy", recoveries=self.recoveries), recovery)

    @property
    def policy(self) -> Object:
        """The gate as the API server has it."""
        return self.client.items[(NETWORK_POLICIES.plural, "fleet", "w-gate")]

    def fail(self, method: str, error: Exception | None) -> None:
        """Have every such request fail, or none any more."""
        self.client.failing = lambda asked, name: error if asked == method else None


def begun(failed: Instance = FAILED) -> Progress:
    pod = PodIdentity(name=failed.name, uid=failed.uid)
    return Progress.begin("it ended", last_healthy=1.0, detected=2.0, failed=[pod])


@pytest.fixture
def client() -> MemoryClient:
    return MemoryClient()


@pytest.fixture
async def monitor(client: MemoryClient, tmp_path: Path) -> Monitor:
    view = ClusterView(client, "fleet", "w", Wakeups())
    return Monitor(client, view, await open_gate(client, view, tmp_path, FAILED), tmp_path)


async def successor(before: Monitor, folder: Path) -> Monitor:
    """The next monitor of the same workload, which knows what the API server says and what is in a folder."""
    view = ClusterView(before.client, "fleet", "w", Wakeups())
    view.gates.put(await before.client.get(NETWORK_POLICIES, "fleet", "w-gate"))
    fleet: Any = before.gate._fleet
    nobody: Any = None
    return Monitor(
        before.client,
        view,
        GateControl(before.client, view, fleet, nobody, before.gate._crash_points, Notices()),
        folder,
    )


def put(monitor: Monitor) -> None:
    """The watch brings the gate as it is."""
    monitor.view.gates.put(monitor.policy)


def written(client: MemoryClient) -> int:
    return sum(method == "PATCH" for method, _, _ in client.requests)


@pytest.mark.parametrize("last", [None, STANDBY])
async def test_one_that_an_error_stops_after_its_commit_is_under_way_for_nobody_any_more(
    monitor: Monitor, last: Instance | None
) -> None:
    progress = await monitor.recover(None, last, DENIED)
    assert monitor.ended == ["Stopped"]
    assert monitor.seen().failing, "as long as nobody has said otherwise"
    epoch, selector = GateRecord.of(monitor.policy).epoch, monitor.policy["spec"]
    await monitor.look()
    assert not monitor.seen().failing
    record = GateRecord.of(monitor.policy)
    found = beside(record.recovery)
    assert found is not None
    assert (found.id, found.result, found.failed) == (progress.id, "Failed", progress.failed)
    assert (record.epoch, record.active, monitor.policy["spec"]) == (epoch, last.name if last else "", selector)


async def test_one_that_a_refusal_of_its_next_commit_stops_is_under_way_for_nobody_either(monitor: Monitor) -> None:
    progress = begun()
    await monitor.gate.commit(None, progress)
    monitor.fail("PATCH", DENIED)
    await monitor.recover(STANDBY, progress=progress)
    assert monitor.ended == ["Stopped"]
    monitor.fail("PATCH", None)
    await monitor.look()
    assert not monitor.seen().failing


async def test_one_that_was_stopped_before_its_commit_costs_no_request(monitor: Monitor) -> None:
    await monitor.recover(DENIED)
    before = len(monitor.client.requests)
    await monitor.look()
    assert (len(monitor.client.requests), monitor.journal.given_up()) == (before, [])


async def test_those_that_wait_for_the_same_pool_do_not_wait_for_it(monitor: Monitor) -> None:
    progress = begun()
    progress.waiting = Waiter(workload="w", pool="spare", priority=0, since=2.0, until=1e12)
    await monitor.recover(None, DENIED, progress=progress)
    assert monitor.policy["metadata"]["labels"] == {"app": "w", names.WAITS_FOR: "spare"}
    await monitor.look()
    found = beside(GateRecord.of(monitor.policy).recovery)
    assert found is not None
    assert found.waiting is None
    assert monitor.policy["metadata"]["labels"] == {"app": "w"}


@pytest.mark.parametrize("error", [DENIED, AWAY, ApiError(503, "Busy", "try again"), TimeoutError()])
async def test_it_is_tried_until_the_api_server_answers_and_then_never_again(
    monitor: Monitor, error: Exception
) -> None:
    await monitor.recover(None, DENIED)
    monitor.fail("PATCH", error)
    for _ in range(3):
        await monitor.look()
    assert monitor.seen().failing
    monitor.fail("PATCH", None)
    await monitor.look()
    assert not monitor.seen().failing
    done = written(monitor.client)
    for _ in range(3):
        await monitor.look()
    assert written(monitor.client) == done
    assert monitor.journal.given_up() == []


async def test_nothing_waits_for_its_answer_and_one_is_asked_at_a_time(
    monitor: Monitor, monkeypatch: pytest.MonkeyPatch
) -> None:
    await monitor.recover(None, DENIED)
    asked, answered, real = 0, asyncio.Event(), GATE.end_recovery

    async def slow(*arguments: Any, **named: Any) -> Object:
        nonlocal asked
        asked += 1
        await answered.wait()
        return await real(*arguments, **named)

    monkeypatch.setattr(GATE, "end_recovery", slow)
    for _ in range(3):
        monitor.abandonment.look()
        await asyncio.sleep(0)
    assert asked == 1
    next_one = begun(STANDBY)
    async with asyncio.timeout(1):
        await monitor.gate.commit(THIRD, next_one)  # while it is under way
    answered.set()
    await monitor.look()
    found = beside(GateRecord.of(monitor.policy).recovery)
    assert found is not None
    assert (found.id, found.result, monitor.gate.state.active) == (next_one.id, "Running", THIRD.name)


async def test_a_commit_that_it_was_faster_than_is_carried_out_all_the_same(monitor: Monitor) -> None:
    await monitor.recover(None, DENIED)
    known = dict(monitor.view.gates.items)
    await monitor.look()
    monitor.view.gates.items = known  # its answer has not come yet, nor has the watch told
    next_one = begun()
    await monitor.gate.commit(STANDBY, next_one)
    found = beside(GateRecord.of(monitor.policy).recovery)
    assert found is not None
    assert (found.id, found.result, GateRecord.of(monitor.policy).epoch) == (next_one.id, "Running", 6)


@pytest.mark.parametrize("noticed", [True, False])
async def test_the_record_of_a_newer_recovery_is_not_written_over(
    monitor: Monitor, tmp_path: Path, noticed: bool
) -> None:
    await monitor.recover(None, DENIED)
    other, newer = await successor(monitor, tmp_path / "elsewhere"), begun()
    await other.gate.commit(STANDBY, newer)
    if noticed:
        put(monitor)
    await monitor.look()
    found = beside(GateRecord.of(monitor.policy).recovery)
    assert found is not None
    assert (found.id, found.result) == (newer.id, "Running")
    put(monitor)
    await monitor.look()
    assert (monitor.abandonment.ids, monitor.journal.given_up()) == (set(), []), (
        "the gate can't come to tell of it any more"
    )


async def test_one_that_another_monitor_has_taken_up_under_the_same_id_is_that_ones(
    monitor: Monitor, tmp_path: Path
) -> None:
    progress = await monitor.recover(None, DENIED)
    other = await successor(monitor, tmp_path / "elsewhere")
    taken_up = other.interrupted()
    assert taken_up is not None
    assert taken_up.id == progress.id, "it has another volume, and can't know"
    await other.gate.commit(STANDBY, taken_up)
    put(monitor)
    await monitor.look()
    found = beside(GateRecord.of(monitor.policy).recovery)
    assert found is not None
    assert (found.resumed, found.result) == (True, "Running")


async def test_a_monitor_that_starts_before_it_was_said_does_not_go_on_with_it_and_says_it(
    monitor: Monitor, tmp_path: Path
) -> None:
    await monitor.recover(None, STANDBY, DENIED)
    monitor.fail("PATCH", AWAY)
    await monitor.look()
    monitor.fail("PATCH", None)
    later = await successor(monitor, tmp_path)
    assert later.interrupted() is None, "whoever failed may be well again since"
    await later.look()
    assert not later.seen().failing
    assert (await successor(later, tmp_path)).interrupted() is None
    assert (await successor(later, tmp_path / "elsewhere")).interrupted() is None, "the gate says it to everybody"


async def test_one_that_a_new_monitor_had_taken_up_and_was_stopped_at_before_it_committed_is_given_up_too(
    monitor: Monitor, tmp_path: Path
) -> None:
    progress = begun()
    await monitor.gate.commit(None, progress)
    later = await successor(monitor, tmp_path)
    taken_up = later.interrupted()
    assert taken_up is not None
    await later.recover(DENIED, progress=taken_up)
    await later.look()
    assert not later.seen().failing


async def test_a_commit_that_is_carried_out_after_its_recovery_was_stopped_is_found(
    monitor: Monitor, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = GATE.commit
    late: list[Callable[[], Any]] = []

    async def unanswered(*arguments: Any, **named: Any) -> Object:
        late.append(lambda: real(*arguments, **named))
        raise DENIED  # by somebody in between, such as a proxy

    monkeypatch.setattr(GATE, "commit", unanswered)
    await monitor.recover(None)
    await monitor.look()
    assert not monitor.seen().failing
    await late[0]()
    put(monitor)
    assert monitor.seen().failing
    await monitor.look()
    assert not monitor.seen().failing


async def test_an_earlier_one_that_stands_there_still_is_not_forgotten_for_the_next_that_is_stopped(
    monitor: Monitor, tmp_path: Path
) -> None:
    first = await monitor.recover(STANDBY, DENIED)
    monitor.fail("PATCH", DENIED)
    for _ in range(5):
        await monitor.recover(None, progress=begun(STANDBY))
        await monitor.look()
    assert monitor.ended == ["Stopped"] * 6
    assert first.id in monitor.abandonment.ids
    assert len(monitor.journal.given_up()) == 2, "however often it is tried"
    monitor.fail("PATCH", None)
    later = await successor(monitor, tmp_path)
    await later.look()
    assert not later.seen().failing


async def test_what_somebody_fenced_by_hand_is_not_opened_by_saying_it(monitor: Monitor) -> None:
    progress = begun()
    await monitor.gate.commit(STANDBY, progress)
    over = GateRecord.of(monitor.policy)
    await GATE.commit(monitor.client, "fleet", "w", over=over, active="", active_uid="", recovery=over.recovery)
    put(monitor)
    await monitor.recover(DENIED, progress=progress)
    await monitor.look()
    record = GateRecord.of(monitor.policy)
    assert (record.epoch, record.active, GATE.let_through(monitor.policy)) == (6, "", ())
    assert not monitor.seen().failing


async def test_on_a_volume_that_is_full_it_is_said_all_the_same(
    monitor: Monitor, monkeypatch: pytest.MonkeyPatch
) -> None:
    await monitor.gate.commit(None, progress := begun())

    def full(given_up: Sequence[GivenUp]) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(monitor.journal, "give_up", full)
    monitor.abandonment.abandon(progress)
    await monitor.look()
    assert not monitor.seen().failing


def test_what_is_kept_of_them_outlasts_a_restart_and_a_damaged_file_counts_as_none(tmp_path: Path) -> None:
    journal, kept = Journal(tmp_path / "recovery.json"), [GivenUp(id="r1", epoch=4, sent="{}")]
    assert journal.given_up() == []
    journal.give_up(kept)
    journal.save(begun())
    journal.clear()
    assert Journal(tmp_path / "recovery.json").given_up() == kept
    (tmp_path / "recovery.given-up").write_text("[{")
    assert journal.given_up() == []
    journal.give_up([])
    assert list(tmp_path.iterdir()) == []


class TestWhatAnotherMonitorHasLeft:
    """As the older one of two, which has driven the robot to its end and is gone, and whose record was written over."""

    @pytest.fixture
    def clock(self, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
        clock = SimpleNamespace(now=100.0)
        monkeypatch.setattr(abandonment, "time", SimpleNamespace(monotonic=lambda: clock.now))
        return clock

    @pytest.fixture
    async def later(self, monitor: Monitor, tmp_path: Path) -> Monitor:
        await monitor.gate.commit(STANDBY, begun())
        found = await successor(monitor, tmp_path / "elsewhere")
        found.notices.set(health="Healthy")
        return found

    async def test_it_ends_once_the_robot_is_driven_for_so_long_that_it_would_be_recorded(
        self, later: Monitor, clock: SimpleNamespace
    ) -> None:
        for now in (100.0, 100.0 + LASTS - 0.1):
            clock.now = now
            await later.look()
            assert later.seen().failing
        clock.now = 100.0 + LASTS
        await later.look()
        assert not later.seen().failing
        assert GateRecord.of(later.policy).active == STANDBY.name

    @pytest.mark.parametrize("health", ["Failed", "Starting", "Unknown", "Recovering"])
    async def test_while_the_robot_is_not_driven_somebody_may_be_at_it(
        self, later: Monitor, clock: SimpleNamespace, health: str
    ) -> None:
        for clock.now in (100.0, 200.0, 300.0):
            later.notices.set(health="Healthy" if clock.now == 100.0 else health)
            await later.look()
        later.notices.set(health="Healthy")
        await later.look()
        assert later.seen().failing, "it counts from when it is healthy again"

    async def test_each_commit_begins_the_time_anew(
        self, monitor: Monitor, later: Monitor, clock: SimpleNamespace
    ) -> None:
        await later.look()
        clock.now += LASTS - 1
        await monitor.gate.commit(THIRD, begun(STANDBY))
        put(later)
        await later.look()
        clock.now += LASTS - 1
        await later.look()
        assert later.seen().failing

    async def test_what_the_status_tells_of_is_left_as_it_is(self, later: Monitor, clock: SimpleNamespace) -> None:
        found = beside(GateRecord.of(later.policy).recovery)
        assert found is not None
        later.notices.record(found.model_copy(update={"result": "Recovered"}))
        before = written(later.client)
        for clock.now in (100.0, 200.0, 300.0):
            await later.look()
        assert written(later.client) == before

    async def test_of_a_switchover_it_is_seen_what_came_of_it(
        self, monitor: Monitor, later: Monitor, clock: SimpleNamespace
    ) -> None:
        switchover = begun(STANDBY).model_copy(update={"switchover": "Failover", "planned": True})
        await monitor.gate.commit(THIRD, switchover)
        put(later)
        for clock.now in (100.0, 200.0, 300.0):
            await later.look()
        found = beside(GateRecord.of(later.policy).recovery)
        assert found is not None
        assert found.result == "Running"


async def test_one_that_is_superseded_leaves_what_the_other_monitor_has_committed(
    monitor: Monitor, tmp_path: Path
) -> None:
    other = await successor(monitor, tmp_path / "elsewhere")
    mine, theirs = begun(), begun()
    await monitor.gate.commit(None, mine)
    put(other)
    await other.gate.commit(STANDBY, theirs.model_copy(update={"result": "Failed"}))
    with pytest.raises(Superseded):
        await monitor.gate.commit(THIRD, mine)
    monitor.abandonment.abandon(mine)
    await monitor.look()
    assert GateRecord.of(monitor.policy).active == STANDBY.name
    assert monitor.abandonment.ids == set()

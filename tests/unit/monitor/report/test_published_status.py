"""What the reporter knows of what was said and recorded, by this monitor and by earlier ones."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any, Literal

import pytest
from prometheus_client import REGISTRY

from tests.support.golden import assert_golden
from tests.support.notices import RecordedNotices
from tests.unit.interleavings.apiserver import ApiServer
from understudy.api.kinds.robot_workload import GateStatus, MonitorStatus
from understudy.api.kinds.switchover_spec import SwitchoverStatus
from understudy.api.kinds.task_spec import TaskStatus
from understudy.failover.progress import PodIdentity, Progress
from understudy.kube.client import ApiError, Client, Object
from understudy.kube.events import Recorder
from understudy.monitor.act.recovery.recovery_messages import describe_switchover
from understudy.monitor.notices import ConditionChanged, GateCommitted, Notices, PublishedStatus
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups
from understudy.monitor.report import monitor_metrics, status_writer
from understudy.monitor.report.status_writer import StatusWriter


def done(at: float, *, planned: bool) -> Progress:
    progress = Progress.begin("slow", last_healthy=at - 0.1, detected=at, planned=planned)
    progress.result = "Recovered"
    return progress


async def test_the_last_planned_recovery_is_known_from_its_record() -> None:
    found = Notices()
    assert found.status.planned is None
    found.record(done(1000.0, planned=False))
    assert found.status.planned is None
    for at, planned in ((2000.5, True), (3000.0, False)):
        found.record(done(at, planned=planned))
    assert found.status.planned == 2000.5


def switchover(at: float, result: Literal["Recovered", "Failed"] = "Recovered") -> Progress:
    progress = done(at, planned=True)
    progress.result, progress.switchover = result, "Drain"
    progress.former = PodIdentity(name="w-1", uid="uid-1")
    progress.target = PodIdentity(name="w-2", uid="uid-2") if result == "Recovered" else None
    progress.strategy = "Fallback/Executing" if result == "Recovered" else ""
    progress.moments |= {"last_output": at - 0.012, "first_output": at + 0.04}
    return progress


def counted(kind: str, result: str) -> float:
    return REGISTRY.get_sample_value("understudy_switchovers_total", {"kind": kind, "result": result}) or 0.0


async def test_a_switchover_counts_neither_as_a_recovery_nor_as_a_planned_one_for_degradation() -> None:
    found, before = RecordedNotices(), counted("Drain", "Recovered")
    recoveries = {"strategy": "Fallback/Executing", "result": "Recovered"}
    failures = REGISTRY.get_sample_value("understudy_recoveries_total", recoveries)
    recovery = found.record(switchover(2000.0))
    for notice in found.log:
        monitor_metrics.count(notice)
    assert found.status.planned is None
    assert counted("Drain", "Recovered") == before + 1
    assert REGISTRY.get_sample_value("understudy_recoveries_total", recoveries) == failures
    assert_golden("monitor", describe_switchover(recovery), "w-2", "w-1", "Fallback/Executing", "epoch 0", "0.052 s")


async def test_repeated_failed_switchovers_are_one_record() -> None:
    found = Notices()
    failure = done(1000.0, planned=False)
    failure.result, failure.failed = "Failed", [PodIdentity(name="w-1", uid="uid-1")]
    found.record(failure)
    for at in (2000.0, 3000.0):
        found.record(switchover(at, "Failed"))
    assert found.status.count == 2
    assert found.status.last is not None
    assert describe_switchover(found.status.last).startswith("slow. w-1 can reach the robot again: ")


async def test_a_handled_switchover_is_known_to_the_next_monitor() -> None:
    before = Notices()
    switchover = SwitchoverStatus(kind="Failover", request="r", handled="r", phase="Done", since="2026-11-22T14:02:11Z")
    before.set_switchover(switchover)
    after = PublishedStatus.adopt({"status": before.status.to_wire()})
    assert after.switchover == switchover


async def test_a_new_monitor_knows_the_last_planned_recovery_and_the_conditions_of_the_instance() -> None:
    before = Notices()
    before.record(done(2000.5, planned=True))
    before.set(active="w-1")
    before.condition("Degraded", "True", "NotWell", "/scan at 8.6 Hz.")
    after = PublishedStatus.adopt({"status": before.status.to_wire()})
    assert after.planned == 2000.5
    assert after.adopted == "w-1"
    degraded = after.find("Degraded")
    assert degraded is not None
    assert (degraded.status, degraded.message) == ("True", "/scan at 8.6 Hz.")
    assert after.find("Recovering") is None


async def test_a_new_monitor_does_not_take_the_epoch_of_the_gate_back_in_the_status() -> None:
    """The operator makes a deleted gate again at this epoch, and agents refuse an older one."""
    before = Notices()
    before.set(gate=GateStatus(epoch=7, active="w-1"))
    assert PublishedStatus.adopt({"status": before.status.to_wire()}).gate.epoch == 7


async def test_tasks_with_active_goals_are_reported() -> None:
    found = Notices()
    found.set_tasks([TaskStatus(action="/go", active=0), TaskStatus(action="/dock", active=2)])
    assert found.status.goals == ["/dock"]


# -- what the object says ---------------------------------------------------------------------------------------------

PLACE = ("fleet", "w")


class Applied(Client):
    """A client whose server is a model that knows which manager has applied which fields."""

    def __init__(self) -> None:
        self.server, self.writes, self.unanswered = ApiServer(lambda: 0.0), 0, False
        metadata = {"name": "w", "namespace": "fleet", "uid": "u", "generation": 1}
        self.server.write("robotworkloads", PLACE, {"metadata": metadata}, "somebody")

    async def request(
        self, method: str, path: str, *, params: Any = None, body: Any = None, content_type: str = "application/json"
    ) -> Object:
        self.writes += 1
        answer = self.server.request(method, path, params, body, content_type, "a monitor")
        if self.unanswered:
            raise TimeoutError
        return answer

    @property
    def item(self) -> Object:
        found = self.server.get("robotworkloads", PLACE)
        assert found is not None
        return found

    async def write_status_by(self, manager: str, status: Object) -> None:
        body = {"metadata": {"name": "w", "namespace": "fleet"}, "status": status}
        path = "/apis/understudy.dev/v1alpha1/namespaces/fleet/robotworkloads/w/status"
        self.server.request("PATCH", path, {"fieldManager": manager}, body, "application/apply-patch+yaml", manager)


class Monitor(Notices):
    """A monitor's notices, and what writes them."""

    def __init__(self, api: Applied) -> None:
        super().__init__()
        view = ClusterView(api, "fleet", "w", Wakeups())
        self.writer = StatusWriter(api, view, Recorder(api, "understudy-monitor", "monitor"), self)


def monitor_of(api: Applied) -> Monitor:
    found = Monitor(api)
    found.set(active="w-1", health="Recovering")
    found.condition("Recovering", "True", "FailureDetected", "no /cmd_vel for 500 ms")
    return found


def say_recovered(found: Monitor) -> None:
    found.set(active="w-2", health="Healthy")
    found.condition("Recovering", "False", "Recovered", "w-2 took over")


async def recovered(found: Monitor) -> None:
    say_recovered(found)
    await found.writer.flush()


async def looked(found: Monitor, item: Object) -> None:
    """What housekeeping and the writer do."""
    found.writer.check(item)
    await found.writer.flush()


async def test_an_unchanged_condition_gets_the_present_generation_and_keeps_its_time() -> None:
    """kubectl wait takes no condition whose observedGeneration is below the object's: after a pause it would wait for ever."""
    api = Applied()
    found = monitor_of(api)
    found.observe(1)
    found.condition("Healthy", "True", "Healthy", "all is well")
    found.condition("StateRestored", "True", "Restored", "what it knew")
    await found.writer.flush()
    before = {c["type"]: c for c in api.item["status"]["conditions"]}
    found.observe(2)
    assert not found.condition("Healthy", "True", "Healthy", "all is well"), "nothing that an Event would be worth"
    await found.writer.flush()
    after = {c["type"]: c for c in api.item["status"]["conditions"]}
    assert after["Healthy"] == before["Healthy"] | {"observedGeneration": 2}
    assert after["StateRestored"] == before["StateRestored"], "what nobody has said again is about what was"
    writes = api.writes
    found.condition("Healthy", "True", "Healthy", "all is well")
    await found.writer.flush()
    assert api.writes == writes


async def test_a_late_status_of_a_dead_monitor_is_overwritten() -> None:
    api = Applied()
    dead, living = monitor_of(api), monitor_of(api)
    await recovered(living)
    before = api.item
    await dead.writer.flush()  # it was sent before that one died
    await looked(living, before)
    assert api.item["status"]["health"] == "Recovering", "that the watch tells nothing yet is no reason to write"
    await looked(living, api.item)
    assert api.item["status"]["health"] == "Healthy"
    assert api.item["status"]["active"] == "w-2"
    assert [c["status"] for c in api.item["status"]["conditions"]] == ["False"]
    writes = api.writes
    await looked(living, api.item)
    assert api.writes == writes


async def test_recoveries_of_two_monitors_are_both_listed() -> None:
    api = Applied()
    one, other = monitor_of(api), monitor_of(api)
    for number, monitor in enumerate((one, other), 1):
        progress = Progress.begin("no /cmd_vel", last_healthy=10.0 * number, detected=10.0 * number + 1)
        progress.result, progress.id = "Recovered", f"r{number}"
        monitor.record(progress)
        await monitor.writer.flush()
    await looked(one, api.item)
    await looked(other, api.item)
    listed = [(recovery["id"], recovery["number"]) for recovery in api.item["status"]["recoveries"]]
    assert (listed, api.item["status"]["recoveryCount"]) == ([("r2", 2), ("r1", 1)], 2)
    writes = api.writes
    await looked(one, api.item)
    await looked(other, api.item)
    assert api.writes == writes


async def test_an_unchanged_status_is_not_written_again() -> None:
    api = Applied()
    living = monitor_of(api)
    await looked(living, api.item)
    earlier = api.item
    await recovered(living)
    assert api.writes == 2
    for item in (earlier, api.item):  # its own writes, late and in time
        await looked(living, item)
    await api.write_status_by("understudy-operator", {"standby": "Executing 1/1", "conditions": []})
    accepted = {
        "type": "Accepted",
        "status": "True",
        "reason": "Accepted",
        "lastTransitionTime": "2026-01-01T00:00:00Z",
    }
    await looked(living, api.item)
    await api.write_status_by("understudy-operator", {"standby": "Executing 0/1", "conditions": [accepted]})
    await looked(living, api.item)
    assert api.writes == 2


async def test_a_status_that_the_api_server_pruned_is_not_repaired_for_ever() -> None:
    api = Applied()
    living = monitor_of(api)
    request = api.server.request

    def pruning(method: str, path: str, params: Any, body: Any, content_type: str, by: str) -> Object:
        known = {key: value for key, value in body["status"].items() if key != "gate"}
        return request(method, path, params, {**body, "status": known}, content_type, by)

    api.server.request = pruning  # type: ignore[method-assign]
    await recovered(living)
    await api.write_status_by("understudy-operator", {"standby": "Executing 1/1", "conditions": []})
    await looked(living, api.item)
    assert api.writes == 1


async def test_an_older_definition_receives_known_fields_and_the_others_are_logged_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    api = Applied()
    living = monitor_of(api)
    living.set_monitor(MonitorStatus(version="9.9.9", image="mine"))
    request = api.server.request

    def strict(method: str, path: str, params: Any, body: Any, content_type: str, by: str) -> Object:
        if "monitor" in body["status"]:
            warning = "failed to create typed patch object (fleet/w): .status.monitor: field not declared in schema"
            raise ApiError(500, "InternalError", warning)
        return request(method, path, params, body, content_type, by)

    api.server.request = strict  # type: ignore[method-assign]
    for active in ("w-2", "w-3"):
        living.set(active=active)
        await living.writer.flush()
        assert api.item["status"]["active"] == active
        await looked(living, api.item)
    assert api.writes == 4
    (warning,) = (record.message for record in caplog.records if record.levelname == "WARNING")
    assert "lacks .status.monitor: upgrade it" in warning


async def test_a_status_that_is_refused_for_another_reason_is_an_error() -> None:
    api = Applied()
    living = monitor_of(api)

    def refusing(*_: Any) -> Object:
        raise ApiError(
            500, "InternalError", 'failed to create typed patch object (x): duplicate entries for key [type="A"]'
        )

    api.server.request = refusing  # type: ignore[method-assign]
    with pytest.raises(ApiError, match="duplicate entries"):
        await living.writer.flush()
    assert api.writes == 1


async def test_two_monitors_do_not_overwrite_each_other_continuously(monkeypatch: pytest.MonkeyPatch) -> None:
    api, now = Applied(), [1000.0]
    monkeypatch.setattr(status_writer.time, "monotonic", lambda: now[0])
    one, other = monitor_of(api), monitor_of(api)
    await recovered(one)
    await other.writer.flush()
    writes = api.writes
    for _ in range(60):
        now[0] += 1.0
        await looked(one, api.item)
        await looked(other, api.item)
    assert api.writes - writes == 2 * 60 / status_writer.AGAIN


async def test_a_status_is_written_again_after_an_unanswered_write() -> None:
    api = Applied()
    living = monitor_of(api)
    await living.writer.flush()
    living.set(health="Healthy")
    api.unanswered = True
    with pytest.raises(TimeoutError):
        await living.writer.flush()
    assert api.item["status"]["health"] == "Healthy", "it was carried out"
    api.unanswered = False
    living.set(health="Recovering")
    await living.writer.flush()
    assert api.item["status"]["health"] == "Recovering"


@contextlib.asynccontextmanager
async def running(
    monkeypatch: pytest.MonkeyPatch, *, quiet: float = 0.0025, under_way: float = 0.3
) -> AsyncIterator[tuple[Applied, Monitor]]:
    """A writer with its loop, which waits for a hundredth of what it does in a cluster, and a tenth for a recovery."""
    monkeypatch.setattr(status_writer, "QUIET", quiet)
    monkeypatch.setattr(status_writer, "UNDER_WAY", under_way)
    api = Applied()
    found = monitor_of(api)
    task = asyncio.create_task(found.writer.run())
    try:
        yield api, found
    finally:
        task.cancel()


async def test_a_write_without_an_answer_does_not_hold_back_the_next_one_for_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A monitor that ends meanwhile would never list its recoveries (seed 3250149)."""
    monkeypatch.setattr(status_writer, "RETRY", 0.02)
    monkeypatch.setattr(status_writer, "ANSWERED_WITHIN", 0.02)
    async with running(monkeypatch) as (api, living):
        request = api.request

        async def hang(*_: Any, **__: Any) -> Object:
            say_recovered(living)
            monkeypatch.setattr(api, "request", request)
            await asyncio.Event().wait()
            raise AssertionError

        monkeypatch.setattr(api, "request", hang)
        living.set(health="Degraded")
        async with asyncio.timeout(2):
            while api.item.get("status", {}).get("health") != "Healthy":
                await asyncio.sleep(0.01)


@contextlib.contextmanager
def recovering(found: Monitor, *, status_soon: bool = False) -> Iterator[None]:
    """A recovery, of which everything is said in the order in which monitors do."""
    with found.recovering(status_soon=status_soon):
        found.set(health="Recovering", failing_since=999.9)
        yield
        found.record(done(1000.0, planned=False))
        say_recovered(found)


async def until(true: Callable[[], bool]) -> None:
    async with asyncio.timeout(5):
        while not true():
            await asyncio.sleep(0.002)


def health(api: Applied) -> str:
    found: str = api.item.get("status", {}).get("health", "")
    return found


async def test_a_short_recovery_is_reported_in_one_write_after_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """The record beside the gate reports it meanwhile: in a burst, in which each takes longer, that would be a write for each robot."""
    async with running(monkeypatch) as (api, found):
        with recovering(found):
            await asyncio.sleep(0.05)
            assert api.writes == 0
        await until(lambda: api.writes > 0)
        await asyncio.sleep(0.02)
    assert (api.writes, health(api)) == (1, "Healthy")
    assert len(api.item["status"]["recoveries"]) == 1


async def test_a_long_recovery_is_reported_while_it_is_under_way(monkeypatch: pytest.MonkeyPatch) -> None:
    async with running(monkeypatch) as (api, found):
        with recovering(found):
            await until(lambda: api.writes > 0)
            assert health(api) == "Recovering"
        await until(lambda: health(api) == "Healthy")
    assert api.writes == 2


async def test_a_requested_write_happens_at_once_during_a_recovery(monkeypatch: pytest.MonkeyPatch) -> None:
    async with running(monkeypatch, under_way=60.0) as (api, found):
        with recovering(found):
            await asyncio.sleep(0.02)
            found.request_write()
            await until(lambda: health(api) == "Recovering")


async def test_a_recovery_whose_begin_is_reported_is_written_after_its_first_commit_and_after_its_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with running(monkeypatch, under_way=60.0) as (api, found):
        with recovering(found, status_soon=True):
            await asyncio.sleep(0.02)
            assert api.writes == 0, "the commit goes first"
            found.add(GateCommitted(0.003))
            await until(lambda: health(api) == "Recovering")
            found.set(strategy="Restart")
            found.add(GateCommitted(0.003))
            await asyncio.sleep(0.02)
            assert api.writes == 1
        await until(lambda: health(api) == "Healthy")
    assert api.writes == 2


async def test_a_pending_write_waits_for_the_end_of_a_recovery(monkeypatch: pytest.MonkeyPatch) -> None:
    async with running(monkeypatch, quiet=0.05) as (api, found):
        found.set(strategy="Restart")
        await asyncio.sleep(0.01)
        with recovering(found):
            await asyncio.sleep(0.1)
            assert api.writes == 0
        await until(lambda: api.writes == 1)


@pytest.mark.parametrize(
    ("status", "epoch"),
    [
        *(({"active": "w-1", "health": health}, 3) for health in ("Healthy", "Degraded", "Failed", "Recovering")),
        *(({"active": "w-1", "health": health}, None) for health in ("Starting", "Unknown")),
        ({"active": "", "health": "Failed"}, None),
        ({}, None),
    ],
)
def test_a_new_monitor_knows_at_which_epoch_the_active_instance_had_driven(
    status: dict[str, str], epoch: int | None
) -> None:
    gate = {"epoch": 3, "active": status.get("active", "")}
    assert PublishedStatus.adopt({"status": {**status, "gate": gate}}).driven_epoch == epoch


async def test_a_condition_that_quotes_control_characters_is_written_once() -> None:
    """Its message is not the given one, so that each evaluation would count as a change."""
    found = RecordedNotices()
    for _ in range(3):
        found.condition("Healthy", "False", "Failed", "amcl says ERROR: \x1b[2J\nlost")
    assert found.status.find("Healthy").message == r"amcl says ERROR: \x1b[2J lost"  # type: ignore[union-attr]
    assert len([one for one in found.log if isinstance(one, ConditionChanged)]) == 1

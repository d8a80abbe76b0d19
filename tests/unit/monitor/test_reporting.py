"""What the reporter knows of what was said and recorded, by this monitor and by earlier ones."""

from __future__ import annotations

from typing import Any, Literal

from prometheus_client import REGISTRY

from understudy.api.switchovers import SwitchoverStatus
from understudy.api.tasks import TaskStatus
from understudy.cluster.client import Object
from understudy.mitigation.progress import PodIdentity, Progress
from understudy.monitor.reporting import Reporter, switched


def reporter() -> Reporter:
    nobody: Any = None
    return Reporter(nobody, "fleet", "w", nobody)


def done(at: float, *, planned: bool) -> Progress:
    progress = Progress.begin("slow", last_healthy=at - 0.1, detected=at, planned=planned)
    progress.result = "Recovered"
    return progress


async def test_the_last_planned_hand_over_is_known_by_the_record() -> None:
    found = reporter()
    assert found.planned is None
    found.record(done(1000.0, planned=False))
    assert found.planned is None
    for at, planned in ((2000.5, True), (3000.0, False)):
        found.record(done(at, planned=planned))
    assert found.planned == 2000.5


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


async def test_a_switchover_is_no_recovery_of_the_metrics_and_no_hand_over_of_a_degraded_instance() -> None:
    found, before = reporter(), counted("Drain", "Recovered")
    recoveries = {"strategy": "Fallback/Executing", "result": "Recovered"}
    failures = REGISTRY.get_sample_value("understudy_recoveries_total", recoveries)
    recovery = found.record(switchover(2000.0))
    assert found.planned is None
    assert counted("Drain", "Recovered") == before + 1
    assert REGISTRY.get_sample_value("understudy_recoveries_total", recoveries) == failures
    assert switched(recovery) == (
        "slow. w-2 took over from w-1 by Fallback/Executing, epoch 0. The robot got no command for 0.052 s"
    )


async def test_one_that_is_given_back_again_and_again_is_one_record_and_no_failure_s() -> None:
    found = reporter()
    failure = done(1000.0, planned=False)
    failure.result, failure.failed = "Failed", [PodIdentity(name="w-1", uid="uid-1")]
    found.record(failure)
    for at in (2000.0, 3000.0):
        found.record(switchover(at, "Failed"))
    assert found.count == 2
    assert found.last is not None
    assert switched(found.last).startswith("slow. w-1 was let through again: ")


async def test_what_was_handled_is_known_to_the_next_monitor() -> None:
    before, after = reporter(), reporter()
    said = SwitchoverStatus(kind="Failover", request="r", handled="r", phase="Done", since="2026-11-22T14:02:11Z")
    before.say_switchover(said)
    after.adopt({"metadata": {"name": "w", "namespace": "fleet", "uid": "u"}, "status": before._body()["status"]})
    assert after.switchover == said


async def test_a_new_monitor_knows_it_and_what_was_said_of_whom() -> None:
    before = reporter()
    before.record(done(2000.5, planned=True))
    before.set(active="w-1")
    before.condition("Degraded", "True", "NotWell", "/scan at 8.6 Hz.")
    item: Object = {"metadata": {"name": "w", "namespace": "fleet", "uid": "u"}, "status": before._body()["status"]}
    after = reporter()
    after.adopt(item)
    assert after.planned == 2000.5
    assert after.adopted == "w-1"
    said = after.find("Degraded")
    assert said is not None
    assert (said.status, said.message) == ("True", "/scan at 8.6 Hz.")
    assert after.find("Recovering") is None


async def test_goals_are_those_that_the_proxy_has_worked_on_or_not() -> None:
    found = reporter()
    found.tasks([TaskStatus(action="/go", active=0), TaskStatus(action="/dock", active=2)])
    assert found.goals == ["/dock"]

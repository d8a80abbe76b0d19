"""What the reporter knows of what was said and recorded, by this monitor and by earlier ones."""

from __future__ import annotations

from typing import Any

from understudy.api.tasks import TaskStatus
from understudy.cluster.client import Object
from understudy.mitigation.progress import Progress
from understudy.monitor.reporting import Reporter


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

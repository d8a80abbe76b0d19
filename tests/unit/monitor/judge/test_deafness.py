"""Whether a monitor notices that DDS discovery has left it deaf for the active instance, and ends itself once."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

import pytest

from tests.support.golden import assert_golden
from tests.unit.monitor.cluster_objects import ClusterObjects
from tests.unit.monitor.senses import GivenObserver, GivenSenses
from understudy.failover.interfaces import GateState, Instance
from understudy.monitor.judge import deafness
from understudy.monitor.judge.deafness import LOOKS, Deaf, DeafnessWatch, EndedFor, Search
from understudy.monitor.observe.agent_connections import AgentConnections

ACTIVE = Instance("w-1", "uid-1", ip="10.0.0.1", running=True)


class Watching:
    """A watch over a pod that the gate lets through, whose agent reports it as ready, and that was not discovered."""

    def __init__(self, folder: Path, active: Instance = ACTIVE) -> None:
        self.objects = ClusterObjects()
        self.observer = GivenObserver()
        self.senses = GivenSenses(self.objects, self.observer)
        self.file = folder / "deaf-for"
        self.let_through(active)
        self.watch = self.watch_by(self.senses.agents)

    def let_through(self, active: Instance) -> None:
        self.objects.put_pods(active)
        self.objects.put_gate(GateState(epoch=3, active=active.name, active_uid=active.uid))
        self.observer.undiscovered = {active.uid}

    def watch_by(self, agents: AgentConnections) -> DeafnessWatch:
        objects = self.objects
        return DeafnessWatch(objects.pods, objects.gate, agents, self.observer, EndedFor(self.file), objects.notices)

    def looks(self, times: int = LOOKS) -> list[Deaf]:
        """Look so often. Returns what was found."""
        return [found for _ in range(times) if (found := self.watch.look()) is not None]


@pytest.fixture
def watching(tmp_path: Path) -> Watching:
    return Watching(tmp_path)


def test_a_monitor_is_deaf_for_an_instance_that_is_ready_and_was_not_discovered_in_ten_looks(
    watching: Watching,
) -> None:
    assert watching.looks(LOOKS - 1) == []
    (found,) = watching.looks(1)
    assert_golden("monitor", str(found), "w-1", "10 s")
    assert [(kind, reason) for kind, reason, _ in watching.objects.notices.events] == [("Warning", "MonitorDeaf")]


def test_a_monitor_that_has_discovered_the_instance_does_not_search_again(watching: Watching) -> None:
    watching.looks(LOOKS - 1)
    watching.observer.undiscovered.clear()
    assert watching.looks(1) == []
    searched = len(watching.observer.searched)
    watching.observer.undiscovered = {"uid-1"}
    assert watching.looks(3 * LOOKS) == []
    assert len(watching.observer.searched) == searched


def test_a_monitor_that_receives_nothing_from_anybody_is_deaf_although_it_has_discovered_the_instance(
    watching: Watching,
) -> None:
    watching.observer.undiscovered.clear()
    watching.observer.hears_nobody = True
    assert watching.looks(LOOKS - 1) == []
    assert len(watching.looks(1)) == 1


def test_a_monitor_that_receives_nothing_on_a_topic_of_the_robot_that_the_agent_receives_is_deaf(
    watching: Watching,
) -> None:
    watching.observer.undiscovered.clear()
    watching.observer.awaited = ["/scan"]
    assert watching.looks(3 * LOOKS) == [], "it may be published rarely"
    watching.observer.unheard = "/scan"
    assert watching.looks(LOOKS - 1) == []
    assert len(watching.looks(1)) == 1


def test_the_looks_at_an_instance_begin_again_when_its_agent_is_gone_for_a_moment(watching: Watching) -> None:
    watching.looks(LOOKS - 1)
    watching.senses.agents.unready = {"uid-1": "its agent is not connected: connection refused"}
    watching.looks(1)
    watching.senses.agents.unready = {}
    assert watching.looks(LOOKS - 1) == []
    assert len(watching.looks(1)) == 1


def test_the_looks_at_one_instance_do_not_count_for_the_next(watching: Watching) -> None:
    watching.looks(LOOKS - 1)
    watching.let_through(replace(ACTIVE, name="w-2", uid="uid-2"))
    assert watching.looks(LOOKS - 1) == []
    assert len(watching.looks(1)) == 1


@pytest.mark.parametrize(
    "active",
    [
        replace(ACTIVE, terminating=True),
        replace(ACTIVE, terminating=True, evicted=True),
        replace(ACTIVE, running=False),
        replace(ACTIVE, ip="fd00::1"),
        replace(ACTIVE, ip=""),
    ],
)
def test_an_instance_that_ends_or_whose_address_does_not_tell_is_not_judged(tmp_path: Path, active: Instance) -> None:
    assert Watching(tmp_path, active).looks(2 * LOOKS) == []


def test_a_closed_gate_is_not_judged(watching: Watching) -> None:
    watching.objects.put_gate(GateState(epoch=4))
    assert watching.looks(2 * LOOKS) == []


def test_a_pod_without_an_agent_is_not_judged(watching: Watching) -> None:
    objects, senses = watching.objects, watching.senses
    real = AgentConnections(
        objects.client, objects.view, "127.0.0.1", objects.crash_points, senses.roles, objects.wakeups, objects.proof
    )
    watching.watch = watching.watch_by(real)
    assert watching.looks(2 * LOOKS) == []


async def test_a_monitor_does_not_end_while_the_api_server_does_not_answer(watching: Watching) -> None:
    """The next one could not start."""
    contact = watching.objects.client.contact
    with contextlib.suppress(ConnectionError), contact.asking():
        raise ConnectionError
    assert watching.looks(2 * LOOKS) == []
    with contact.asking():
        pass
    assert len(watching.looks()) == 1


def test_a_monitor_ends_once_for_an_instance_also_after_its_container_has_restarted(watching: Watching) -> None:
    assert len(watching.looks()) == 1
    assert watching.looks(2 * LOOKS) == []
    watching.watch = watching.watch_by(watching.senses.agents)
    assert watching.looks(2 * LOOKS) == []
    watching.let_through(replace(ACTIVE, name="w-2", uid="uid-2"))
    assert len(watching.looks()) == 1
    watching.watch = watching.watch_by(watching.senses.agents)
    watching.let_through(ACTIVE)
    assert watching.looks(2 * LOOKS) == []


@pytest.mark.parametrize("obstacle", ["deaf-for", "deaf-for.new"])
def test_a_monitor_that_cannot_store_for_whom_it_ends_does_not_end(watching: Watching, obstacle: str) -> None:
    # A folder cannot be read or written as a file, like a full or damaged disk.
    (watching.file.parent / obstacle).mkdir()
    assert watching.looks(3 * LOOKS) == []
    assert watching.objects.notices.events == []


def test_an_instance_that_cannot_be_searched_for_is_neither_found_nor_missed() -> None:
    assert Search("a", missed=4).after("a", None) == Search("a")
    assert Search("a", over=True).after("a", None) == Search("a", over=True)
    assert Search("a", over=True).after("b", None) == Search("b")


async def test_the_watch_ends_with_an_error_that_says_why(watching: Watching, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PERIOD", "TIME_TO_REPORT"):
        monkeypatch.setattr(deafness, name, 0.0)
    with pytest.raises(Deaf, match="w-1"):
        await watching.watch.run()
    assert watching.objects.notices.reasons == ["MonitorDeaf"]

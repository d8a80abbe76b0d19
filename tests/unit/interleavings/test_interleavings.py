"""Claims, gates and pools hold under whatever order requests, answers, watches, failures and deaths come in.

A run that fails says its seed; ``scripts/bench interleavings --seed SEED`` tells all that happened in it, and ten thousand
of them are ``scripts/bench interleavings``.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator
from dataclasses import replace
from typing import Any
from unittest import mock

import pytest

from tests.unit.interleavings import network, simulation
from tests.unit.interleavings.comparison import observed_alike, unconditional, without
from tests.unit.interleavings.scenes import SCENES, Outcome, Scene
from understudy.agent.agent_memory import AgentMemory
from understudy.api import names
from understudy.api.protocol import agent_messages
from understudy.controller.desired import standby_pods
from understudy.controller.plan import Patch
from understudy.controller.reconcile.executor import Executor
from understudy.controller.reconcile.expectations import Expectations
from understudy.failover import protocol
from understudy.failover.interfaces import Instance
from understudy.failover.progress import Progress
from understudy.failover.strategies.base import StrategyContext
from understudy.kube import api_contact, apply, claims, watched_collection
from understudy.kube.client import Client, Object
from understudy.kube.gates.base import GateRecord
from understudy.kube.gates.kinds.network_policy import GATE
from understudy.kube.leader_election import Lease
from understudy.monitor.act import safe_commands
from understudy.monitor.act.gate.leak_response import LeakResponse
from understudy.monitor.act.instances.garbage_collection import GarbageCollection
from understudy.monitor.act.instances.pod_labels import PodLabels
from understudy.monitor.act.objects import gate_control
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.act.recovery.abandonment import Abandonment
from understudy.monitor.judge import sole_driver
from understudy.monitor.judge.reassessment import Reassessment
from understudy.monitor.judge.sole_driver import SoleDriver
from understudy.monitor.observe import agent_connections
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.report.status_writer import StatusWriter
from understudy.state.state_capture import Version, _Item
from understudy.state.state_store import StateStore

RUNS, CHUNK = 90, 18
"""The short share; seeds from 100,000 on, which scripts/bench doesn't run by itself."""
FIRST = 100_000

SHARED, SCARCE, EXECUTING, INITIALIZED = SCENES[:4]


@pytest.mark.parametrize("first", range(FIRST, FIRST + RUNS, CHUNK))
def test_the_invariants_hold_in_every_interleaving(first: int) -> None:
    for seed in range(first, first + CHUNK):
        outcome = simulation.run(seed)
        assert not outcome.faults, str(simulation.run(seed, tracing=True))


def test_a_seed_determines_the_run() -> None:
    assert "monitor" in observed_alike("simulation", 100_003, range(6))


# -- the simulation finds faults ------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _prepared() -> None:
    """What runs begin from is made by code without faults."""
    for scene in SCENES:
        simulation.prepared(scene)


def found(words: str, scene: Scene, *troubles: str, weather: float = 1.0, within: int = 100, first: int = 0) -> Outcome:
    """The first run of a scene, with only these troubles, in which something of these words doesn't hold.

    ``first`` is a seed that found it when it was written, so that the test takes no longer than it has to.
    """
    only = replace(scene, troubles=troubles, weather=(weather,))
    for seed in range(first, first + within):
        outcome = simulation.run(seed, scene=only)
        if any(words in fault for fault in outcome.faults):
            return outcome
    pytest.fail(f"no {words!r} in {within} runs")


def test_commands_of_a_monitor_that_was_replaced_are_detected() -> None:
    with (
        mock.patch.object(AgentMemory, "outdated", return_value=None),
        mock.patch.object(agent_messages, "FRESH", math.inf),
        mock.patch.object(agent_connections, "CONFIRMED_FOR", math.inf),
    ):
        assert found("later it carries out", INITIALIZED, "monitor_is_replaced", first=72)


def test_a_claim_without_its_precondition_is_detected() -> None:
    writes = {name: getattr(claims, name) for name in ("_write", "_test_and_write")}

    def careless(name: str) -> Any:
        async def write(client: Client, pod: Object, *rest: Any) -> Object:
            with mock.patch.object(client, "patch", without("resourceVersion", "uid").__get__(client)):
                return await writes[name](client, pod, *rest)

        return write

    with mock.patch.multiple(claims, **{name: careless(name) for name in writes}):
        assert found("was claimed by", SCARCE, "all_fail", weather=3.0, within=300, first=16)


def test_a_commit_without_its_precondition_is_detected() -> None:
    with mock.patch.object(GATE, "commitment", unconditional(GATE.commitment)):
        assert found("went from epoch", EXECUTING, "second_monitor", "all_fail")


def test_a_gate_that_opens_before_the_failed_pod_is_fenced_is_detected() -> None:
    commitment, routing = GATE.commitment, GATE.routing
    before: dict[str, str] = {}

    def careless(workload: str, *, over: GateRecord, active: str, **more: Any) -> Object:
        before[workload] = over.active if active else ""
        return commitment(workload, over=over, active=active, **more)

    def both(workload: str, active: str, admitted: str = "") -> Object:
        return routing(workload, active, admitted or before.get(workload, ""))

    # Both for the whole test: a monitor that is killed ends no context that it is in.
    with mock.patch.object(GATE, "commitment", careless), mock.patch.object(GATE, "routing", both):
        assert found("through and names", EXECUTING, "all_fail")


def test_forgotten_expectations_are_detected() -> None:
    with mock.patch.object(Expectations, "expect"):
        assert found(
            "free pods, ", SHARED, "understudy_fails", "watch_falls_silent", weather=3.0, within=400, first=941
        )


def test_a_claim_with_a_lost_answer_that_counts_as_refused_is_detected() -> None:
    with (
        mock.patch.object(claims, "unanswered", return_value=False),
        mock.patch.object(GarbageCollection, "housekeeping"),
    ):
        assert found("nobody deletes it", SHARED, "all_fail", weather=3.0, first=3)


def test_a_monitor_that_does_not_read_a_fence_at_the_gate_is_detected() -> None:
    with mock.patch.object(ClusterView, "fenced", return_value=False):
        troubles = ("somebody_fences", "second_monitor", "monitor_dies")
        assert found("a user has fenced it", EXECUTING, *troubles, weather=2.0, first=9)


def test_a_label_that_nobody_restores_is_detected() -> None:
    restored = standby_pods.relabelled

    def forgetful(*arguments: Any) -> list[Patch]:
        return [one for one in restored(*arguments) if names.WORKLOAD in one.item["metadata"].get("labels", {})]

    with (
        mock.patch.object(standby_pods, "relabelled", forgetful),
        mock.patch.object(PodLabels, "follow"),
        mock.patch.object(LeakResponse, "respond", return_value=False),
    ):
        assert found("drive robot-", EXECUTING, "labels_are_edited")


def test_the_deletion_of_a_claimed_pod_is_detected() -> None:
    async def careless(client: Client, resource: Any, item: Object) -> None:
        await client.delete(resource, item["metadata"]["namespace"], item["metadata"]["name"])

    with mock.patch.object(apply, "delete_exactly", careless):
        assert found("which is claimed", SHARED, "all_fail", "pool_is_resized", first=7)


def test_a_status_that_a_dead_monitor_overwrites_is_detected() -> None:
    with mock.patch.object(StatusWriter, "check"):
        troubles = ("second_monitor", "all_fail", "monitor_dies")
        assert found("than the status", EXECUTING, *troubles, weather=3.0, first=52)


FALLS_BEHIND = ("node_is_forgotten", "node_is_deaf")


def test_a_status_that_says_healthy_while_two_instances_drive_is_detected() -> None:
    with mock.patch.object(SoleDriver, "track", return_value=False):
        assert found("is Healthy, and", EXECUTING, *FALLS_BEHIND, weather=0.0, first=11)


def test_a_recovery_that_is_recorded_while_another_instance_drives_is_detected() -> None:
    async def careless(target: Instance, progress: Progress, context: StrategyContext) -> None:
        await asyncio.sleep(0.5)
        progress.moments["verified"] = context.clock()

    with mock.patch.object(protocol, "alone", careless):
        assert found("as Recovered, and", EXECUTING, *FALLS_BEHIND, weather=0.0, first=11)


def test_a_stale_decision_that_fences_a_healthy_instance_is_detected() -> None:
    @contextlib.asynccontextmanager
    async def never(self: Reassessment, progress: Progress) -> AsyncIterator[None]:
        yield

    with mock.patch.object(Reassessment, "during", never):
        assert found("healthy again", EXECUTING, "decision_is_late", weather=0.0)


def test_the_deletion_of_an_understudy_that_never_failed_is_detected() -> None:
    with mock.patch.object(GateControl, "unanswered_since", None):
        assert found("has never failed", EXECUTING, "api_server_is_away", weather=0.0, first=4)


def test_a_robot_that_nobody_drives_long_after_an_outage_is_detected() -> None:
    with (
        mock.patch.object(api_contact, "LASTS", math.inf),
        mock.patch.multiple(gate_control, RETRY_FIRST=200.0, RETRY_MOST=200.0),
    ):
        assert found("nobody drives", EXECUTING, "api_server_is_away", weather=0.0, first=1168)


def test_restored_state_that_is_older_than_what_was_kept_is_detected() -> None:
    def oldest(self: _Item, moment: float) -> Version | None:
        return next((version for version in self.versions if version.good_from <= moment), None)

    with mock.patch.object(_Item, "before", oldest):
        assert found("older than what was kept", SCARCE, "all_fail", "one_fails", weather=0.0)


def test_kept_state_that_a_new_monitor_does_not_find_is_detected() -> None:
    with mock.patch.object(StateStore, "save"):
        assert found("is restored, and some was kept", SCARCE, "monitor_dies", "all_fail", weather=0.0, first=1)


def test_a_half_open_watch_that_is_never_given_up_is_detected() -> None:
    with mock.patch.object(network, "GIVEN_UP", (math.inf,)), mock.patch.object(watched_collection, "LATE", math.inf):
        assert found("knows version", EXECUTING, "monitor_watch_is_half_open", "one_fails", weather=0.0, first=5)


def test_a_second_driver_of_which_no_condition_says_anything_is_detected() -> None:
    with (
        mock.patch.object(sole_driver, "judge", return_value=("True", "NoOtherSender", "")),
        mock.patch.object(LeakResponse, "respond", mock.AsyncMock(return_value=False)),
    ):
        assert found("says SoleDriver=True", EXECUTING, *FALLS_BEHIND, weather=0.0, first=11)


def test_a_second_driver_that_nobody_ends_is_detected() -> None:
    with (
        mock.patch.object(LeakResponse, "respond", mock.AsyncMock(return_value=False)),
        mock.patch.object(LeakResponse, "respond_during"),
    ):
        assert found("ends neither", EXECUTING, *FALLS_BEHIND, weather=0.0, first=26)


def test_safe_commands_over_an_instance_that_drives_are_detected() -> None:
    with (
        mock.patch.object(safe_commands, "CLOSED", "committing"),
        mock.patch.multiple(safe_commands, HEARD_FOR=0.0, HEARD_FOR_MOST=0.0),
    ):
        assert found("receives a safe command", EXECUTING, "all_fail", "one_fails")


def test_safe_commands_between_two_samples_of_a_slow_driver_are_detected() -> None:
    with mock.patch.object(safe_commands, "HEARD_FOR_MOST", safe_commands.HEARD_FOR):
        seeds = range(20_077, 20_377)
        assert any("receives a safe command" in fault for seed in seeds for fault in simulation.run(seed).faults)


def test_a_recovery_that_stays_at_the_gate_for_ever_is_detected() -> None:
    with mock.patch.object(Abandonment, "update"):
        assert found("as though it were under way", EXECUTING, "second_monitor", "all_fail", first=1)


def test_an_operator_that_continues_while_another_one_leads_is_detected() -> None:
    async def careless(self: Lease) -> None:
        await asyncio.Event().wait()

    with mock.patch.object(Lease, "keep", careless), mock.patch.object(Executor, "check"):
        assert found("leads", SHARED, "somebody_is_cut_off", "all_fail")

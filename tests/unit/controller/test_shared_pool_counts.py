"""The numbers of a shared pool's status, and a pool that has run dry."""

from __future__ import annotations

import json
import time
from typing import Any, cast

import pytest

from tests.support.golden import assert_golden
from tests.unit.controller.pools import condition, observe, plan, present, status
from tests.unit.controller.world import (
    NOW,
    claimed_pod,
    created,
    gate,
    held_pod,
    hot,
    source_pod,
    spare,
    standby_pod,
    workload,
)
from understudy.api import names
from understudy.controller.observed import kube_objects
from understudy.controller.pods import pool_pods
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.observer import Observer
from understudy.failover.pool_queue import Waiter
from understudy.failover.progress import Progress
from understudy.kube.client import NETWORK_POLICIES, PODS, POOLS, WORKLOADS, Client, Object


class TestCounts:
    def test_a_shared_pool_counts_unclaimed_ready_and_claimed_pods(self) -> None:
        pool = spare(replicas=3)
        pods = [
            held_pod("spare-a", of=pool, template_hash="h"),
            held_pod("spare-b", of=pool, template_hash="other"),
            held_pod("spare-c", of=pool, template_hash="h", ready=False),
            claimed_pod("spare-d", of=pool, by=workload()),
        ]
        policy = {"metadata": {"name": "spare-held", "annotations": {names.TEMPLATE_HASH: "h"}}}
        found = status(observe(pool, pods, workloads=[workload()], owned={("networkpolicies", "spare-held"): policy}))
        assert {key: found[key] for key in ("replicas", "desired", "ready", "claimed")} == {
            "replicas": 3,
            "desired": 3,
            "ready": 1,
            "claimed": 1,
        }
        assert found["selector"] == f"{names.POOL}=spare,{names.HELD}=true,{names.CLAIMED_BY}="

    def test_a_pool_per_workload_counts_standbys_and_those_in_control(self) -> None:
        pool = hot(per_workload=1)
        one, two, other = workload("a"), workload("b"), workload("c", labels={"task": "other"})
        driving, waiting = standby_pod("a-s", of=one), standby_pod("b-s", of=two)
        observed = observe(pool, [driving, waiting], workloads=[one, two, other], active=frozenset({"uid-a-s"}))
        assert numbers(observed) == {"replicas": 1, "desired": 2, "ready": 1, "claimed": 1}
        ready = condition(observed, "Ready")
        assert (ready["status"], ready["reason"]) == ("False", "PodsNotReady"), (
            "if a failed now, nobody could take over"
        )

    async def test_the_own_pod_of_a_workload_counts_as_standby_while_a_standby_is_active(self) -> None:
        # The workload's own controller makes it after a failover. READY 0 would have somebody woken for a pool that has run dry.
        item, pool, other = workload(), hot(per_workload=1), hot("warm", per_workload=1)
        driving = standby_pod("w-s", of=item)
        for own, ready in ((source_pod("w-a"), 1), (source_pod("w-a", ready=False), 0)):
            observed = await sight(item, pool, other, gate(item, active=driving, epoch=2), driving, own)
            assert numbers(observed[0]) == {"replicas": 1, "desired": 1, "ready": ready, "claimed": 1}
            assert condition(observed[0], "Ready")["status"] == str(bool(ready))
            assert numbers(observed[1]) == {"replicas": 0, "desired": 1, "ready": 0, "claimed": 0}, (
                "it waits for one pool"
            )

    async def test_an_active_own_pod_of_a_workload_is_not_counted_as_a_standby(self) -> None:
        item, pool = workload(), hot(per_workload=1)
        own, waiting = source_pod("w-a"), standby_pod("w-s", of=item)
        observed = await sight(item, pool, gate(item, active=own, epoch=1), own, waiting)
        assert numbers(observed[0]) == {"replicas": 1, "desired": 1, "ready": 1, "claimed": 0}

    def test_a_change_of_an_own_pod_that_is_a_standby_reconciles_the_pool(self) -> None:
        item, store = workload(), Store()
        driving, own = standby_pod("w-s", of=item), source_pod("w-a", ready=False)
        ready = source_pod("w-a")
        ready["metadata"]["resourceVersion"] = "99"
        opened = gate(item, active=driving, epoch=2)
        for resource, found in ((WORKLOADS, item), (PODS, driving), (PODS, own), (NETWORK_POLICIES, opened)):
            store.put(resource, found)
        reconciled: list[set[change_index.Key]] = []
        store.noticed = lambda sight: reconciled.append(change_index.of(sight, store).keys)
        store.put(PODS, ready)
        assert reconciled == [
            {change_index.Key("fallbackpools", "fleet", "hot"), change_index.Key("robotworkloads", "fleet", "w")}
        ]

    async def test_a_pod_of_a_referenced_controller_is_not_counted_as_a_standby(self) -> None:
        item, pool = workload(workloadRef={"kind": "Deployment", "name": "nav2"}), hot(per_workload=1)
        driving = standby_pod("w-s", of=item)
        observed = await sight(item, pool, gate(item, active=driving, epoch=2), driving, source_pod("w-a"))
        assert numbers(observed[0]) == {"replicas": 0, "desired": 1, "ready": 0, "claimed": 1}


def numbers(observed: pool_pods.Observed) -> Object:
    found = status(observed)
    return {key: found[key] for key in ("replicas", "desired", "ready", "claimed")}


async def sight(*items: Object) -> list[pool_pods.Observed]:
    """What is seen of the pools among these objects, as the operator's stores have it."""
    store = Store()
    resources = {"RobotWorkload": WORKLOADS, "FallbackPool": POOLS, "NetworkPolicy": NETWORK_POLICIES, "Pod": PODS}
    for item in items:
        store.put(resources[item["kind"]], item)
    observer = Observer(cast(Client, None), store, Expectations())
    return [await observer.pool(item) for item in items if item["kind"] == "FallbackPool"]


def test_the_gate_names_the_active_pod() -> None:
    item = workload()
    active = source_pod("w-a")
    assert kube_objects.active(gate(item, active=active, epoch=1)) == ("w-a", "uid-w-a")
    assert kube_objects.active(gate(item)) == ("", "")
    assert kube_objects.active(None) == ("", "")


def test_the_message_about_unready_standbys_names_the_workload_with_the_details() -> None:
    item = workload()
    waiting = standby_pod("w-s", of=item, ready=False)
    ready = condition(observe(hot(), [waiting], workloads=[item]), "Ready")
    assert ready["reason"] == "PodsNotReady"
    assert_golden("operator", ready["message"], "0 of 1", "BroughtUp", "RobotWorkload w")


class TestQueue:
    def place(self, workload: str, *, priority: int = 0, since: float = NOW - 2, lasts: float = 10) -> Waiter:
        return Waiter(workload=workload, pool="spare", priority=priority, since=since, until=since + lasts)

    def gate(self, place: Waiter) -> Object:
        found = gate(workload(place.workload), epoch=3)
        found["metadata"]["labels"] |= {names.WAITS_FOR: place.pool}
        progress = Progress.begin("it ended", last_healthy=NOW - 3, detected=NOW - 2)
        progress.waiting = place
        found["metadata"]["annotations"][names.RECOVERY] = progress.model_dump_json()
        return found

    def test_the_queue_is_read_from_valid_records_at_the_gates_in_order(self) -> None:
        late = self.place("late", since=NOW - 60)
        places = [self.place("a"), self.place("b", priority=100), self.place("c", since=NOW - 5), late]
        posing = self.gate(self.place("x"))  # each speaks for itself only
        posing["metadata"]["annotations"] = self.gate(self.place("w", priority=1000))["metadata"]["annotations"]
        gates = [*map(self.gate, places), gate(workload("w")), posing]
        assert [w.workload for w in pool_pods.queue("spare", gates, NOW)] == ["b", "c", "a"]
        assert pool_pods.queue("other", gates, NOW) == []

    def test_an_unreadable_record_is_ignored(self) -> None:
        found = self.gate(self.place("a"))
        found["metadata"]["annotations"][names.RECOVERY] = "{"
        assert pool_pods.queue("spare", [found], NOW) == []

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            ("since", "1e300"),
            ("since", "-1e300"),
            ("since", "NaN"),
            ("until", "Infinity"),
            ("until", "1e300"),
            ("priority", "1001"),
            ("priority", "9" * 4000),
        ],
    )
    def test_a_wait_that_no_monitor_records_keeps_no_pool_from_its_status(self, field: str, value: str) -> None:
        found = self.gate(self.place("a"))
        notes = found["metadata"]["annotations"]
        written = json.loads(notes[names.RECOVERY])["waiting"][field]
        assert f'"{field}":{written}' in notes[names.RECOVERY]
        notes[names.RECOVERY] = notes[names.RECOVERY].replace(f'"{field}":{written}', f'"{field}":{value}')
        waiting = pool_pods.queue("spare", [found, self.gate(self.place("b"))], NOW)
        assert [one.workload for one in waiting] == ["b"]
        assert "b (poolPriority 0" in condition(observe(spare(replicas=1), waiting=waiting), "Available")["message"]

    def test_the_condition_lists_the_waiting_workloads_in_order(self) -> None:
        waiting = [self.place("b", priority=100), self.place("a")]
        found = observe(spare(replicas=1), workloads=[workload()], waiting=waiting)
        available = condition(found, "Available")
        assert (available["status"], available["reason"]) == ("False", "Dry")
        assert_golden(
            "operator",
            available["message"],
            "0 of 1",
            "b (poolPriority 100, since 22:13:18",
            "a (poolPriority 0, since 22:13:18",
        )
        assert status(found)["waiting"] == 2

    def test_a_pool_is_dry_if_a_workload_waits_for_its_last_pod(self) -> None:
        pool = spare(replicas=1)
        pod = held_pod("spare-a", of=pool, template_hash=present(pool))
        assert condition(observe(pool, [pod]), "Available")["status"] == "True"
        assert condition(observe(pool, [pod], waiting=[self.place("a")]), "Available")["reason"] == "Dry"

    def test_the_condition_reports_the_reserve(self) -> None:
        pool = spare(replicas=2, reserve={"poolPriority": 100})
        pod = held_pod("spare-a", of=pool, template_hash=present(pool))
        message = condition(observe(pool, [pod]), "Available")["message"]
        assert_golden("operator", message, "1 of 2", "last 1", "poolPriority 100")

    def test_a_pool_of_standbys_has_no_queue(self) -> None:
        found = status(observe(hot(), workloads=[workload()]))
        assert "waiting" not in found
        assert "Available" not in {c["type"] for c in found["conditions"]}

    def test_a_claimed_pod_is_replaced_at_once_if_a_workload_waits(self) -> None:
        pool = spare(replicas=1)
        claimed = claimed_pod("robot-1-claimed", of=pool, by=workload())
        claimed["metadata"].setdefault("annotations", {})[names.CLAIMED_AT] = str(int(NOW - 1))
        assert not created(plan(observe(pool, [claimed])), "pods")
        assert len(created(plan(observe(pool, [claimed], waiting=[self.place("a")])), "pods")) == 1

    def test_the_pool_is_reconciled_when_the_waiting_time_of_a_workload_ends(self) -> None:
        assert plan(observe(spare(replicas=0), waiting=[self.place("a")])).again_after == pytest.approx(8)

    async def test_the_operator_finds_waiting_workloads_at_the_gates_of_the_namespace(self) -> None:
        client: Any = None  # of a pool with a template of its own nothing is asked
        store, now = Store(), time.time()
        pool, waiting = spare(), self.place("a", since=now, lasts=60)
        store.put(POOLS, pool)
        for name in ("a", "b"):
            store.put(WORKLOADS, workload(name))
        store.put(NETWORK_POLICIES, self.gate(waiting))
        store.put(NETWORK_POLICIES, gate(workload("b")))
        observed = await Observer(client, store, Expectations()).pool(pool)
        assert list(observed.waiting) == [waiting]

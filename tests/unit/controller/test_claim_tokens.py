"""A monitor can command the active instance, regardless of the pool that it was claimed from."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import pytest

from tests.unit.controller.pools import observe, plan
from tests.unit.controller.world import (
    IMAGES,
    NAMESPACE,
    World,
    applied,
    claimed_pod,
    created,
    deleted,
    held_pod,
    hot,
    patched,
    policy,
    spare,
    standby_pod,
    workload,
)
from tests.unit.kube.memory import ApplyingClient, ListingClient, MemoryClient
from understudy.api import names
from understudy.controller.desired import monitor_deployment
from understudy.controller.observed import kube_objects, ownership
from understudy.controller.plan import Apply, Plan
from understudy.controller.pods import claim_tokens, pool_pods
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.executor import Executor
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import ObservedChange, Store
from understudy.controller.reconcile.observer import Observer
from understudy.controller.reconcile.reconciler import Reconciler
from understudy.controller.reconcile.rollouts import Rollouts
from understudy.controller.runtime import resync
from understudy.controller.runtime.workers import SOON, Operator
from understudy.kube import apply
from understudy.kube.client import PODS, POOLS, ROLES, SECRETS, WORKLOADS, Client, Object
from understudy.kube.events import Recorder

W, POOL = workload(), spare()
NAME = names.pool_secret("spare")
GONE = "2026-01-01T00:00:00Z"


def secret(*, owner: Object | None = None, labels: Object | None = None) -> Object:
    """The Secret of the pool, as it was made; with an owner, as an earlier version made it."""
    (made,) = created(plan(observe(POOL)), "secrets")
    metadata = {**made["metadata"], "uid": "uid-secret", "resourceVersion": "40"}
    if owner is not None:
        metadata |= {"ownerReferences": [owner], "labels": dict(kube_objects.MANAGED_BY)}
    return {**made, "metadata": metadata | ({"labels": labels} if labels is not None else {})}


def observed(live: Object | None, pool: Object = POOL, *pods: Object) -> pool_pods.Observed:
    found = observe(pool, pods)
    return pool_pods.Observed(**{**vars(found), "secret": live})


def outlast(
    *pods: Object, live: Object | None = None, going: bool = False, workloads: tuple[Object, ...] = (W,)
) -> Plan:
    writes = claim_tokens.outlast(
        "spare",
        NAMESPACE,
        live,
        deleted=going,
        pods=pods,
        workloads={kube_objects.name(item): item for item in workloads},
        token=lambda: "another",
    )
    return Plan(writes=writes)


# -- while there is a pool ----------------------------------------------------------------------------------------------


def test_the_token_of_a_pool_has_no_owner_so_that_it_is_not_deleted_with_one() -> None:
    made = secret()
    assert apply.controller_of(made) is None
    assert "ownerReferences" not in made["metadata"]
    assert resync.listed(SECRETS, made)
    assert kube_objects.labels(made)[names.POOL] == "spare"


def test_an_existing_token_is_not_written_again() -> None:
    found = plan(observed(secret()))
    assert not created(found, "secrets")
    assert not patched(found, "secrets")


@pytest.mark.parametrize("pool", [spare(), spare(template={"spec": {"containers": []}})], ids=["accepted", "refused"])
def test_the_owner_of_a_token_of_an_earlier_version_is_removed(pool: Object) -> None:
    other = {"apiVersion": "v1", "kind": "ConfigMap", "name": "somebody-s", "uid": "u"}
    live = secret(owner=kube_objects.owner("FallbackPool", POOL))
    assert patched(plan(observed(live, pool)), "secrets")[NAME]["metadata"] == {
        "labels": {names.POOL: "spare"},
        "ownerReferences": None,
    }
    live["metadata"]["ownerReferences"].append(other)
    assert patched(plan(observed(live, pool)), "secrets")[NAME]["metadata"]["ownerReferences"] == [other]


def test_a_recreated_pool_uses_the_token_of_its_predecessor() -> None:
    # Those that were claimed from that one have it, and would be refused with another.
    before = kube_objects.owner("FallbackPool", {**POOL, "metadata": {**POOL["metadata"], "uid": "uid-before"}})
    assert not created(plan(observed(secret())), "secrets")
    assert not created(plan(observed(secret(owner=before))), "secrets")
    assert patched(plan(observed(secret(owner=before))), "secrets")


def test_the_token_of_a_workload_is_not_treated_as_the_token_of_a_pool() -> None:
    """Those of a workload spare-pool and of a pool spare have one name."""
    theirs = workload("spare-pool")
    live = secret(owner=kube_objects.owner("RobotWorkload", theirs))
    assert not patched(plan(observed(live)), "secrets")
    assert not deleted(outlast(live=live))


async def test_a_foreign_secret_with_the_name_of_the_token_is_not_changed() -> None:
    client = MemoryClient()
    (made,) = created(plan(observe(POOL)), "secrets")
    await client.create(SECRETS, NAMESPACE, {"kind": "Secret", "metadata": {"name": NAME}})
    with pytest.raises(
        apply.OwnedByOther, match=f'Secret "{NAME}" exists in namespace fleet and belongs to nobody of ours'
    ):
        await apply.create(client, SECRETS, NAMESPACE, made)


async def test_a_token_of_an_earlier_attempt_is_used() -> None:
    client = MemoryClient()
    (made,) = created(plan(observe(POOL)), "secrets")
    first = await apply.create(client, SECRETS, NAMESPACE, made)
    assert await apply.create(client, SECRETS, NAMESPACE, made) == first


# -- when the pool is gone ----------------------------------------------------------------------------------------------


def test_the_token_is_kept_as_long_as_a_workload_has_a_pod_of_the_deleted_pool() -> None:
    assert not outlast(claimed_pod("spare-1", of=POOL, by=W), live=secret()).writes
    leaving = claimed_pod("spare-1", of=POOL, by=W, deletionTimestamp=GONE)
    assert not outlast(leaving, live=secret()).writes, "it may be commanded to the end"
    assert deleted(outlast(live=secret())) == [NAME]


def test_the_token_is_kept_for_the_pod_of_a_workload_that_is_not_yet_known() -> None:
    assert not outlast(claimed_pod("spare-1", of=POOL, by=W), live=secret(), workloads=()).writes


def test_the_token_is_deleted_if_the_pods_and_the_workloads_are_deleted_too() -> None:
    """Whoever takes away everything takes the operator away next: nothing would be left to wait for the pods to end."""
    leaving = [
        claimed_pod("spare-1", of=POOL, by=W, deletionTimestamp=GONE),
        held_pod("spare-2", of=POOL, deletionTimestamp=GONE),
    ]
    assert deleted(outlast(*leaving, live=secret(), workloads=())) == [NAME]


def test_the_token_is_kept_for_an_unclaimed_pod_because_it_may_be_claimed_already() -> None:
    assert not outlast(held_pod("spare-1", of=POOL), live=secret()).writes


@pytest.mark.parametrize(
    "pod",
    [
        held_pod("spare-1", of=POOL, phase="Failed"),
        claimed_pod("spare-1", of=POOL, by=W, phase="Failed"),
        standby_pod("spare-1", of=W, pool="spare"),
    ],
    ids=["unclaimed, ended", "claimed, ended", "standby of an earlier pool with that name"],
)
def test_the_token_is_deleted_if_no_running_pod_uses_it(pod: Object) -> None:
    assert deleted(outlast(pod, live=secret())) == [NAME]
    assert not outlast(pod).writes


def test_a_missing_token_is_created_again_for_a_claimed_pod() -> None:
    (made,) = created(outlast(claimed_pod("spare-1", of=POOL, by=W)), "secrets")
    assert made["metadata"]["name"] == NAME
    assert made["metadata"]["namespace"] == NAMESPACE
    assert "ownerReferences" not in made["metadata"]


def test_the_token_of_a_pool_in_deletion_is_kept_without_an_owner() -> None:
    assert not outlast(live=secret(), going=True).writes
    assert patched(outlast(live=secret(owner=kube_objects.owner("FallbackPool", POOL)), going=True), "secrets")


# -- who looks when -----------------------------------------------------------------------------------------------------


def test_a_created_or_deleted_token_reconciles_its_pool() -> None:
    for change in (ObservedChange(SECRETS, secret(), None), ObservedChange(SECRETS, None, secret())):
        assert change_index.of(change, Store()).keys == {Key(POOLS.plural, NAMESPACE, "spare")}


@pytest.mark.parametrize(
    ("resource", "left"),
    [(SECRETS, secret()), (PODS, claimed_pod("spare-1", of=POOL, by=W))],
    ids=["unneeded token", "claimed pod without a token"],
)
async def test_a_new_operator_reconciles_what_a_deleted_pool_left_behind(resource: Any, left: Object) -> None:
    store, reconciled = Store(), Reconciled()
    client = ListingClient({WORKLOADS: [W], resource: [left]})
    operator = Operator(client, store, cast(Reconciler, reconciled), namespaces=(), resync_every=0.02)
    key = Key(POOLS.plural, NAMESPACE, "spare")
    work = [asyncio.create_task(operator.lead()), asyncio.create_task(operator.keep_listing())]
    try:
        async with asyncio.timeout(60):
            while reconciled.keys.count(key) < 2:
                await asyncio.sleep(0.01)
            client.items[POOLS] = [POOL]
            while store.get(POOLS, NAMESPACE, "spare") is None:
                await asyncio.sleep(0.01)
            await asyncio.sleep(3 * SOON)  # that it is there now is looked at too
            count, lists = reconciled.keys.count(key), client.lists
            await asyncio.sleep(3 * SOON)
        assert client.lists > lists
        assert reconciled.keys.count(key) == count
    finally:
        for task in work:
            task.cancel()
        await asyncio.gather(*work, return_exceptions=True)
        operator.queue.close()


class Reconciled:
    """Notes what is to be looked at."""

    trees = None

    def __init__(self) -> None:
        self.keys: list[Key] = []

    async def reconcile(self, key: Key) -> None:
        self.keys.append(key)


# -- the right to read it -----------------------------------------------------------------------------------------------


def commanded(world: World) -> frozenset[str]:
    (role,) = applied(world.plan(), "roles").values()
    return monitor_deployment.commanded(role)


def protected() -> World:
    """A workload whose monitor may command the agents of the pool."""
    world = World(workload(), policy("spare", "Restart"), spare())
    world.build()
    assert commanded(world) == {"spare"}
    return world


@pytest.mark.parametrize(
    "others", [[policy("spare", "Restart")], [policy("Restart")]], ids=["pool deleted", "pool deleted and not named"]
)
def test_a_monitor_may_command_a_pod_of_a_deleted_pool_until_the_pod_is_gone(others: list[Object]) -> None:
    world = protected()
    world.others = others
    world.pods = [claimed_pod("spare-1", of=POOL, by=W)]
    assert commanded(world) == {"spare"}
    world.pods = []
    assert commanded(world) == frozenset()


def test_a_monitor_may_command_a_pod_of_a_pool_that_its_policy_no_longer_names() -> None:
    world = protected()
    world.others = [policy("Restart"), spare()]
    assert commanded(world) == frozenset()
    world.pods = [claimed_pod("spare-1", of=POOL, by=W)]
    assert commanded(world) == {"spare"}


def test_a_right_that_was_removed_before_a_claim_was_observed_is_granted_again() -> None:
    world = World(workload(), policy("Restart"), spare())
    world.build()
    assert commanded(world) == frozenset()
    world.pods = [claimed_pod("spare-1", of=POOL, by=W)]
    assert commanded(world) == {"spare"}


def test_a_claim_does_not_change_the_rights_of_the_monitor() -> None:
    world = protected()
    (before,) = applied(world.plan(), "roles").values()
    world.pods = [claimed_pod("spare-1", of=POOL, by=W)]
    assert list(applied(world.plan(), "roles").values()) == [before]
    assert not patched(world.plan(), "secrets")
    assert not created(world.plan(), "secrets")


def test_annotations_of_a_monitor_on_a_pod_grant_no_rights() -> None:
    world = protected()
    foreign = spare("others", workloadSelector={"matchLabels": {"task": "another"}})
    for there in ([foreign], []):
        world.others = [policy("spare", "Restart"), spare(), *there]
        world.pods = [claimed_pod("others-1", of=foreign, by=W)]
        assert commanded(world) == {"spare"}


async def test_a_monitor_keeps_the_right_to_command_a_pod_that_it_may_have_claimed() -> None:
    store = Store()
    (role,) = applied(World(workload(), policy("spare"), spare()).plan(), "roles").values()
    role["metadata"] |= {"uid": "uid-role", "resourceVersion": "41"}
    for resource, item in ((WORKLOADS, W), (ROLES, role), (PODS, held_pod("spare-1", of=POOL))):
        store.put(resource, item)
    observer = Observer(cast(Client, None), store, Expectations())
    found = await observer.workload(W)
    assert found.going == {"spare"}
    world = protected()
    world.others = [policy("Restart")]
    assert commanded(world) == frozenset()
    world.going = found.going
    assert commanded(world) == {"spare"}
    store.put(PODS, held_pod("spare-1", of=POOL, deletionTimestamp=GONE, resourceVersion="50"))
    assert not (await observer.workload(W)).going, "it will not be claimed any more"
    store.put(PODS, held_pod("spare-1", of=POOL, resourceVersion="60"))
    store.put(POOLS, POOL)
    assert not (await observer.workload(W)).going, "there it is the strategies that say it"


def test_the_pools_of_a_role_are_those_whose_tokens_it_names() -> None:
    (role,) = applied(World(workload(), policy("spare", "hot"), hot(), spare()).plan(), "roles").values()
    assert monitor_deployment.commanded(role) == {"spare"}
    assert monitor_deployment.commanded(None) == frozenset()
    assert ownership.controls(kube_objects.uid(W), role)


class Reading:
    """Answers what is there, and how often it was asked."""

    def __init__(self, live: Object | None) -> None:
        self.live, self.asked = live, 0

    async def find(self, *_: Any) -> Object | None:
        self.asked += 1
        return self.live


@pytest.mark.parametrize("there", [False, True])
async def test_the_operator_checks_once_whether_the_token_of_a_recreated_pool_exists(there: bool) -> None:
    # The operator deletes it with the last pod of the pool before, or it goes with their namespace: only a list shows that.
    store, before = Store(), secret()
    before["metadata"]["creationTimestamp"] = "2026-01-01T00:00:00Z"
    recreated = {
        **POOL,
        "metadata": {**POOL["metadata"], "uid": "uid-of-the-next-pool", "creationTimestamp": "2026-01-01T00:01:00Z"},
    }
    store.put(SECRETS, before)
    store.put(POOLS, recreated)
    reading = Reading(before if there else None)
    observer = Observer(cast(Client, reading), store, Expectations())
    for _ in range(2):
        found = await observer.pool(recreated)
        assert bool(found.secret) == there
        assert bool(created(plan(found), "secrets")) != there
    assert reading.asked == 1


async def test_the_operator_does_not_check_a_token_that_was_created_with_its_pool() -> None:
    store, made, stamp = Store(), secret(), "2026-01-01T00:00:00Z"
    made["metadata"]["creationTimestamp"] = stamp
    store.put(SECRETS, made)
    reading = Reading(None)
    item = {**POOL, "metadata": {**POOL["metadata"], "creationTimestamp": stamp}}
    found = await Observer(cast(Client, reading), store, Expectations()).pool(item)
    assert found.secret is not None
    assert not reading.asked


async def test_a_deleted_pool_is_forgotten_once_and_not_at_each_change_of_its_pods() -> None:
    # Their names begin alike: the operator would find out about them again, with a write, and never report a conflict with somebody else.
    store, client = Store(), ApplyingClient()
    working = Executor(client, store, Expectations(), may_write=lambda: True)
    reconciler = Reconciler(
        client, store, Observer(client, store, Expectations()), working, cast(Recorder, None), IMAGES, Rollouts(store)
    )
    role = {"apiVersion": "v1", "kind": "Role", "metadata": {"name": "spare-robot-monitor", "namespace": NAMESPACE}}
    pod = claimed_pod("spare-1", of=POOL, by=W)
    store.put(WORKLOADS, W)
    store.put(PODS, pod)
    for is_known in (True, False):
        await working.run(Key(WORKLOADS.plural, NAMESPACE, "spare-robot"), [Apply(ROLES, role)])
        await reconciler.reconcile(Key(POOLS.plural, NAMESPACE, "spare"))
        assert (("roles", NAMESPACE, "spare-robot-monitor") in working.remembered) == is_known
        store.remove(PODS, pod)
        store.remove(SECRETS, store.get(SECRETS, NAMESPACE, NAME) or secret())


def test_the_pool_of_a_claimed_pod_without_its_label_is_known_by_its_secret() -> None:
    """Otherwise its monitor would lose the right to command it, until the label is restored."""
    pod = claimed_pod("spare-1", of=POOL, by=W)
    pod["spec"] = {"volumes": [{"name": names.TOKEN_VOLUME, "secret": {"secretName": NAME}}]}
    del pod["metadata"]["labels"][names.POOL]
    assert claim_tokens.pools_of([pod]) == {"spare"}

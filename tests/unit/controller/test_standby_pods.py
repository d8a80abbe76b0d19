"""The standbys of a workload's own: how many, of which template, and which are never touched."""

from __future__ import annotations

import copy

import pytest

from tests.unit.controller.world import (
    World,
    applied,
    claimed_pod,
    created,
    deleted,
    gate,
    hot,
    patched,
    policy,
    source_pod,
    spare,
    standby_pod,
    workload,
)
from understudy.api import names
from understudy.controller.desired import workload_objects
from understudy.controller.observed.workload_reference import ReferencedObjects
from understudy.failover.progress import Progress
from understudy.kube.client import Object


class TestStandbys:
    def test_each_workload_has_the_standbys_that_the_pool_specifies(self) -> None:
        assert len(created(World(workload(), policy("hot"), hot(per_workload=3)).plan(), "pods")) == 3

    def test_a_workload_that_the_pool_does_not_select_has_no_standby(self) -> None:
        world = World(workload(labels={"task": "other"}), policy("hot"), hot())
        assert not created(world.plan(), "pods")

    def test_created_pods_that_are_not_yet_observed_count(self) -> None:
        world = World(workload(), policy("hot"), hot(per_workload=2))
        world.expected = {"hot": 2}
        assert not created(world.plan(), "pods")

    def test_no_standby_is_created_for_one_whose_label_is_being_restored(self) -> None:
        world = World(workload(), policy("hot"), hot())
        standby = standby_pod("w-s", of=world.workload, template_hash=world.template_hash)
        del standby["metadata"]["labels"][names.POOL]
        world.pods = [standby, source_pod("w-a", template_hash=world.own_hash)]
        plan = world.plan()
        assert patched(plan, "pods")["w-s"]["metadata"]["labels"][names.POOL] == "hot"
        assert not created(plan, "pods")

    @pytest.mark.parametrize("which", ["of an old template", "the newest", "of a pool that no longer serves"])
    def test_no_instance_is_deleted_while_the_gate_that_names_the_active_one_is_missing(self, which: str) -> None:
        labels = {"task": "other"} if which == "of a pool that no longer serves" else None
        status = {"gate": {"epoch": 2, "active": "w-s"}}
        world = World(workload(labels=labels, status=status), policy("hot"), hot())
        world.build()
        present = "" if labels else world.template_hash
        template = "old" if which == "of an old template" else present
        active = standby_pod("w-s", of=world.workload, age=50, template_hash=template)
        others = [] if labels else [standby_pod("w-t", of=world.workload, template_hash=present, age=300)]
        world.pods = [active, *others, source_pod("w-a", template_hash=world.own_hash, ready=False)]
        world.own(gate(world.workload, active=active, epoch=2))
        assert not deleted(world.plan())
        del world.owned["networkpolicies", "w-gate"]
        plan = world.plan()
        assert [body["metadata"]["name"] for body in created(plan, "networkpolicies")] == ["w-gate"]
        assert not deleted(plan)

    def test_an_active_standby_counts_so_that_no_further_one_is_created(self) -> None:
        world = World(workload(), policy("hot"), hot())
        active = standby_pod("w-s", of=world.workload)
        world.pods = [active, source_pod("w-a", template_hash=world.own_hash)]
        world.own(gate(world.workload, active=active, epoch=2))
        plan = world.plan()
        assert not created(plan, "pods")
        assert not deleted(plan)

    def test_the_active_instance_is_not_replaced_for_an_old_template(self) -> None:
        world = World(workload(), policy("hot"), hot())
        active = standby_pod("w-s", of=world.workload, template_hash="old")
        world.pods = [active]
        world.own(gate(world.workload, active=active, epoch=2))
        assert not deleted(world.plan())

    def test_ended_standbys_do_not_accumulate_during_a_long_recovery(self) -> None:
        # Evicted ones, of a robot that was switched off: for each that has ended there is another.
        world = World(workload(), policy("hot"), hot())
        ended = [standby_pod(f"w-{n}", of=world.workload, phase="Failed", age=1000.0 - n) for n in range(5)]
        waiting = standby_pod("w-s", of=world.workload, template_hash="old")
        world.pods = [*ended, waiting]
        world.own(gate(world.workload, epoch=2))
        plan = world.plan()
        assert deleted(plan) == ["w-0", "w-1", "w-2", "w-3"]
        assert len(created(plan, "pods")) == 1

    def test_a_standby_of_an_old_template_is_deleted_after_its_replacement_is_ready(self) -> None:
        world = World(workload(), policy("hot"), hot())
        active, old = source_pod("w-a"), standby_pod("w-old", of=world.workload, template_hash="old")
        world.own(gate(world.workload, active=active, epoch=1))
        world.pods = [active, old]
        plan = world.plan()
        assert len(created(plan, "pods")) == 1
        assert not deleted(plan)
        new = standby_pod("w-new", of=world.workload, template_hash=world.template_hash, ready=False)
        world.pods = [active, old, new]
        assert not deleted(world.plan())
        world.pods[-1] = standby_pod("w-new", of=world.workload, template_hash=world.template_hash)
        assert deleted(world.plan()) == ["w-old"]

    def test_an_own_pod_of_an_old_template_is_deleted_after_another_standby_is_ready(self) -> None:
        world = World(workload(), policy("hot"), hot())
        world.build()
        world.build()
        active = standby_pod("w-s", of=world.workload, template_hash="old")
        old = source_pod("w-old", template_hash="old")
        world.own(gate(world.workload, active=active, epoch=2))
        world.pods = [active, old]

        def now(*more: Object) -> tuple[int, list[str]]:
            world.pods = [active, *more]
            plan = world.plan()
            return len(created(plan, "pods")), deleted(plan)

        other = standby_pod("w-t", of=world.workload, template_hash=world.template_hash)
        starting = standby_pod("w-t", of=world.workload, template_hash=world.template_hash, ready=False)
        own = world.own_hash
        assert now(old) == (1, [])
        assert now(old, starting) == (0, [])
        assert now(old, other) == (0, ["w-old"])
        assert now(other) == (0, []), "the workload's own controller makes the next one"
        assert now(other, source_pod("w-new", template_hash=own, ready=False)) == (0, [])
        assert now(other, source_pod("w-new", template_hash=own)) == (0, ["w-t"])
        assert now(source_pod("w-new", template_hash=own)) == (0, [])

    def test_an_own_pod_stays_in_a_recovery_and_if_the_controller_has_another_template(
        self,
    ) -> None:
        world = World(workload(), policy("hot"), hot())
        world.build()
        world.build()
        active, old = standby_pod("w-s", of=world.workload), source_pod("w-old", template_hash="old")
        world.own(gate(world.workload, active=active, epoch=2))
        world.pods = [active, old, standby_pod("w-t", of=world.workload, template_hash=world.template_hash)]
        assert deleted(world.plan()) == ["w-old"]
        live = world.owned[("replicasets", "w")]
        labels = live["spec"]["template"]["metadata"]["labels"]
        world.owned[("replicasets", "w")] = copy.deepcopy(live)
        world.owned[("replicasets", "w")]["spec"]["template"]["metadata"]["labels"] = labels | {
            names.TEMPLATE_HASH: "x"
        }
        assert not deleted(world.plan())
        world.owned[("replicasets", "w")] = live
        world.workload["status"] = {"health": "Recovering"}
        assert not deleted(world.plan())

    @pytest.mark.parametrize("driving", ["of a shared pool", "of a pool without standbys"])
    def test_an_own_pod_of_no_pool_is_deleted_once_when_all_standbys_are_ready(self, driving: str) -> None:
        pools = [hot("a-none", per_workload=0), hot(), hot("later"), spare()]
        world = World(workload(), policy("hot", "later", "spare"), *pools)
        world.build()
        world.build()
        if driving == "of a shared pool":
            active = claimed_pod("spare-1", of=spare(), by=world.workload)
        else:
            active = standby_pod("w-s", of=world.workload, pool="a-none")
        world.own(gate(world.workload, active=active, epoch=2))
        hashes = {
            name: built["metadata"]["labels"][names.TEMPLATE_HASH] for name, built in world.understood().builts.items()
        }

        def now(own: Object, *, ready: bool = True, template_hash: str = hashes["hot"]) -> tuple[int, list[str]]:
            world.pods = [
                active,
                own,
                standby_pod("w-t", of=world.workload, template_hash=template_hash, ready=ready),
                standby_pod("w-u", of=world.workload, pool="later", template_hash=hashes["later"]),
            ]
            plan = world.plan()
            return len(created(plan, "pods")), deleted(plan)

        old = source_pod("w-old", template_hash="old")
        assert now(old, template_hash="old") == (1, []), "the standby's own turn comes first"
        assert now(old, ready=False) == (0, [])
        assert now(old) == (0, ["w-old"])
        for ready in (False, True):
            assert now(source_pod("w-new", template_hash=world.own_hash, ready=ready)) == (0, [])

    def test_no_standby_is_deleted_during_a_recovery(self) -> None:
        world = World(workload(status={"health": "Recovering"}), policy("hot"), hot())
        world.own(gate(world.workload, active=source_pod("w-a"), epoch=1))
        old = standby_pod("w-old", of=world.workload, template_hash="old")
        new = standby_pod("w-new", of=world.workload, template_hash=world.template_hash)
        world.pods = [old, new]
        assert not deleted(world.plan())

    def test_no_standby_is_deleted_while_the_gate_shows_a_recent_recovery(self) -> None:
        world = World(workload(), policy("hot"), hot())
        observed_gate = gate(world.workload, active=source_pod("w-a"), epoch=1)
        progress = Progress.begin("crashed", last_healthy=world.now - 1, detected=world.now - 0.5)
        observed_gate["metadata"]["annotations"][names.RECOVERY] = progress.model_dump_json()
        world.own(observed_gate)
        old = standby_pod("w-old", of=world.workload, template_hash="old")
        new = standby_pod("w-new", of=world.workload, template_hash=world.template_hash)
        world.pods = [old, new]
        plan = world.plan()
        assert not deleted(plan)
        assert plan.again_after is not None
        world.now += plan.again_after
        assert deleted(world.plan()) == ["w-old"]

    @pytest.mark.parametrize(
        ("phase", "goes"),
        [("Preparing", False), ("Switching", False), ("asked for", False), ("Waiting", True), ("Done", True)],
    )
    @pytest.mark.parametrize(
        "which", ["of an old template", "standing in", "too many", "of a pool that no longer serves the workload"]
    )
    def test_a_standby_that_a_planned_switchover_may_use_is_not_deleted(
        self, which: str, phase: str, goes: bool
    ) -> None:
        status = {"kind": "Failover", "phase": "Done" if phase == "asked for" else phase, "handled": "failover 1"}
        world = World(workload(status={"switchover": status}), policy("hot"), hot())
        asked = "failover 2" if phase == "asked for" else "failover 1"
        world.workload["metadata"]["annotations"] = {names.SWITCHOVER: asked}
        world.build()
        world.build()
        own, other = world.own_hash, standby_pod("w-t", of=world.workload, template_hash=world.template_hash)
        active = source_pod("w-a", template_hash=own)
        if which == "standing in":  # a failback goes to it
            active, used = standby_pod("w-s", of=world.workload), source_pod("w-a", template_hash="old")
        elif which == "too many":
            used = standby_pod("w-u", of=world.workload, template_hash=world.template_hash, ready=False)
        else:
            used = standby_pod("w-u", of=world.workload, template_hash="old")
        if which == "of a pool that no longer serves the workload":
            world.others = [policy("hot"), hot(workloadSelector={"matchLabels": {"task": "other"}})]
            other = used
        world.own(gate(world.workload, active=active, epoch=2))
        world.pods = [active, *{id(pod): pod for pod in (other, used)}.values()]
        plan = world.plan()
        assert (created(plan, "pods"), deleted(plan)) == ([], [used["metadata"]["name"]] if goes else [])

    def test_the_former_instance_of_a_planned_switchover_stays_until_its_end(self) -> None:
        # Its monitor gives the gate back to it where that isn't so.
        world = World(workload(), policy("hot"), hot())
        world.leaving = frozenset({"n"})
        former = standby_pod("w-s", of=world.workload, template_hash=world.template_hash) | {"spec": {"nodeName": "n"}}
        active = standby_pod("w-t", of=world.workload, template_hash=world.template_hash)
        switched = gate(world.workload, active=active, epoch=2)
        progress = Progress.begin("drained", last_healthy=world.now, detected=world.now)
        progress.switchover = "Drain"
        world.own(switched)
        world.pods = [former, active, source_pod("w-a", template_hash=world.own_hash)]
        for result, gone in (("Running", []), ("Recovered", ["w-s"])):
            progress.result = result  # type: ignore[assignment]
            switched["metadata"]["annotations"][names.RECOVERY] = progress.model_dump_json()
            assert deleted(world.plan()) == gone

    def test_standbys_of_a_pool_that_no_longer_serves_are_deleted_except_the_active_one(self) -> None:
        world = World(workload(labels={"task": "other"}), policy("hot"), hot())
        active, idle = standby_pod("w-s", of=world.workload), standby_pod("w-t", of=world.workload)
        world.pods = [active, idle]
        world.own(gate(world.workload, active=active, epoch=2))
        assert deleted(world.plan()) == ["w-t"]

    def test_claimed_pods_are_not_changed(self) -> None:
        world = World(workload(), policy("hot", "spare"), hot(), spare())
        claimed = claimed_pod("spare-1", of=spare(), by=world.workload)
        world.pods = [claimed]
        world.own(gate(world.workload, active=source_pod("w-a"), epoch=2))
        plan = world.plan()
        assert not deleted(plan)
        assert "spare-1" not in patched(plan, "pods")

    def test_the_labels_of_standbys_do_not_match_the_replica_set(self) -> None:
        world = World(workload(), policy("hot"), hot())
        plan = world.plan()
        (standby,) = created(plan, "pods")
        selector = applied(plan, "replicasets")["w"]["spec"]["selector"]["matchLabels"]
        assert not selector.items() <= standby["metadata"]["labels"].items()
        assert standby["metadata"]["labels"][names.INSTANCE] == standby["metadata"]["name"]
        template = applied(plan, "replicasets")["w"]["spec"]["template"]["metadata"]["labels"]
        assert selector.items() <= template.items()


class TestNewTemplates:
    def world(self) -> World:
        world = World(workload(), policy("hot", "Restart"), hot())
        world.build()
        active = source_pod("w-a")
        world.own(gate(world.workload, active=active, epoch=1))
        world.pods = [active, standby_pod("w-s", of=world.workload, template_hash=world.template_hash)]
        world.workload["spec"]["template"]["spec"]["containers"][0]["image"] = "app:2"
        return world

    def test_a_new_template_is_first_tried_with_a_standby(self) -> None:
        world = self.world()
        assert not applied(world.plan(), "replicasets")
        assert world.condition("Reconciled")["reason"] == "InProgress"
        bad = standby_pod(
            "w-n", of=world.workload, template_hash=world.template_hash, ready=False, waiting="ErrImagePull"
        )
        world.pods.append(bad)
        assert not applied(world.plan(), "replicasets")
        reconciled = world.condition("Reconciled")
        assert reconciled["reason"] == "ImagePullBackOff"
        assert "w-n" in reconciled["message"]
        world.pods[-1] = standby_pod("w-n", of=world.workload, template_hash=world.template_hash)
        assert applied(world.plan(), "replicasets")
        assert world.condition("Reconciled")["status"] == "True"

    def test_a_new_template_is_applied_at_once_without_standbys(self) -> None:
        world = self.world()
        world.others = [policy("Restart")]
        assert applied(world.plan(), "replicasets")

    def test_a_new_template_is_applied_at_once_while_a_standby_is_active(self) -> None:
        world = self.world()
        world.own(gate(world.workload, active=world.pods[1], epoch=2))
        assert applied(world.plan(), "replicasets")


class TestReplicas:
    def test_the_template_is_applied_without_replicas(self) -> None:
        assert "replicas" not in applied(World(workload(), policy("Restart")).plan(), "replicasets")["w"]["spec"]

    def scaled(self, world: World) -> Object | None:
        return patched(world.plan(), "replicasets").get("w")

    def world(self, *others: Object, replicas: int, active: Object | None) -> World:
        world = World(workload(), *others)
        world.build()
        world.owned[("replicasets", "w")]["spec"]["replicas"] = replicas
        world.own(gate(world.workload, active=active, epoch=3))
        world.pods = [active] if active else []
        return world

    def test_the_replica_count_is_zero_while_a_claimed_pod_drives_and_no_standby_is_wanted(self) -> None:
        claimed = claimed_pod("spare-1", of=spare(), by=workload())
        world = self.world(policy("spare"), spare(), replicas=1, active=claimed)
        assert self.scaled(world) == {"spec": {"replicas": 0}}

    def test_the_replica_count_is_one_while_a_claimed_pod_drives_and_a_standby_is_wanted(self) -> None:
        claimed = claimed_pod("spare-1", of=spare(), by=workload())
        world = self.world(policy("hot", "spare"), hot(), spare(), replicas=0, active=claimed)
        assert self.scaled(world) == {"spec": {"replicas": 1}}

    def test_the_replica_count_is_one_when_the_claimed_pod_is_deleted(self) -> None:
        claimed = claimed_pod("spare-1", of=spare(), by=workload(), deletionTimestamp="2026-01-01T00:00:00Z")
        world = self.world(policy("spare"), spare(), replicas=0, active=claimed)
        assert self.scaled(world) == {"spec": {"replicas": 1}}

    @pytest.mark.parametrize("replicas", [0, 1])
    def test_the_replica_count_is_unchanged_while_the_gate_is_closed(self, replicas: int) -> None:
        assert self.scaled(self.world(policy("spare"), spare(), replicas=replicas, active=None)) is None


class TestLabels:
    """Ownership is known by the owner and its UID. The gate's policies select by labels, so these are restored."""

    @pytest.mark.parametrize("removed", [names.WORKLOAD, names.POOL, names.INSTANCE, names.COMPONENT])
    def test_a_label_that_somebody_removes_from_a_standby_is_restored(self, removed: str) -> None:
        world = World(workload(), policy("hot"), hot())
        standby = standby_pod("w-s", of=world.workload, template_hash=world.template_hash)
        standby["metadata"]["labels"] |= {names.COMPONENT: "instance", names.INSTANCE: "w-s"}
        before = dict(standby["metadata"]["labels"])
        world.pods = [source_pod("w-a"), standby]
        assert "w-s" not in patched(world.plan(), "pods")
        del standby["metadata"]["labels"][removed]
        labels = patched(world.plan(), "pods")["w-s"]["metadata"]["labels"]
        assert before.items() <= (standby["metadata"]["labels"] | labels).items()

    def test_a_standby_with_the_label_of_the_active_instance_gets_its_own_back(self) -> None:
        world = World(workload(), policy("hot"), hot())
        standby = standby_pod("w-s", of=world.workload)
        standby["metadata"]["labels"] |= {names.INSTANCE: "w-a"}
        world.pods = [source_pod("w-a"), standby]
        assert patched(world.plan(), "pods")["w-s"]["metadata"]["labels"][names.INSTANCE] == "w-s"

    def test_no_label_is_removed_from_a_standby_of_a_workload_with_a_reference(self) -> None:
        item = workload(workloadRef={"kind": "Deployment", "name": "nav2"})
        world = World(item, policy("hot"), hot(), reference=ReferencedObjects(None, []))
        standby = standby_pod("w-s", of=world.workload)
        del standby["metadata"]["labels"][names.POOL]
        world.pods = [standby]
        for plan in (world.plan(), workload_objects.abandoned("w", [standby])):
            labels = patched(plan, "pods").get("w-s", {}).get("metadata", {}).get("labels", {})
            assert None not in labels.values()

    def test_a_pod_that_its_replica_set_released_gets_the_labels_by_which_it_is_adopted_again(self) -> None:
        world = World(workload(), policy("Restart"))
        released = source_pod("w-a")
        released["metadata"] |= {"labels": {}, "ownerReferences": []}
        released["spec"] = world.understood().builts[""]["spec"]
        world.pods = [released]
        labels = patched(world.plan(), "pods")["w-a"]["metadata"]["labels"]
        selector = applied(world.plan(), "replicasets")["w"]["spec"]["selector"]["matchLabels"]
        assert selector.items() <= labels.items()
        assert labels[names.INSTANCE] == "w-a"

    def test_a_standby_whose_owner_somebody_removed_gets_it_back(self) -> None:
        world = World(workload(), policy("hot"), hot())
        standby = standby_pod("w-s", of=world.workload, template_hash=world.template_hash)
        owners = standby["metadata"].pop("ownerReferences")
        standby["spec"] = world.understood().builts["hot"]["spec"]
        world.pods = [source_pod("w-a"), standby]
        assert patched(world.plan(), "pods")["w-s"] == {"metadata": {"ownerReferences": owners}}

"""Shared pools: never too many, never a claimed one, never without what could still be claimed."""

from __future__ import annotations

import json

import pytest

from tests.unit.controller.pools import condition, observe, plan, present, status
from tests.unit.controller.world import (
    NOW,
    TEMPLATE,
    applied,
    claimed_pod,
    created,
    deleted,
    held_pod,
    spare,
    workload,
)
from understudy.api import names
from understudy.controller.observed import kube_objects, ownership
from understudy.controller.plan import Plan
from understudy.controller.pods import pool_pods
from understudy.controller.pods.pod_counts import EXPECTED_SECONDS
from understudy.kube import claims
from understudy.kube.client import Object


def test_an_empty_pool_is_filled() -> None:
    pool = spare(replicas=2)
    made = created(plan(observe(pool)), "pods")
    assert len(made) == 2
    for pod in made:
        labels = pod["metadata"]["labels"]
        assert labels[names.HELD] == "true"
        assert labels[names.WORKLOAD] == names.UNCLAIMED
        assert labels[names.PART] == claims.part(pod["metadata"]["name"])
        assert ownership.controls(kube_objects.uid(pool), pod)


def test_created_pods_that_are_not_yet_observed_count() -> None:
    assert len(created(plan(observe(spare(replicas=3), expected=2)), "pods")) == 1


def test_the_pool_is_reconciled_when_an_expectation_expires() -> None:
    # Of a request that got no answer nothing may ever tell: no watch does where nothing was made.
    made = plan(observe(spare(replicas=1), expected=1))
    assert not created(made, "pods")
    assert made.again_after == EXPECTED_SECONDS


@pytest.mark.parametrize("extra", [0, 1, 5])
def test_no_pod_is_created_while_enough_or_too_many_are_observed(extra: int) -> None:
    pool = spare(replicas=2)
    pods = [held_pod(f"spare-{i}", of=pool, template_hash=present(pool)) for i in range(2 + extra)]
    assert not created(plan(observe(pool, pods)), "pods")


def test_claimed_pods_do_not_count_and_are_not_deleted() -> None:
    pool = spare(replicas=1)
    claimed = [claimed_pod(f"spare-c{i}", of=pool, by=workload()) for i in range(3)]
    made = plan(observe(pool, claimed))
    assert len(created(made, "pods")) == 1
    assert not deleted(made)


@pytest.mark.parametrize(("ago", "drives", "made"), [(1, False, 0), (1, True, 1), (-3600, False, 0), (10, False, 1)])
def test_a_claimed_pod_is_replaced_after_it_drives_or_after_a_waiting_time(ago: float, drives: bool, made: int) -> None:
    pool = spare(replicas=1)
    claimed = claimed_pod("robot-1-claimed", of=pool, by=workload())
    claimed["metadata"].setdefault("annotations", {})[names.CLAIMED_AT] = str(int(NOW - ago))
    active = frozenset({kube_objects.uid(claimed)}) if drives else frozenset()
    found = plan(observe(pool, [claimed], active=active))
    assert len(created(found, "pods")) == made
    if not made:
        assert found.again_after is not None
        assert 0 < found.again_after <= pool_pods.FIRST_THE_CLAIMED


@pytest.mark.parametrize("time", ["²", "9" * 5000, "soon"], ids=["digit", "long", "word"])
def test_a_pod_whose_claim_has_no_time_is_replaced_at_once(time: str) -> None:
    pool = spare(replicas=1)
    claimed = claimed_pod("robot-1-claimed", of=pool, by=workload())
    claimed["metadata"].setdefault("annotations", {})[names.CLAIMED_AT] = time
    assert len(created(plan(observe(pool, [claimed])), "pods")) == 1


def claimed_ago(pool: Object, name: str, ago: float) -> Object:
    claimed = claimed_pod(name, of=pool, by=workload())
    claimed["metadata"].setdefault("annotations", {})[names.CLAIMED_AT] = str(int(NOW - ago))
    return claimed


def test_a_pool_is_filled_up_although_claims_continue() -> None:
    """A claim holds back the pod in its own place, and no other: or a pool would be filled only when it is dry."""
    pool = spare(replicas=4)
    left = held_pod("spare-0", of=pool, template_hash=present(pool))
    claims = [claimed_ago(pool, f"robot-{ago}-claimed", ago) for ago in (1, 3, 60)]
    found = plan(observe(pool, [left, *claims]))
    assert len(created(found, "pods")) == 1, "in the place of the one that was claimed a minute ago"
    assert found.again_after == pytest.approx(pool_pods.FIRST_THE_CLAIMED - 3, abs=1), "when the next one is due"


def test_claims_whose_pods_were_replaced_delay_nothing() -> None:
    pool = spare(replicas=2)
    left = held_pod("spare-0", of=pool, template_hash=present(pool))
    found = plan(
        observe(pool, [left, held_pod("spare-1", of=pool, template_hash=present(pool)), claimed_ago(pool, "c", 1)])
    )
    assert not created(found, "pods")
    assert found.again_after is None


def test_an_unowned_pod_with_the_labels_of_the_pool_is_ignored() -> None:
    pool = spare(replicas=1)
    foreign = held_pod("spare-x", of=pool)
    foreign["metadata"]["ownerReferences"] = []
    made = plan(observe(pool, [foreign]))
    assert len(created(made, "pods")) == 1
    assert not deleted(made)


def test_a_smaller_pool_first_deletes_pods_that_are_not_ready() -> None:
    pool = spare(replicas=1)
    good = held_pod("spare-a", of=pool, template_hash=present(pool))
    bad = held_pod("spare-b", of=pool, template_hash=present(pool), ready=False)
    assert deleted(plan(observe(pool, [good, bad]))) == ["spare-b"]


def test_pods_of_an_old_template_are_deleted_one_by_one_as_new_ones_become_ready() -> None:
    pool = spare(replicas=2)
    old = [held_pod(f"spare-o{i}", of=pool, template_hash="old") for i in range(2)]
    made = plan(observe(pool, old))
    assert len(created(made, "pods")) == 2
    assert not deleted(made)
    new = [held_pod(f"spare-n{i}", of=pool, template_hash=present(pool), ready=i == 0) for i in range(2)]
    assert len(deleted(plan(observe(pool, old + new)))) == 1
    new[1] = held_pod("spare-n1", of=pool, template_hash=present(pool))
    assert deleted(plan(observe(pool, old + new))) == ["spare-o0", "spare-o1"]


def test_pods_of_the_old_template_can_be_claimed_until_a_new_one_is_ready() -> None:
    pool = spare(replicas=2)
    old = [held_pod("spare-o", of=pool, template_hash="old")]
    starting = [held_pod("spare-n", of=pool, template_hash=present(pool), ready=False)]

    def claimable(pods: list[Object]) -> str:
        policy = applied(plan(observe(pool, pods)), "networkpolicies")["spare-held"]
        found: str = policy["metadata"]["annotations"][names.TEMPLATE_HASH]
        return found

    assert claimable([]) == present(pool)
    assert claimable(old + starting) == "old"
    assert claimable([*old, held_pod("spare-n", of=pool, template_hash=present(pool))]) == present(pool)


class TestTemplateUpdate:
    def pods(self, pool: Object, *, old: int = 0, new: int = 0, starting: int = 0) -> list[Object]:
        return [
            *(held_pod(f"spare-o{i}", of=pool, template_hash="old") for i in range(old)),
            *(held_pod(f"spare-n{i}", of=pool, template_hash=present(pool)) for i in range(new)),
            *(held_pod(f"spare-s{i}", of=pool, template_hash=present(pool), ready=False) for i in range(starting)),
        ]

    def claimable(self, made: Plan) -> str:
        found: str = applied(made, "networkpolicies")["spare-held"]["metadata"]["annotations"][names.TEMPLATE_HASH]
        return found

    def test_min_ready_old_pods_stay_until_as_many_new_ones_are_ready(self) -> None:
        pool = spare(replicas=4, updateStrategy={"minReady": 2})
        made = plan(observe(pool, self.pods(pool, old=4)))
        assert (len(created(made, "pods")), len(deleted(made)), self.claimable(made)) == (4, 2, "old")
        made = plan(observe(pool, self.pods(pool, old=2, new=1, starting=3)))
        assert (created(made, "pods"), deleted(made), self.claimable(made)) == ([], [], "old")
        made = plan(observe(pool, self.pods(pool, old=2, new=2, starting=2)))
        assert (deleted(made), self.claimable(made)) == (["spare-o0", "spare-o1"], present(pool))

    @pytest.mark.parametrize("least", [0, 1, 2, 3, 4, 9])
    @pytest.mark.parametrize("old", range(5))
    @pytest.mark.parametrize("new", range(5))
    def test_an_update_never_leaves_fewer_than_min_ready_claimable_pods(self, least: int, old: int, new: int) -> None:
        pool = spare(replicas=4, updateStrategy={"minReady": least})
        pods = self.pods(pool, old=old, new=new, starting=4 - new)
        made = plan(observe(pool, pods))
        left = [pod for pod in pods if kube_objects.name(pod) not in deleted(made) and kube_objects.ready(pod)]
        could = sum(pod["metadata"]["labels"][names.TEMPLATE_HASH] == self.claimable(made) for pod in left)
        assert could >= min(least, 4, max(old, new))
        assert len(left) >= min(least, 4, old + new)

    def test_an_update_with_min_ready_zero_replaces_all_pods_at_once(self) -> None:
        pool = spare(replicas=3, updateStrategy={"minReady": 0})
        made = plan(observe(pool, self.pods(pool, old=3)))
        assert (len(created(made, "pods")), len(deleted(made))) == (3, 3)

    def test_with_on_replenish_old_pods_stay_claimable_and_only_missing_ones_are_replaced(self) -> None:
        pool = spare(replicas=3, updateStrategy={"type": "OnReplenish"})
        made = plan(observe(pool, self.pods(pool, old=3)))
        assert (created(made, "pods"), deleted(made), self.claimable(made)) == ([], [], "")
        made = plan(observe(pool, self.pods(pool, old=2)))
        (new,) = created(made, "pods")
        assert new["metadata"]["labels"][names.TEMPLATE_HASH] == present(pool)
        assert not deleted(made)

    def test_with_on_replenish_a_smaller_pool_first_deletes_old_pods(self) -> None:
        pool = spare(replicas=1, updateStrategy={"type": "OnReplenish"})
        assert deleted(plan(observe(pool, self.pods(pool, old=1, new=1)))) == ["spare-o0"]

    def test_the_progress_of_an_update_is_reported(self) -> None:
        pool = spare(replicas=3)
        found = observe(pool, self.pods(pool, old=2, new=1))
        assert status(found)["updated"] == 1
        updated = condition(found, "Updated")
        assert (updated["status"], updated["reason"]) == ("False", "RollingOut")
        assert updated["message"].startswith("2 of 3 unclaimed pods have earlier templates")
        done = condition(observe(pool, self.pods(pool, new=3)), "Updated")
        assert (done["status"], done["reason"]) == ("True", "Updated")

    def test_with_on_replenish_old_pods_count_as_ready_and_updated(self) -> None:
        pool = spare(replicas=3, updateStrategy={"type": "OnReplenish"})
        policy = applied(plan(observe(pool)), "networkpolicies")["spare-held"]
        found = observe(pool, self.pods(pool, old=1, new=2), owned={("networkpolicies", "spare-held"): policy})
        updated = condition(found, "Updated")
        assert (updated["status"], updated["reason"]) == ("True", "OnReplenish")
        assert status(found)["ready"] == 3


def test_an_ended_pod_is_replaced_after_a_waiting_time() -> None:
    pool = spare(replicas=1)
    ended = held_pod("spare-a", of=pool, template_hash=present(pool), phase="Failed", age=3)
    made = plan(observe(pool, [ended]))
    assert not created(made, "pods")
    assert made.again_after == pytest.approx(7)
    made = plan(observe(pool, [ended], now=NOW + 8))
    assert len(created(made, "pods")) == 1
    assert deleted(made) == ["spare-a"]


def test_held_containers_wait_without_probes() -> None:
    pool = spare()
    container = pool["spec"]["template"]["spec"]["containers"][0]
    container |= {"livenessProbe": {"exec": {}}, "startupProbe": {"exec": {}}, "readinessProbe": {"exec": {}}}
    container["lifecycle"] = {"postStart": {"exec": {}}, "preStop": {"exec": {}}}
    pool["spec"]["warmPaths"] = ["/opt/app"]
    (pod, _) = created(plan(observe(pool)), "pods")
    app, agent = pod["spec"]["containers"]
    assert app["command"][:2] == ["/bin/sh", "-c"]
    assert app["command"][app["command"].index("/opt/app") + 1] == "--"
    assert app["command"][-2:] == ["run", "--fast"]
    assert "args" not in app
    assert not [key for key in app if key.endswith("Probe")]
    assert app["lifecycle"] == {"preStop": {"exec": {}}}
    held = next(entry for entry in agent["env"] if entry["name"] == "UNDERSTUDY_HELD_CONTAINERS")
    assert held["value"] == "app"
    assert "ROS_DOMAIN_ID" not in json.dumps(pod["spec"])


def test_a_held_container_of_python_preloads_the_pools_modules_and_another_container_none() -> None:
    pool = spare()
    template = pool["spec"]["template"]["spec"]
    [other] = template["containers"]
    nodes = {"name": "nodes", "image": "nodes:1", "command": ["python3", "-m", "nodes"], "args": ["-v"]}
    template["containers"] = [other, nodes]
    pool["spec"]["preload"] = ["rclpy.node", "numpy"]
    (pod, _) = created(plan(observe(pool)), "pods")
    plain, preloading, _ = pod["spec"]["containers"]
    directory, container, words, separator, *command = preloading["command"][4:]
    assert (directory, container, separator) == (names.AGENT_DIR, "nodes", "--")
    interpreter, file, *arguments = words.split()
    assert (interpreter, file) == ("python3", f"{names.AGENT_DIR}/preloaded_interpreter.py")
    assert arguments[:2] == [names.AGENT_DIR, "nodes"]
    assert command[int(arguments[2]) :] == ["python3", "-m", "nodes", "-v"]
    assert arguments[3] == "rclpy.node,numpy"
    assert plain["command"][6] == ""


def test_a_pool_that_preloads_for_no_python_names_the_way_out() -> None:
    pool = spare()
    pool["spec"]["preload"] = ["numpy"]
    observed = observe(pool)
    assert not created(plan(observed), "pods")
    [accepted] = [c for c in status(observed)["conditions"] if c["reason"] == "TemplateInvalid"]
    assert "spec.preload: no container of spec.template has a command that begins with python3" in accepted["message"]


def test_only_monitors_reach_the_agent_of_an_unclaimed_pod() -> None:
    policy = applied(plan(observe(spare())), "networkpolicies")["spare-held"]
    assert policy["spec"]["podSelector"]["matchLabels"] == {names.POOL: "spare", names.HELD: "true"}
    assert policy["spec"]["policyTypes"] == ["Ingress", "Egress"]
    assert "egress" not in policy["spec"]
    control, health = policy["spec"]["ingress"]
    assert [port["port"] for port in control["ports"]] == [names.AGENT_PORT]
    serves = [{"key": names.MONITORED, "operator": "Exists"}]
    monitors = {"matchLabels": {names.COMPONENT: "monitor"}, "matchExpressions": serves}
    assert control["from"] == [{"podSelector": monitors}]
    assert health == {"ports": [{"protocol": "TCP", "port": names.AGENT_HEALTH_PORT}]}


def test_a_copied_template_loses_the_labels_that_the_source_controller_selects() -> None:
    pool = spare(templateFrom={"workload": "w"})
    del pool["spec"]["template"]
    observed = observe(pool, workloads=[workload()], source=TEMPLATE, source_selector={"matchLabels": {"app": "nav"}})
    assert "app" not in created(plan(observed), "pods")[0]["metadata"]["labels"]


class TestInvalidSpec:
    def kept(self, pool: Object) -> list[Object]:
        return [held_pod("spare-a", of=pool, template_hash="old"), held_pod("spare-b", of=pool, template_hash="old")]

    @pytest.mark.parametrize(
        ("change", "reason", "word"),
        [
            ({"template": {"spec": {"containers": [{"name": "app", "image": "a"}]}}}, "TemplateInvalid", "command"),
            (
                {"template": {"spec": {"hostNetwork": True, "containers": [{"name": "a", "command": ["a"]}]}}},
                "TemplateInvalid",
                "hostNetwork",
            ),
            ({"template": None, "templateFrom": {"workload": "gone"}}, "TemplateSourceNotFound", '"gone"'),
            (
                {
                    "readiness": "Initialized",
                    "replicas": None,
                    "template": None,
                    "perWorkload": 1,
                    "initialization": {"yaml": {"set_lifecycle": {"node": "amcl", "state": "inactive"}}},
                },
                "TreeInvalid",
                "spec.initialization.yaml.set_lifecycle.node: found 'amcl'; did you mean '/amcl'?",
            ),
            (
                {
                    "readiness": "Executing",
                    "replicas": None,
                    "template": None,
                    "perWorkload": 1,
                    "readinessCheck": {"yaml": {"resend_goals": {}}},
                },
                "TreeInvalid",
                "spec.readinessCheck.yaml.resend_goals: a check takes no action",
            ),
            ({"replicas": -1}, "SpecInvalid", "spec.replicas"),
        ],
    )
    def test_an_invalid_spec_is_reported_and_changes_nothing(self, change: Object, reason: str, word: str) -> None:
        pool = spare(**change)
        pool["spec"] = {key: value for key, value in pool["spec"].items() if value is not None}
        observed = observe(pool, self.kept(pool), workloads=[workload()])
        assert plan(observed).writes == []
        accepted = condition(observed, "Accepted")
        assert (accepted["status"], accepted["reason"]) == ("False", reason)
        assert word in accepted["message"]

    def test_a_selector_that_matches_no_workload_is_reported(self) -> None:
        ready = condition(observe(spare(), workloads=[workload(labels={"task": "other"})]), "Ready")
        assert (ready["status"], ready["reason"]) == ("False", "NoMatchingWorkload")
        assert "task=critical" in ready["message"]

    def test_a_new_template_that_cannot_start_is_reported_while_old_pods_are_ready(self) -> None:
        pool = spare(replicas=1)
        pods = [
            held_pod("spare-o", of=pool, template_hash="old"),
            held_pod("spare-n", of=pool, template_hash=present(pool), ready=False, waiting="ErrImageNeverPull"),
        ]
        observed = observe(pool, pods, workloads=[workload()])
        assert condition(observed, "Ready")["status"] == "True"
        assert condition(observed, "Reconciled")["reason"] == "ErrImageNeverPull"

    def test_an_image_that_cannot_start_is_reported(self) -> None:
        pool = spare(replicas=1)
        pod = held_pod("spare-a", of=pool, template_hash=present(pool), ready=False, waiting="ErrImageNeverPull")
        ready = condition(observe(pool, [pod], workloads=[workload()]), "Ready")
        assert ready["reason"] == "ErrImageNeverPull"
        assert "spare-a" in ready["message"]
        assert "load the image" in ready["message"]

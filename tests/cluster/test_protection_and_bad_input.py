"""What a workload's conditions report on a real API server - protection, and input that the operator refuses."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from tests.cluster.operator_objects import deployment, identities
from tests.cluster.operators import (
    APPS,
    CORE,
    NETWORK,
    NOWHERE,
    Fleet,
    Operator,
    custom,
    hot,
    policy,
    spare,
    template,
    workload,
)
from tests.support.cluster import Object, until
from understudy.api import names

# -- protection ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def protected(fleet: Fleet, operator: Operator) -> Fleet:
    """A workload with an active pod, a ready standby and a monitor."""
    fleet.create(policy("hot", "Restart"), hot(), workload())
    fleet.wait_built()
    until(lambda: len(fleet.instances()) == 2, "one pod and one standby")
    for pod in fleet.instances():
        fleet.make_ready(pod)
    fleet.make_parts_ready()
    fleet.commit(next(p for p in fleet.instances() if names.SOURCE in p["metadata"]["labels"]))
    fleet.wait_condition("RobotWorkload", "w", "Protected", "FirstStrategyReady", "True")
    return fleet


def test_protected_names_the_strategy_and_becomes_false_without_it(protected: Fleet) -> None:
    assert protected.get("RobotWorkload", "w")["status"]["standby"] == "Executing (1/1)"
    standby = next(p for p in protected.instances() if names.POOL in p["metadata"]["labels"])
    protected.make_ready(standby, ready=False)
    found = protected.wait_condition("RobotWorkload", "w", "Protected", "StandbyNotReady")
    assert "If it failed now, Restart would be used" in found["message"]
    until(lambda: protected.told("w", "StandbyNotReady", "Warning"), "an Event, which comes after the status")
    protected.make_ready(standby)
    protected.wait_condition("RobotWorkload", "w", "Protected", "FirstStrategyReady", "True")


def _delete_policy(fleet: Fleet) -> None:
    fleet.cluster.delete(fleet.get("FailurePolicy", "policy"))


def _break_tree(fleet: Fleet) -> None:
    tree = {"monitoring": {"yaml": {"topic": None, "topik": {"name": "/x"}}}}
    fleet.cluster.patch(fleet.get("FailurePolicy", "policy"), {"spec": tree})


def _break_template(fleet: Fleet) -> None:
    bad = template(resources={"requests": {"cpu": "plenty"}})
    fleet.cluster.patch(fleet.get("RobotWorkload", "w"), {"spec": {"template": bad}})


@pytest.mark.parametrize(
    ("harm", "reason", "word"),
    [
        (_delete_policy, "PolicyNotFound", '"policy"'),
        (_break_tree, "PolicyNotAccepted", "topik"),
        (_break_template, "TemplateInvalid", "quantities must match"),
    ],
)
def test_bad_input_takes_nothing_away(protected: Fleet, harm: Callable[[Fleet], None], reason: str, word: str) -> None:
    settings = protected.get("ConfigMap", "w-settings", CORE)["data"]
    gate, pods = protected.gate(), identities(protected.instances())
    harm(protected)
    found = protected.wait_condition("RobotWorkload", "w", "Accepted", reason)
    assert word in found["message"]
    until(lambda: protected.told("w", reason), "an Event")
    time.sleep(1)
    assert identities(protected.instances()) == pods
    assert protected.gate()["spec"] == gate["spec"]
    assert protected.get("ConfigMap", "w-settings", CORE)["data"] == settings
    assert protected.find("NetworkPolicy", "w-standby", NETWORK)
    assert protected.find("Deployment", "w-monitor", APPS)


# -- bad input ----------------------------------------------------------------------------------------------------------


def foreign_gate() -> Object:
    spec = {"podSelector": {"matchLabels": {"mine": "yes"}}, "policyTypes": ["Ingress"]}
    return {"apiVersion": NETWORK, "kind": "NetworkPolicy", "metadata": {"name": "w-gate"}, "spec": spec}


def unheld() -> Object:
    found = template()
    del found["spec"]["containers"][0]["command"]
    return found


def started(**container: Any) -> Object:
    found = template(**container)
    del found["spec"]["schedulerName"]
    return found


BAD = {
    "a policy that does not exist": (
        [workload(failurePolicyRef={"name": "polcy"}), policy("Restart")],
        ("RobotWorkload", "w", "Accepted", "PolicyNotFound"),
        'did you mean "policy"?',
    ),
    "a tree that can not be read": (
        [policy("Restart", yaml={"topik": {"name": "/cmd_vel"}})],
        ("FailurePolicy", "policy", "Accepted", "TreeInvalid"),
        "spec.monitoring.yaml",
    ),
    "a strategy whose pool does not exist": (
        [policy("hott"), hot()],
        ("FailurePolicy", "policy", "Accepted", "PoolNotFound"),
        'did you mean "hot"?',
    ),
    "a pool with no matching workload": (
        [spare(replicas=1)],
        ("FallbackPool", "spare", "Ready", "NoMatchingWorkload"),
        "task=critical",
    ),
    "an initialization with a mistake": (
        [
            custom(
                "FallbackPool",
                "warm",
                {
                    "readiness": "Initialized",
                    "perWorkload": 1,
                    "workloadSelector": {},
                    "initialization": {"yaml": {"set_lifecycle": {"node": "amcl", "state": "inactive"}}},
                },
            )
        ],
        ("FallbackPool", "warm", "Accepted", "TreeInvalid"),
        "spec.initialization.yaml.set_lifecycle.node: found 'amcl'; did you mean '/amcl'?",
    ),
    "a bringUp with a mistake": (
        [workload(bringUp={"yaml": {"call_servise": {}}}), policy("Restart")],
        ("RobotWorkload", "w", "Accepted", "TreeInvalid"),
        "spec.bringUp.yaml.call_servise: unknown key 'call_servise', did you mean 'call_service'?",
    ),
    "a held template without a command": (
        [workload(template=unheld()), policy("spare"), spare(templateFrom={"workload": "w"})],
        ("FallbackPool", "spare", "Accepted", "TemplateInvalid"),
        "command",
    ),
    "a template taken from nowhere": (
        [spare(templateFrom={"workload": "gone"})],
        ("FallbackPool", "spare", "Accepted", "TemplateSourceNotFound"),
        '"gone"',
    ),
    "a pod template that the API server refuses": (
        [workload(template=template(resources={"requests": {"cpu": "plenty"}})), policy("Restart")],
        ("RobotWorkload", "w", "Accepted", "TemplateInvalid"),
        "quantities must match",
    ),
    "a pool template that the API server refuses": (
        [spare(template=template(ports=[{"containerPort": 99999}]))],
        ("FallbackPool", "spare", "Accepted", "TemplateInvalid"),
        "containerPort",
    ),
    "a controller that does not exist": (
        [workload(workloadRef={"kind": "Deployment", "name": "nav2"}), policy("Restart")],
        ("RobotWorkload", "w", "Accepted", "ReferenceNotFound"),
        'no Deployment "nav2"',
    ),
    "a controller with two pods": (
        [deployment(replicas=2), workload(workloadRef={"kind": "Deployment", "name": "nav2"}), policy("Restart")],
        ("RobotWorkload", "w", "Accepted", "ReplicasNotOne"),
        "spec.replicas is 2",
    ),
    "a name that belongs to somebody else": (
        [foreign_gate(), workload(), policy("Restart")],
        ("RobotWorkload", "w", "Accepted", "NameTaken"),
        'NetworkPolicy "w-gate"',
    ),
    "an image that can not start": (
        [workload(template=started()), policy("Restart")],
        ("RobotWorkload", "w", "Protected", "ErrImageNeverPull"),
        NOWHERE,
    ),
    "a pool's image that can not start": (
        [spare(replicas=1, template=started()), workload(), policy("spare")],
        ("FallbackPool", "spare", "Ready", "ErrImageNeverPull"),
        "imagePullPolicy is Never",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_invalid_input_leads_to_a_condition_and_an_event_with_the_correction(
    case: str, fleet: Fleet, operator: Operator
) -> None:
    items, (kind, name, type_, reason), words = BAD[case]
    fleet.create(*items)
    if type_ == "Protected":
        fleet.make_parts_ready()
    found = fleet.wait_condition(kind, name, type_, reason)
    assert words in found["message"]

    event: Object = until(lambda: fleet.told(name, reason, "Warning"), f"an Event {reason}")[0]
    assert words in event["message"]
    if case == "a name that belongs to somebody else":
        assert fleet.gate()["spec"]["podSelector"] == {"matchLabels": {"mine": "yes"}}
        assert "ownerReferences" not in fleet.gate()["metadata"]


def test_bad_input_that_is_put_right_is_accepted(fleet: Fleet, operator: Operator) -> None:
    fleet.create(workload())
    fleet.wait_condition("RobotWorkload", "w", "Accepted", "PolicyNotFound")
    fleet.create(policy("Restart"))
    fleet.wait_condition("RobotWorkload", "w", "Accepted", "Accepted", "True")


def test_one_bad_object_does_not_keep_another_from_being_protected(fleet: Fleet, operator: Operator) -> None:
    fleet.create(workload("bad", failurePolicyRef={"name": "gone"}), policy("hot"), hot(), workload("good"))
    fleet.wait_built("good")
    until(lambda: len(fleet.instances("good")) == 2, "pod and standby of the good one")

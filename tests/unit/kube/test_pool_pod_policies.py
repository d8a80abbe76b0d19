"""Whom the policies of the pods of shared pools select."""

from __future__ import annotations

import pytest

from understudy.api import names
from understudy.kube import selectors
from understudy.kube.client import Object
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateKind, Reach
from understudy.kube.gates.pool_pod_policies import claimed_pods

UNCLAIMED = {names.WORKLOAD: names.UNCLAIMED, names.HELD: "true", names.POOL: "spare", names.INSTANCE: "spare-1"}


def _selects(claimed: list[str], labels: Object) -> bool:
    return selectors.matches(claimed_pods("w", {}, claimed)["spec"]["podSelector"], labels)


def test_a_claimed_pod_is_selected_by_its_labels_from_before_its_claim_and_no_other_pod_is() -> None:
    claimed = ["spare-1", "spare-2"]
    assert _selects(claimed, UNCLAIMED)
    assert _selects(claimed, {names.WORKLOAD: "w", names.INSTANCE: "spare-1"})
    assert not _selects(claimed, UNCLAIMED | {names.INSTANCE: "spare-3"})
    assert not _selects(claimed, {names.WORKLOAD: "v", names.INSTANCE: "spare-1"})
    assert not _selects([], UNCLAIMED)


@pytest.mark.parametrize("reference", [None, {"app": "navigation"}], ids=["template", "reference"])
def test_a_claimed_pod_reaches_no_other_instance_of_its_workload_and_what_it_needs(
    reference: dict[str, str] | None,
) -> None:
    """Not even a failed one that was claimed before: its nodes would answer what the procedures of the new one ask."""
    reach = Reach(reference={"matchLabels": reference} if reference else None)
    rules = registry.KINDS["NetworkPolicy"].instance_rules("w", reach, ["spare"])

    def is_peer(labels: Object) -> list[bool]:
        ways = (rules["ingress"][0]["from"], rules["egress"][0]["to"])
        return [any(selectors.matches(peer.get("podSelector", {}), labels) for peer in way) for way in ways]

    assert is_peer(UNCLAIMED | {names.CLAIMED_BY: "w"}) == [False, False]
    assert is_peer({names.WORKLOAD: "w", names.INSTANCE: "w-1"}) == [False, False]
    assert is_peer({"app": "robot"}) == [True, True]
    assert is_peer(UNCLAIMED | {names.POOL: "of-localization", names.CLAIMED_BY: "localization"}) == [True, True]


@pytest.mark.parametrize("kind", registry.KINDS.values(), ids=registry.KINDS)
def test_the_rules_of_claimed_pods_are_those_of_instances_that_are_not_in_control(kind: GateKind) -> None:
    rules = kind.instance_rules("w", Reach())
    made = claimed_pods("w", rules, [])
    assert {key: value for key, value in made["spec"].items() if key != "podSelector"} == rules
    for _, companion in kind.companions("w", Reach()):
        assert companion["spec"].items() >= rules.items()

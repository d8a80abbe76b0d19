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


@pytest.mark.parametrize("kind", registry.KINDS.values(), ids=registry.KINDS)
def test_the_rules_of_claimed_pods_are_those_of_instances_that_are_not_in_control(kind: GateKind) -> None:
    rules = kind.instance_rules("w", Reach())
    made = claimed_pods("w", rules, [])
    assert {key: value for key, value in made["spec"].items() if key != "podSelector"} == rules
    for _, companion in kind.companions("w", Reach()):
        assert companion["spec"].items() >= rules.items()

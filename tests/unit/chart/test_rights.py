"""The operator's ClusterRole holds what the code needs and grants, and little more."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import pytest

from tests.unit.chart.conftest import Render, one
from understudy.controller.desired import monitor_deployment
from understudy.controller.reconcile.executor import RESIZE
from understudy.controller.runtime import kopf_handlers, resync, watches
from understudy.kube.client import (
    CONFIG_MAPS,
    ENDPOINT_SLICES,
    EVENTS,
    LEASES,
    NODES,
    PODS,
    POLICIES,
    POOLS,
    WORKLOADS,
    Resource,
)
from understudy.kube.gates import cilium, registry

Right = tuple[str, str, str]
"""API group, resource and verb."""

OURS = (WORKLOADS, POLICIES, POOLS)


def _rights(rules: Iterable[dict[str, Any]]) -> set[Right]:
    return {
        (group, resource, verb)
        for rule in rules
        for group in rule["apiGroups"]
        for resource in rule["resources"]
        for verb in rule["verbs"]
    }


def _each(resource: Resource, *verbs: str) -> set[Right]:
    return {(resource.group, resource.plural, verb) for verb in verbs}


@pytest.fixture(scope="module")
def held(render: Render) -> set[Right]:
    """What the operator's ClusterRole holds."""
    role = one(render(), "ClusterRole", "understudy-operator")
    assert [rule["resources"] for rule in role["rules"] if "resourceNames" in rule] == [[ENDPOINT_SLICES.plural]]
    return _rights(role["rules"])


def _granted() -> set[Right]:
    """What the operator grants to monitors of all sorts."""
    found: set[Right] = set()
    for kind, gate in itertools.product(("ReplicaSet", "Deployment", "StatefulSet"), registry.KINDS.values()):
        access = monitor_deployment.access("w", source=(kind, "s"), policy=None, pools=["p"], gate=gate)
        roles = [item for name, item in access if name == "Role"]
        assert len(roles) == 1
        found |= _rights(roles[0]["rules"])
    return found


def _used() -> set[Right]:
    """What the operator's own code asks for."""
    found = set.union(*(_each(resource, "list", "watch") for resource in kopf_handlers.WATCHED))
    found |= set.union(*(_each(resource, "watch") for resource, _ in watches.WATCHED))
    for resource, _ in resync.LISTED:
        found |= _each(resource, "get", "list")
        if resource not in (*OURS, NODES):  # what it makes, changes and clears away
            found |= _each(resource, "create", "patch")
        if resource not in (*OURS, NODES, LEASES):  # a gate of the kind Mux ends with its workload
            found |= _each(resource, "delete")
    for resource in OURS:
        found.add((resource.group, f"{resource.plural}/status", "patch"))
    found |= _each(EVENTS, "create", "patch")
    found.add(("", f"{PODS.plural}/{RESIZE}", "patch"))
    found |= {("apps", resource, "get") for resource in ("deployments", "statefulsets")}
    found |= _each(ENDPOINT_SLICES, "get")
    found |= _each(cilium.IDENTITIES, "list")
    found |= {("apiextensions.k8s.io", "customresourcedefinitions", verb) for verb in ("list", "watch")}
    return found


def test_the_operator_has_all_rights_that_it_grants_to_monitors(held: set[Right]) -> None:
    assert _granted() - held == set()


def test_the_operator_has_all_rights_that_its_code_uses(held: set[Right]) -> None:
    assert _used() - held == set()


def test_monitors_have_no_rights_to_nodes_or_disruption_budgets() -> None:
    assert not {resource for _, resource, _ in _granted()} & {"nodes", "poddisruptionbudgets"}


def test_the_operator_may_only_read_nodes(held: set[Right]) -> None:
    assert {verb for _, resource, verb in held if resource == NODES.plural} == {"get", "list", "watch"}


def test_monitors_may_not_resize_pods() -> None:
    assert not any(resource == f"{PODS.plural}/{RESIZE}" for _, resource, _ in _granted())


def test_the_operator_has_no_rights_that_are_neither_used_nor_granted(held: set[Right]) -> None:
    assert held - _used() - _granted() == set()


def test_the_operator_has_no_wildcards_and_cannot_escalate_or_change_specs(held: set[Right]) -> None:
    assert not any("*" in right for right in held)
    assert not {verb for _, _, verb in held} & {"escalate", "bind", "impersonate", "deletecollection"}
    # The spec is the user's.
    assert {verb for _, resource, verb in held if resource in {kind.plural for kind in OURS}} == {
        "get",
        "list",
        "watch",
    }


def test_the_settings_of_cilium_are_the_only_object_of_the_system_that_the_operator_may_read(render: Render) -> None:
    (role,) = [item for item in render() if item["kind"] == "Role" and item["metadata"]["namespace"] == cilium.SYSTEM]
    (rule,) = role["rules"]
    assert (rule["resourceNames"], _rights([rule])) == ([cilium.SETTINGS], _each(CONFIG_MAPS, "get"))


def test_without_the_rights_to_cilium_nothing_is_in_the_namespace_of_the_system(render: Render) -> None:
    items = render("rbac.cilium=false")
    assert not [item for item in items if item["metadata"].get("namespace") == cilium.SYSTEM]
    assert "cilium.io" not in {
        group for group, _, _ in _rights(one(items, "ClusterRole", "understudy-operator")["rules"])
    }


def test_the_lease_is_in_the_namespace_of_the_operator(render: Render) -> None:
    role = one(render(), "Role", "understudy-operator")
    assert role["metadata"]["namespace"] == "system"
    assert _rights(role["rules"]) == _each(LEASES, "get", "create", "patch")


def test_the_roles_for_users_cover_the_three_kinds(render: Render) -> None:
    items = render()
    view, edit = (one(items, "ClusterRole", f"understudy-{name}") for name in ("view", "edit"))
    assert view["metadata"]["labels"]["rbac.authorization.k8s.io/aggregate-to-view"] == "true"
    assert edit["metadata"]["labels"]["rbac.authorization.k8s.io/aggregate-to-edit"] == "true"
    assert "rbac.authorization.k8s.io/aggregate-to-view" not in edit["metadata"]["labels"]
    assert {verb for _, _, verb in _rights(view["rules"])} == {"get", "list", "watch"}
    for kind in OURS:
        assert _each(kind, "get", "list", "watch") <= _rights(view["rules"])
        assert _each(kind, "create", "update", "patch", "delete") <= _rights(edit["rules"])
    assert not any(resource.endswith("/status") for _, resource, _ in _rights(edit["rules"]))

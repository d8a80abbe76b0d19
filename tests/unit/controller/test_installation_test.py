"""What ``helm test`` says of an operator and of definitions."""

from __future__ import annotations

import copy
from datetime import UTC, datetime

import pytest

from understudy.api.schema.definitions import definitions
from understudy.controller.runtime.installation_test import definition_problem, operator_problem
from understudy.kube.client import Object

NOW = 1_800_000_000.0
WANTED = definitions()[min(definitions())]


def deployment(*, available: int = 2, replicas: int = 2, observed: int = 1) -> Object:
    status = {"availableReplicas": available, "observedGeneration": observed}
    return {"metadata": {"generation": 1}, "spec": {"replicas": replicas}, "status": status}


def lease(age: float = 1.0, holder: str = "one") -> Object:
    renewed = datetime.fromtimestamp(NOW - age, UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
    return {"spec": {"holderIdentity": holder, "renewTime": renewed}}


def test_an_operator_with_all_replicas_and_a_leader_has_no_problem() -> None:
    assert operator_problem(deployment(), lease(), NOW) is None


@pytest.mark.parametrize(
    ("found", "held", "words"),
    [
        (deployment(available=1), lease(), "1 of 2 replicas are available"),
        (deployment(available=0, replicas=0), lease(), "0 of 0 replicas are available"),
        (deployment(observed=0), lease(), "2 of 2 replicas are available"),
        (deployment(), None, "Lease understudy-operator has no holder"),
        (deployment(), lease(holder=""), "has no holder"),
        (deployment(), lease(age=90), "one is the leader, but has not renewed Lease understudy-operator for 90 s"),
    ],
)
def test_a_problem_of_the_operator_is_reported(found: Object, held: Object | None, words: str) -> None:
    assert words in (operator_problem(found, held, NOW) or "")


def served() -> Object:
    found = copy.deepcopy(WANTED)
    return {**found, "status": {"conditions": [{"type": "Established", "status": "True"}]}}


def test_definitions_of_this_version_have_no_problem() -> None:
    assert definition_problem(served(), WANTED) is None


def test_definitions_of_another_version_are_reported() -> None:
    older, gone, fresh = served(), served(), served()
    del older["spec"]["versions"][0]["schema"]["openAPIV3Schema"]["properties"]["status"]
    gone["spec"]["versions"][0]["name"] = "v1"
    fresh["status"] = {}
    assert "another version of Understudy" in (definition_problem(older, WANTED) or "")
    assert definition_problem(gone, WANTED) == "v1alpha1 is not served, but v1"
    assert definition_problem(fresh, WANTED) == "it is not established"

"""Templates as people write them: what is missing is left out or null, and what has another shape is reported."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from tests.unit.controller.world import IMAGES, NOW, TEMPLATE, Names, World, hot, policy, spare, workload
from understudy.api import names
from understudy.controller.pods import pool_pods
from understudy.controller.status import pool_status
from understudy.kube.client import Object


def containing(**container: Any) -> Object:
    template = copy.deepcopy(TEMPLATE)
    template["spec"]["containers"][0] |= container
    return template


def specifying(**spec: Any) -> Object:
    return {**copy.deepcopy(TEMPLATE), "spec": {**copy.deepcopy(TEMPLATE["spec"]), **spec}}


def accepted_of_pool(template: Object) -> Object:
    pool = spare(template=copy.deepcopy(template))
    observed = pool_pods.Observed(pool=pool, workloads={}, pods=[], owned={}, now=NOW)
    plan = pool_pods.evaluate(observed, IMAGES)
    pool_pods.plan(observed, plan, Names().fresh())
    found: Object = pool_status.status(observed, plan, [])["conditions"][0]
    return found


@pytest.mark.parametrize(
    ("template", "words"),
    [
        (containing(env={"ROBOT": "17"}), "containers[0].env must be a list, but is an object"),
        (containing(env=[None]), "containers[0].env[0] must be an object, but is missing"),
        (containing(env=[{"value": "17"}]), "containers[0].env[0].name must be a string, but is missing"),
        (containing(env=[{"name": "A", "value": 17}]), "env[0].value must be a string, but is 17: put it in quotes"),
        (
            containing(env=[{"name": "A", "value": True}]),
            "env[0].value must be a string, but is true: put it in quotes",
        ),
        (containing(ports=[8080]), "containers[0].ports[0] must be an object, but is 8080"),
        (containing(args="--fast"), "containers[0].args must be a list, but is a string"),
        (containing(args=["--speed", 0.5]), "containers[0].args[1] must be a string, but is 0.5: put it in quotes"),
        (containing(lifecycle="none"), "containers[0].lifecycle must be an object, but is a string"),
        (specifying(initContainers=[{"restartPolicy": "Always"}]), "initContainers[0].name must be a string"),
        (specifying(initContainers=[{"name": "a", "env": {}}]), "initContainers[0].env must be a list"),
        (specifying(volumes={"maps": {}}), "spec.volumes must be a list, but is an object"),
        (specifying(tolerations=["robot"]), "spec.tolerations[0] must be an object, but is a string"),
        (specifying(affinity="none"), "spec.affinity must be an object, but is a string"),
        (specifying(affinity={"podAntiAffinity": []}), "affinity.podAntiAffinity must be an object, but is a list"),
    ],
)
def test_a_template_with_a_wrong_type_is_reported(template: Object, words: str) -> None:
    world = World(workload(template=copy.deepcopy(template)), policy("hot"), hot())
    world.plan()
    for accepted in (world.condition("Accepted"), accepted_of_pool(template)):
        assert (accepted["status"], accepted["reason"]) == ("False", "TemplateInvalid")
        assert words in accepted["message"]


@pytest.mark.parametrize(
    "template",
    [
        containing(env=None, ports=None, volumeMounts=None, args=None, lifecycle=None),
        specifying(volumes=None, initContainers=None, tolerations=None, imagePullSecrets=None),
        specifying(affinity={"podAntiAffinity": {"preferredDuringSchedulingIgnoredDuringExecution": None}}),
        {**TEMPLATE, "metadata": None},
    ],
)
def test_a_null_value_equals_an_omitted_one(template: Object) -> None:
    # The API server takes null out of an object of its own kinds, and leaves it in a template of ours.
    world = World(workload(template=copy.deepcopy(template)), policy("hot"), hot())
    world.build()
    assert world.condition("Accepted")["status"] == "True"
    assert accepted_of_pool(template)["status"] == "True"


def test_a_variable_without_a_value_is_an_empty_string() -> None:
    variables = [{"name": "A", "value": None}, {"name": "B"}, {"name": "C", "value": "c", "valueFrom": None}]
    world = World(workload(template=containing(env=variables)), policy("spare"), spare())
    world.build()
    settings = world.observed().written_settings
    assert settings is not None
    found = settings.container_environment["app"]
    assert {name: found.get(name) for name in "ABC"} == {"A": "", "B": "", "C": "c"}
    assert ("configmaps", names.settings("w")) in world.owned

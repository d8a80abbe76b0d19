"""Which Secrets pull the pods that contain the monitor's image, and which of them are removed last."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest

from tests.unit.controller import world
from tests.unit.controller.world import IMAGES, NOW, TEMPLATE, Names, World, applied, created, hot, policy, workload
from understudy.controller.pods import pool_pods
from understudy.controller.runtime import process as running
from understudy.kube.client import Object

SECRET = [{"name": "registry"}]


@pytest.fixture
def secrets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(world, "IMAGES", replace(IMAGES, pull_secrets=("registry",)))


def pods(found: World) -> dict[str, Object]:
    """The specs of all pods that are made, by what makes them."""
    plan = found.plan()
    made = {
        name: item["spec"]["template"]["spec"]
        for plural in ("deployments", "replicasets")
        for name, item in applied(plan, plural).items()
    }
    (standby,) = created(plan, "pods")
    return made | {"standby": standby["spec"]}


@pytest.mark.usefixtures("secrets")
def test_all_pods_with_the_monitors_image_are_pulled_by_its_secrets() -> None:
    found = pods(World(workload(monitor={"image": "mine:1"}), policy("hot"), hot()))
    assert found.keys() == {"w", "w-monitor", "w-discovery", "standby"}
    assert {name: pod.get("imagePullSecrets") for name, pod in found.items()} == dict.fromkeys(found, SECRET)


@pytest.mark.usefixtures("secrets")
def test_those_of_the_template_stay() -> None:
    template = copy.deepcopy(TEMPLATE)
    template["spec"]["imagePullSecrets"] = [{"name": "own"}, {"name": "registry"}]
    found = pods(World(workload(template=template), policy("hot"), hot()))
    assert found["w"]["imagePullSecrets"] == [{"name": "own"}, {"name": "registry"}]


def test_without_secrets_nothing_is_said_of_them() -> None:
    assert not any("imagePullSecrets" in pod for pod in pods(World(workload(), policy("hot"), hot())).values())


def test_the_pods_of_a_shared_pool_are_pulled_by_them_too() -> None:
    images = replace(IMAGES, pull_secrets=("registry",))
    observed = pool_pods.Observed(pool=world.spare(replicas=1), workloads={}, pods=[], owned={}, now=NOW)
    plan = pool_pods.plan(observed, pool_pods.evaluate(observed, images), Names().fresh())
    (pod,) = created(plan, "pods")
    assert pod["spec"]["imagePullSecrets"] == SECRET


def test_monitors_and_discovery_servers_have_their_priority_and_instances_that_of_their_template(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(world, "IMAGES", replace(IMAGES, priority_class="robots"))
    found = pods(World(workload(), policy("hot"), hot()))
    given = {name: pod["priorityClassName"] for name, pod in found.items() if "priorityClassName" in pod}
    assert given == {"w-monitor": "robots", "w-discovery": "robots"}


def test_the_operator_has_them_of_its_environment_or_its_options(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNDERSTUDY_MONITOR_IMAGE", "monitor:1")
    assert running.options([])[1].images.pull_secrets == ()
    monkeypatch.setenv("UNDERSTUDY_IMAGE_PULL_SECRETS", "registry,other")
    assert running.options([])[1].images.pull_secrets == ("registry", "other")
    assert running.options(["--image-pull-secret", "mine"])[1].images.pull_secrets == ("mine",)


def test_the_operator_has_the_priority_of_its_environment_or_its_options(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNDERSTUDY_MONITOR_IMAGE", "monitor:1")
    assert running.options([])[1].images.priority_class == ""
    monkeypatch.setenv("UNDERSTUDY_PRIORITY_CLASS", "robots")
    assert running.options([])[1].images.priority_class == "robots"
    assert running.options(["--priority-class", "mine"])[1].images.priority_class == "mine"

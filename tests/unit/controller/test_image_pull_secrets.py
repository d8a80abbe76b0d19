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
def test_the_secrets_of_the_monitor_image_pull_all_pods_that_contain_it() -> None:
    found = pods(World(workload(monitor={"image": "mine:1"}), policy("hot"), hot()))
    assert found.keys() == {"w", "w-monitor", "w-discovery", "standby"}
    assert {name: pod.get("imagePullSecrets") for name, pod in found.items()} == dict.fromkeys(found, SECRET)


@pytest.mark.usefixtures("secrets")
def test_pull_secrets_of_the_template_are_kept() -> None:
    template = copy.deepcopy(TEMPLATE)
    template["spec"]["imagePullSecrets"] = [{"name": "own"}, {"name": "registry"}]
    found = pods(World(workload(template=template), policy("hot"), hot()))
    assert found["w"]["imagePullSecrets"] == [{"name": "own"}, {"name": "registry"}]


def test_pods_have_no_pull_secrets_if_none_are_configured() -> None:
    assert not any("imagePullSecrets" in pod for pod in pods(World(workload(), policy("hot"), hot())).values())


def test_pods_of_a_shared_pool_have_the_pull_secrets_too() -> None:
    images = replace(IMAGES, pull_secrets=("registry",))
    observed = pool_pods.Observed(pool=world.spare(replicas=1), workloads={}, pods=[], owned={}, now=NOW)
    plan = pool_pods.plan(observed, pool_pods.evaluate(observed, images), Names().fresh())
    (pod,) = created(plan, "pods")
    assert pod["spec"]["imagePullSecrets"] == SECRET


def test_only_monitors_and_discovery_servers_have_the_configured_priority_class(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(world, "IMAGES", replace(IMAGES, priority_class="robots"))
    found = pods(World(workload(), policy("hot"), hot()))
    priorities = {name: pod["priorityClassName"] for name, pod in found.items() if "priorityClassName" in pod}
    assert priorities == {"w-monitor": "robots", "w-discovery": "robots"}


def test_the_operator_reads_the_pull_secrets_from_its_environment_or_options(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNDERSTUDY_MONITOR_IMAGE", "monitor:1")
    assert running.options([])[1].images.pull_secrets == ()
    monkeypatch.setenv("UNDERSTUDY_IMAGE_PULL_SECRETS", "registry,other")
    assert running.options([])[1].images.pull_secrets == ("registry", "other")
    assert running.options(["--image-pull-secret", "mine"])[1].images.pull_secrets == ("mine",)


def test_the_operator_reads_the_priority_class_from_its_environment_or_options(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNDERSTUDY_MONITOR_IMAGE", "monitor:1")
    assert running.options([])[1].images.priority_class == ""
    monkeypatch.setenv("UNDERSTUDY_PRIORITY_CLASS", "robots")
    assert running.options([])[1].images.priority_class == "robots"
    assert running.options(["--priority-class", "mine"])[1].images.priority_class == "mine"

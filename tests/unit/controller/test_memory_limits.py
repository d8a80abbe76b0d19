"""Memory limits of the containers that the operator creates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from tests.unit.controller import world as worlds
from tests.unit.controller.world import IMAGES, TEMPLATE, World, applied, policy, workload
from understudy.api import names
from understudy.controller.plan import MEMORY_LIMIT, Images
from understudy.controller.pods import instance_pod
from understudy.controller.runtime import process as running
from understudy.kube.client import Object

TASKS = [{"action": "/goto", "type": "test_msgs/action/Fibonacci"}]


def containers(world: World) -> Iterator[tuple[str, Object]]:
    """Name and resources of each container of the workload's Deployments."""
    for made in applied(world.plan(), "deployments").values():
        for container in made["spec"]["template"]["spec"]["containers"]:
            yield container["name"], container["resources"]


def monitor(world: World) -> Object:
    return dict(containers(world))["monitor"]


def keeping(**spec: object) -> Object:
    made = policy("Restart")
    made["spec"] |= spec
    return made


def test_every_container_of_monitors_and_discovery_servers_has_a_memory_limit() -> None:
    found = dict(containers(World(workload(tasks=TASKS), policy("Restart"))))
    assert found.keys() == {"monitor", "discovery", names.TASKS_CONTAINER}
    assert {resources["limits"]["memory"] for resources in found.values()} == {MEMORY_LIMIT}
    assert all(resources["requests"]["memory"] for resources in found.values())


def test_agents_have_a_memory_limit_and_the_application_keeps_its_own_resources() -> None:
    profiles = f"${{{names.STRENGTH_VARIABLE}}}"
    recipe = instance_pod.Recipe("w", "fleet", Images("monitor"), "w-agent", profiles=profiles)
    pod = instance_pod.build(TEMPLATE, recipe)["spec"]
    *application, agent = pod["containers"]
    assert agent["resources"]["limits"] == pod["initContainers"][0]["resources"]["limits"] == {"memory": MEMORY_LIMIT}
    assert [c.get("resources") for c in application] == [c.get("resources") for c in TEMPLATE["spec"]["containers"]]


def test_the_resources_of_a_workload_replace_those_of_its_monitor() -> None:
    own = {"requests": {"memory": "1Gi"}, "limits": {"memory": "3Gi"}}
    assert monitor(World(workload(monitor={"resources": own}), policy("Restart"))) == own


@pytest.mark.parametrize(
    "spec", [{"blackBox": {"memory": "1Gi"}}, {"state": {"keep": [{"topic": "/map"}], "maxBytes": 1 << 28}}]
)
def test_a_monitor_that_may_keep_much_has_no_limit_by_default(spec: Object) -> None:
    assert "limits" not in monitor(World(workload(), keeping(**spec)))


def test_the_limit_of_a_monitor_stays_while_its_policy_is_invalid() -> None:
    for spec in ({"blackBox": {"memory": "1Gi"}}, {}):
        world = World(workload(), keeping(**spec))
        world.build()
        broken = World(workload(), policy("Restart", tree={"nonsense": {}}))
        broken.owned = world.owned
        assert monitor(broken) == monitor(world)


def test_the_chart_sets_the_limit_of_all_and_may_remove_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worlds, "IMAGES", replace(IMAGES, memory_limit="2Gi"))
    found = [
        resources["limits"]["memory"] for _, resources in containers(World(workload(tasks=TASKS), policy("Restart")))
    ]
    assert found == 3 * ["2Gi"]
    monkeypatch.setattr(worlds, "IMAGES", replace(IMAGES, memory_limit=""))
    found = [resources.get("limits") for _, resources in containers(World(workload(tasks=TASKS), policy("Restart")))]
    assert found == 3 * [None]


def test_the_operator_reads_the_limit_from_its_environment_or_options(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("UNDERSTUDY_MONITOR_IMAGE", "monitor:1")
    assert running.options([])[1].images.memory_limit == MEMORY_LIMIT
    monkeypatch.setenv("UNDERSTUDY_MEMORY_LIMIT", "")
    assert running.options([])[1].images.memory_limit == ""
    assert running.options(["--memory-limit", "512Mi"])[1].images.memory_limit == "512Mi"
    with pytest.raises(SystemExit):
        running.options(["--memory-limit", "much"])
    assert "--memory-limit" in capsys.readouterr().err

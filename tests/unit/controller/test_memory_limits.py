"""Memory limits of the containers that the operator creates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from tests.unit.controller import world as worlds
from tests.unit.controller.world import IMAGES, TEMPLATE, World, applied, policy, workload
from understudy.api import names
from understudy.controller.plan import MAX_MEMORY_LIMIT, MEMORY_LIMIT, Images
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


def sufficient(world: World) -> Object | None:
    """The condition of the monitor's memory."""
    return next((c for c in world.status()["conditions"] if c["type"] == "MemorySufficient"), None)


BIG_STATE = {"keep": [{"topic": "/map"}], "maxBytes": 1 << 28}


@pytest.mark.parametrize(
    ("spec", "limit"),
    [
        ({"blackBox": {"memory": "1Gi"}}, "2080Mi"),
        ({"state": BIG_STATE}, "1536Mi"),
        ({"blackBox": {"memory": "512Mi"}, "state": BIG_STATE}, "2Gi"),
        ({"blackBox": {"memory": "480Mi"}, "state": {"maxBytes": (16 << 20) + 512}}, "1572865Ki"),
        ({"blackBox": {"memory": "3Gi"}, "state": {"maxBytes": 1024}}, "4Gi"),
    ],
)
def test_a_monitor_that_may_keep_much_has_a_limit_that_covers_it(spec: Object, limit: str) -> None:
    world = World(workload(), keeping(**spec))
    assert monitor(world)["limits"] == {"memory": limit}


def test_the_chart_s_limit_is_for_monitors_that_keep_less_than_half_of_it() -> None:
    world = World(workload(), keeping(blackBox={"memory": "479Mi"}))
    assert monitor(world)["limits"] == {"memory": MEMORY_LIMIT}
    assert sufficient(world) is None


def test_no_policy_gives_a_monitor_more_than_the_maximum() -> None:
    for spec in ({"memory": "9999Gi"}, {"memory": "9999Gi", "window": "10m"}):
        world = World(workload(), keeping(blackBox=spec))
        assert monitor(world)["limits"] == {"memory": MAX_MEMORY_LIMIT}
        found = sufficient(world)
        assert found is not None
        assert (found["status"], found["reason"]) == ("False", "MaximumExceeded")
        for words in ("FailurePolicy policy", "9999Gi", MAX_MEMORY_LIMIT, "monitors.maxMemoryLimit"):
            assert words in found["message"]


def test_a_condition_reports_a_limit_that_was_raised() -> None:
    found = sufficient(World(workload(), keeping(blackBox={"memory": "1Gi"})))
    assert found is not None
    assert (found["status"], found["reason"]) == ("True", "LimitRaised")
    assert "2080Mi" in found["message"]


def test_the_condition_of_memory_stays_while_the_policy_is_invalid() -> None:
    before = World(workload(), keeping(blackBox={"memory": "9999Gi"}))
    status = {"conditions": [{**sufficient(before), "lastTransitionTime": "2026-01-01T00:00:00Z"}]}  # type: ignore[dict-item]
    after = sufficient(World(workload(status=status), policy("Restart", tree={"nonsense": {}})))
    assert after is not None
    assert after["reason"] == "MaximumExceeded"


def test_resources_of_the_workload_have_no_condition() -> None:
    own = {"limits": {"memory": "16Gi"}}
    world = World(workload(monitor={"resources": own}), keeping(blackBox={"memory": "9999Gi"}))
    assert monitor(world) == own
    assert sufficient(world) is None


def test_the_chart_sets_the_maximum(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worlds, "IMAGES", replace(IMAGES, max_memory_limit="1500Mi"))
    assert monitor(World(workload(), keeping(blackBox={"memory": "1Gi"})))["limits"] == {"memory": "1500Mi"}
    # A maximum below the usual limit does not lower that one.
    monkeypatch.setattr(worlds, "IMAGES", replace(IMAGES, memory_limit="8Gi"))
    for memory in ("16Mi", "9Gi"):
        assert monitor(World(workload(), keeping(blackBox={"memory": memory})))["limits"] == {"memory": "8Gi"}
    monkeypatch.setattr(worlds, "IMAGES", replace(IMAGES, memory_limit=""))
    assert "limits" not in monitor(World(workload(), keeping(blackBox={"memory": "9Gi"})))


def test_an_unlimited_monitor_of_an_earlier_version_is_limited_even_if_its_policy_is_invalid() -> None:
    world = World(workload(), policy("Restart"))
    world.build()
    deployment = world.owned["deployments", names.monitor("w")]
    del deployment["spec"]["template"]["spec"]["containers"][0]["resources"]["limits"]
    broken = World(workload(), policy("Restart", tree={"nonsense": {}}))
    broken.owned = world.owned
    assert monitor(broken)["limits"] == {"memory": MAX_MEMORY_LIMIT}


def test_the_limit_of_a_monitor_stays_while_its_policy_is_invalid() -> None:
    for spec in ({"blackBox": {"memory": "1Gi"}}, {"blackBox": {"memory": "99Gi"}}, {}):
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
    assert running.options([])[1].images.max_memory_limit == MAX_MEMORY_LIMIT
    assert running.options(["--max-memory-limit", "2Gi"])[1].images.max_memory_limit == "2Gi"
    monkeypatch.setenv("UNDERSTUDY_MAX_MEMORY_LIMIT", "3Gi")
    assert running.options([])[1].images.max_memory_limit == "3Gi"
    with pytest.raises(SystemExit):
        running.options(["--max-memory-limit", ""])
    with pytest.raises(SystemExit):
        running.options(["--memory-limit", "much"])
    assert "--memory-limit" in capsys.readouterr().err

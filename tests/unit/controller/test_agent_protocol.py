"""What a pod's spec says of its agent's protocol, so that a monitor accepts no older one from who answers there."""

from __future__ import annotations

import pytest

from tests.unit.controller.pools import observe, plan
from tests.unit.controller.world import IMAGES, World, created, hot, patched, policy, spare, workload
from understudy.api import names
from understudy.controller.pods.instance_pod import agent_protocol
from understudy.kube.client import Object

OWN = "mine/monitor:1"


def reporting(image: str, protocol: int | None = None, **spec: Object) -> Object:
    """A workload whose monitor has reported its image."""
    found = workload(**spec)
    found["status"] = {
        "monitor": {"version": "0.2.0", "image": image, **({"agentProtocol": protocol} if protocol else {})}
    }
    return found


OF_0_1 = {**workload(monitor={"image": OWN}), "status": {"health": "Healthy"}}
"""Its monitor is of version 0.1.0, which does not report its image."""


def stated(pods: list[Object]) -> set[str | None]:
    """What the pods say."""
    agents = [c for pod in pods for c in pod["spec"]["containers"] if c["name"] == names.AGENT_CONTAINER]
    variables = [{entry["name"]: entry.get("value") for entry in agent["env"]} for agent in agents]
    return {one.get(names.AGENT_PROTOCOL_VARIABLE) for one in variables}


def test_the_spec_of_each_instance_says_which_protocol_its_agent_knows() -> None:
    assert stated(created(World(workload(), policy("hot"), hot()).plan(), "pods")) == {"2"}
    assert stated(created(plan(observe(spare(replicas=1))), "pods")) == {"2"}


@pytest.mark.parametrize(
    ("image", "workloads", "protocol"),
    [
        (OWN, [], 2),
        (OWN, [workload()], 2),
        (OWN, [reporting(OWN)], 1),
        (OWN, [reporting(OWN, 2)], 2),
        (OWN, [reporting("mine/monitor:0")], 2),
        (OWN, [reporting(OWN, 2), reporting(OWN)], 1),
        (OWN, [OF_0_1], 1),
        (IMAGES.monitor, [OF_0_1], 2),
        (OWN, [workload(monitor={"image": OWN})], 2),
    ],
)
def test_an_image_of_which_a_monitor_shows_that_it_is_older_has_an_older_agent(
    image: str, workloads: list[Object], protocol: int
) -> None:
    """A user's own image stays as it was when Understudy is upgraded."""
    assert agent_protocol(image, workloads) == protocol


def test_the_pods_of_an_older_image_say_nothing() -> None:
    old = reporting(OWN, monitor={"image": OWN})
    assert stated(created(World(old, policy("hot"), hot()).plan(), "pods")) == {None}
    assert stated(created(World(reporting(IMAGES.monitor, 2), policy("hot"), hot()).plan(), "pods")) == {"2"}
    pool = observe(spare(replicas=1), workloads=[reporting(IMAGES.monitor)])
    assert stated(created(plan(pool), "pods")) == {None}


KEYS = {names.MONITOR_PRIVATE_KEY, names.MONITOR_PUBLIC_KEY}


def secrets(world: World) -> tuple[list[Object], dict[str, Object]]:
    """The agents' Secrets that the operator creates, and its changes of existing ones."""
    made = world.plan()
    return created(made, "secrets"), patched(made, "secrets")


@pytest.mark.parametrize(
    ("item", "keyed"),
    [
        (workload(), True),
        (reporting(IMAGES.monitor, 3), True),
        (reporting(IMAGES.monitor, 2), False),
        ({**workload(), "status": {"health": "Healthy", "monitor": {"image": "a", "agentProtocol": 3}}}, True),
        ({**workload(), "status": {"health": "Healthy", "monitor": {"image": "a", "agentProtocol": 2}}}, False),
        ({**workload(), "status": {"health": "Healthy", "monitor": {"image": "a"}}}, False),
        ({**workload(), "status": {"health": "Healthy"}}, False),
    ],
)
def test_agents_get_a_key_of_their_monitor_as_soon_as_it_knows_such_keys(item: Object, keyed: bool) -> None:
    """One of an earlier version could not command them otherwise: monitors are replaced in steps."""
    [secret], _ = secrets(World(item, policy("hot"), hot()))
    assert set(secret["data"]) == {names.TOKEN, *(KEYS if keyed else ())}
    live = {**secret, "metadata": {**secret["metadata"], "uid": "u", "resourceVersion": "4", "namespace": "fleet"}}
    for other in (item, {**workload(), "status": {"health": "Healthy", "monitor": {"agentProtocol": 3}}}):
        world = World(other, policy("hot"), hot())
        world.owned["secrets", "w-agent"] = live
        _, changes = secrets(world)
        assert set(changes.get("w-agent", {}).get("data", {})) == (KEYS if other is not item and not keyed else set())


def test_no_pod_mounts_the_private_key_of_the_monitor() -> None:
    pods = created(World(workload(), policy("hot"), hot()).plan(), "pods") + created(
        plan(observe(spare(replicas=1))), "pods"
    )
    for pod in pods:
        [volume] = [one["secret"] for one in pod["spec"]["volumes"] if one["name"] == names.TOKEN_VOLUME]
        assert [item["key"] for item in volume["items"]] == [names.TOKEN, names.MONITOR_PUBLIC_KEY]
    assert len(pods) == 2

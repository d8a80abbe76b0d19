"""Who mounts the volumes of an agent, and how."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import pytest

from understudy.api import names
from understudy.api.protocol import hold_script
from understudy.controller.plan import Images
from understudy.controller.pods import instance_pod
from understudy.kube.client import Object

APPLICATION = {
    "spec": {
        "containers": [
            {"name": "drive", "image": "i", "command": ["drive"], "securityContext": {"readOnlyRootFilesystem": True}},
            {"name": "lamp", "image": "i", "command": ["lamp"]},
        ],
        "initContainers": [{"name": "bridge", "image": "b", "restartPolicy": "Always"}],
    }
}
PREPARED = f"<value>${{{names.STRENGTH_VARIABLE}}}</value>"
RECIPES = {
    "plain": {"workload": "w"},
    "with profiles": {"workload": "w", "profiles": "<dds/>"},
    "with a reflex": {"workload": "w", "profiles": PREPARED},
    "held": {"workload": "", "pool": "spare", "held": True},
}


@pytest.fixture(params=RECIPES)
def pod(request: pytest.FixtureRequest) -> Object:
    recipe = instance_pod.Recipe(namespace="fleet", images=Images("monitor"), secret="agent", **RECIPES[request.param])
    spec: Object = instance_pod.build(copy.deepcopy(APPLICATION), recipe)["spec"]
    return spec


def mounts(pod: Object, volume: str) -> Iterator[tuple[str, Object]]:
    """Name of the container, and the mount."""
    for container in [*pod.get("initContainers", ()), *pod["containers"]]:
        for mount in container.get("volumeMounts") or ():
            if mount["name"] == volume:
                yield container["name"], mount


def test_only_the_agent_has_the_volume_with_its_memory_and_its_token(pod: Object) -> None:
    for volume in (names.MEMORY_VOLUME, names.TOKEN_VOLUME):
        assert {name for name, _ in mounts(pod, volume)} == {names.AGENT_CONTAINER}
    agent = pod["containers"][-1]
    environment = {entry["name"]: entry.get("value") for entry in agent["env"]}
    assert environment[names.MEMORY_VARIABLE] == environment["HOME"] == names.MEMORY_DIR
    assert names.MEMORY_DIR in [mount["mountPath"] for _, mount in mounts(pod, names.MEMORY_VOLUME)]
    assert {"name": names.MEMORY_VOLUME, "emptyDir": {}} in pod["volumes"]


def test_an_application_cannot_write_to_the_shared_volume(pod: Object) -> None:
    writers = {name for name, mount in mounts(pod, names.AGENT_VOLUME) if not mount.get("readOnly")}
    assert writers <= {names.AGENT_CONTAINER, names.INIT_CONTAINER}


def test_an_agent_of_an_older_image_finds_that_held_containers_wait() -> None:
    """It looks for a file of this name, which the containers can no longer write."""
    recipe = instance_pod.Recipe("", "fleet", Images("monitor"), "agent", pool="spare", held=True)
    agent = instance_pod.build(copy.deepcopy(APPLICATION), recipe)["spec"]["containers"][-1]
    paths = {mount["mountPath"] for mount in agent["volumeMounts"]}
    assert paths >= {f"{names.AGENT_DIR}/{hold_script.waiting_name(container)}" for container in ("drive", "lamp")}


def test_a_template_cannot_have_a_volume_of_this_name() -> None:
    spec = {"containers": [{"name": "a"}], "volumes": [{"name": names.MEMORY_VOLUME, "emptyDir": {}}]}
    found = instance_pod.problem({"spec": spec}, held=False, path="spec.template")
    assert found is not None
    assert names.MEMORY_VOLUME in found


OWN_VOLUMES = (names.MEMORY_VOLUME, names.TOKEN_VOLUME, names.AGENT_VOLUME, names.INSTANCE_PROFILES_VOLUME)


@pytest.mark.parametrize("held", [False, True], ids=["workload", "pool"])
@pytest.mark.parametrize("containers", ["containers", "initContainers"])
@pytest.mark.parametrize("field", ["volumeMounts", "volumeDevices"])
@pytest.mark.parametrize("volume", OWN_VOLUMES)
def test_a_template_cannot_mount_the_volumes_of_the_agent(held: bool, containers: str, field: str, volume: str) -> None:
    template = copy.deepcopy(APPLICATION)
    data = {"name": "data", "mountPath": "/data"}
    template["spec"]["volumes"] = [{"name": "data", "emptyDir": {}}]
    template["spec"][containers][0][field] = [data, {"name": volume, "mountPath": "/theirs"}]
    found = instance_pod.problem(template, held=held, path="spec.template")
    assert found is not None
    assert found.startswith(f"spec.template.spec.{containers}[0].{field}[1] ")
    assert volume in found
    template["spec"][containers][0][field] = [data]
    assert instance_pod.problem(template, held=held, path="spec.template") is None


@pytest.mark.parametrize("containers", ["containers", "initContainers"])
@pytest.mark.parametrize("field", ["volumeMounts", "volumeDevices"])
def test_mounts_of_another_type_are_reported(containers: str, field: str) -> None:
    template = copy.deepcopy(APPLICATION)
    for value in ("data", ["data"], {"name": names.MEMORY_VOLUME}):
        template["spec"][containers][0][field] = value
        found = instance_pod.problem(template, held=False, path="spec.template")
        assert found is not None
        assert found.startswith(f"spec.template.spec.{containers}[0].{field}")

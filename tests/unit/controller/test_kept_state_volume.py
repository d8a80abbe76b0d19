"""What the operator builds for kept state: where it lies, and which standbys are kept up with it."""

from __future__ import annotations

import json

from tests.unit.controller.world import World, applied, hot, policy, spare, workload
from understudy.kube.client import Object


def monitor(world: World) -> Object:
    pod: Object = applied(world.plan(), "deployments")["w-monitor"]["spec"]["template"]["spec"]
    return pod


def kept_on(claim: str | None, *, tree: Object | None = None) -> World:
    protecting = policy("Restart", tree=tree)
    if claim:
        protecting["spec"]["state"] = {"keep": [{"topic": "/amcl_pose"}], "storage": {"claimName": claim}}
    return World(workload(), protecting)


def test_kept_state_is_in_an_empty_dir_unless_the_policy_names_a_claim() -> None:
    pod = monitor(kept_on(None))
    assert {"name": "state", "emptyDir": {}} in pod["volumes"]
    assert not [volume for volume in pod["volumes"] if "persistentVolumeClaim" in volume]
    assert "securityContext" not in pod


def test_the_monitor_may_write_to_the_folder_of_its_workload_on_the_claim() -> None:
    pod = monitor(kept_on("robot-state"))
    assert {"name": "kept", "persistentVolumeClaim": {"claimName": "robot-state"}} in pod["volumes"]
    (container,) = [c for c in pod["containers"] if c["name"] == "monitor"]
    assert {"name": "kept", "mountPath": "/var/lib/understudy/kept", "subPath": "w"} in container["volumeMounts"]
    assert pod["securityContext"]["fsGroup"] == container["securityContext"]["runAsGroup"]


def test_kept_state_stays_on_its_claim_while_the_policy_is_invalid() -> None:
    world = kept_on("robot-state")
    world.build()
    broken = kept_on("another", tree={"nonsense": {}})
    broken.owned = world.owned
    assert {"name": "kept", "persistentVolumeClaim": {"claimName": "robot-state"}} in monitor(broken)["volumes"]


def pools(world: World) -> dict[str, Object]:
    settings = json.loads(applied(world.plan(), "configmaps")["w-settings"]["data"]["settings.json"])
    return {pool["name"]: pool for pool in settings["pools"]}


def test_only_initialized_standbys_are_kept_up_to_date() -> None:
    initialization = {"yaml": {"node_present": {"node": "/amcl"}}}
    warm = hot("warm", readiness="Initialized", keepUp={"period": "2s"}, initialization=initialization)
    running = hot("hot", keepUp={"period": "2s"})
    world = World(workload(), policy("warm", "hot", "spare"), warm, running, spare())
    found = pools(world)
    assert found["warm"]["keepUp"] == "2s"
    assert "keepUp" not in found["hot"]
    assert "keepUp" not in found["spare"]

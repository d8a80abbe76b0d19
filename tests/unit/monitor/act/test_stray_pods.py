"""A pod of the workload that lost its label is found by what it sends, by its address and its owner."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.unit.monitor.act.test_leak_response import ACTIVE, STANDBY, switched
from tests.unit.monitor.cluster_objects import pod_of, settings_of
from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.failover.interfaces import Instance
from understudy.kube.client import PODS, Object
from understudy.monitor.act.instances import stray_pods
from understudy.monitor.act.instances.stray_pods import strays
from understudy.monitor.observe.robot.known_senders import KnownSender, OutputSender
from understudy.ros.rmw import MIDDLEWARE

HOST = MIDDLEWARE.host_at("10.0.0.3")
SETTINGS = settings_of(pools=[{"name": "hot", "readiness": "Executing"}])
WORKLOAD = {"apiVersion": API_VERSION, "kind": "RobotWorkload", "name": "w", "uid": "uid-w", "controller": True}
POOL = {"apiVersion": API_VERSION, "kind": "FallbackPool", "name": "hot", "uid": "p", "controller": True}
REPLICA_SET = {"apiVersion": "apps/v1", "kind": "ReplicaSet", "name": "w", "uid": "r", "controller": True}


def stray(owner: Object | None, *, labels: dict[str, str] | None = None, workload: str = "", **more: Any) -> Object:
    """Return the pod of the standby without its labels; ``workload`` is the one that its agent serves."""
    found = pod_of(replace(STANDBY, **more))
    found["metadata"]["labels"] = labels or {}
    found["metadata"]["ownerReferences"] = [owner] if owner is not None else []
    environment = [{"name": names.WORKLOAD_VARIABLE, "value": workload}] if workload else []
    found["spec"]["containers"] = [{"name": names.AGENT_CONTAINER, "env": environment}]
    return found


@pytest.mark.parametrize("labels", [{}, {names.WORKLOAD: "another"}], ids=["removed", "changed"])
@pytest.mark.parametrize(
    "pod",
    [stray(WORKLOAD), stray(REPLICA_SET), stray(WORKLOAD, claim="uid-w/1"), stray(None, workload="w")],
    ids=["standby", "replica set", "claimed", "released by its replica set"],
)
def test_a_pod_without_the_label_of_its_workload_is_known_by_its_owner(pod: Object, labels: dict[str, str]) -> None:
    pod["metadata"]["labels"] = labels
    (found,) = strays([pod], SETTINGS, {HOST}, ())
    assert found.uid == "uid-3"
    assert [one.uid for one in strays([pod], SETTINGS, (), {"uid-3"})] == ["uid-3"], "and by the UID in its packets"
    assert not strays([pod], SETTINGS, {MIDDLEWARE.host_at("10.0.0.4")}, {"uid-4"}), (
        "a pod that sends nothing is left alone"
    )


@pytest.mark.parametrize(
    "pod",
    [
        stray(None),
        stray(None, workload="another"),
        stray(WORKLOAD | {"uid": "uid-another"}),
        stray(WORKLOAD, labels={names.WORKLOAD: "w"}),
        stray(REPLICA_SET | {"name": "other"}),
        stray(POOL),
    ],
    ids=["no owner", "released by another", "another workload", "watched", "other set", "unclaimed"],
)
def test_a_pod_of_somebody_else_is_no_stray(pod: Object) -> None:
    assert not strays([pod], SETTINGS, {HOST}, {"uid-3"})


def test_a_pod_of_a_referenced_deployment_belongs_to_its_replica_set() -> None:
    settings = settings_of(source_kind="Deployment", source_name="drive")
    pod = stray(REPLICA_SET | {"name": "drive-6f9c"})
    assert [one.uid for one in strays([pod], settings, {HOST}, ())] == ["uid-3"]


async def test_a_standby_without_its_label_that_drives_is_found_and_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stray_pods, "AGAIN", 0.0)
    driven = await switched(tmp_path, ACTIVE)
    driven.objects.client.store(PODS, "fleet", stray(WORKLOAD))
    act, judge = driven.monitor.loop.act, driven.monitor.loop.judge
    for _ in range(10):
        sender = OutputSender("/cmd_vel", "/drive", "", (), driven.now + 0.2, HOST)
        driven.observer.heard = [sender]
        await driven.look()
    judge.sole_driver.report(driven.now)
    assert driven.notices.conditions["SoleDriver"][:2] == ("Unknown", "UnknownSender")
    act.strays.look(*judge.sole_driver.unknown(driven.now))
    await driven.look()
    (found,) = act.strays.instances
    assert (found.name, found.uid) == ("w-3", "uid-3")
    driven.observer.senders = [KnownSender("w-3", "uid-3", "10.0.0.3", driven.now, listed=True)]
    await driven.hear(Instance("w-3", "uid-3"), ACTIVE, times=40)
    assert driven.graces == [("uid-3", 1)]
    assert driven.commits == [], "the active instance drives on"
    assert driven.notices.conditions["SoleDriver"][:2] == ("False", "SeveralDrivers")

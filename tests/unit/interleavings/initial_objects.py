"""The objects that somebody has created before a run begins."""

from __future__ import annotations

from tests.unit.controller import world
from tests.unit.interleavings.actors import NAMESPACE
from tests.unit.interleavings.apiserver import EPOCH, ApiServer, stamp
from tests.unit.interleavings.kept_states import KEPT
from tests.unit.interleavings.pods import REFERRED
from tests.unit.interleavings.scenes import ON_BOARD, ROBOTS, Scene
from understudy.kube.client import Object


def create(scene: Scene, server: ApiServer) -> None:
    """Create the objects of a scene, as somebody does."""
    items: list[Object] = [world.policy(*scene.strategies)]
    strategies = items[0]["spec"]["strategies"]
    for strategy in strategies:
        strategy["verifyWithin"] = "15s" if strategy["type"] == "Restart" else "5s"
    items[0]["spec"]["monitoring"]["startupGrace"] = "6s"
    if scene.safely:
        command = {"topic": "/cmd_vel", "message": {"linear": {"x": 0.0}}, "every": "250ms"}
        items[0]["spec"]["safety"] = {"commands": [command]}
    if scene.keeps:
        items[0]["spec"]["state"] = KEPT.model_dump(by_alias=True, mode="json", exclude_unset=True)
    if scene.spares:
        updates = {"updateStrategy": dict(scene.updates)} if scene.updates else {}
        pool = world.spare(replicas=scene.spares, **updates)
        if scene.sizing:
            del pool["spec"]["replicas"]
            pool["spec"]["sizing"] = dict(scene.sizing)
        items.append(pool)
    if scene.standbys:
        initialization = {"initialization": {"yaml": {"wait_for": {"node": "/localization"}}}}
        more = {"readiness": "Initialized", **initialization} if scene.initializes else {}
        items.append(world.hot(per_workload=scene.standbys, **more))
    for name in scene.workload_names:
        more = {"workloadRef": {"kind": scene.refers, "name": f"app-{name}"}} if scene.refers else {}
        gate = {"kind": "Mux"} if scene.muxed else {"robots": [ROBOTS]} if scene.reflex else {}
        if scene.on_board:
            gate["mux"] = {"onBoard": {"name": ON_BOARD, "after": scene.on_board}}
        if gate:
            more["gate"] = gate | ({"reflex": {"deadline": scene.reflex}} if scene.reflex else {})
        if scene.tasks:
            action = {"action": "/carry", "type": "nav2_msgs/action/NavigateToPose"}
            more["tasks"] = [action | {"onFailover": scene.tasks}]
        if scene.activates:
            more["bringUp"] = {"yaml": {"wait_for": {"node": "/controller"}}}
        items.append(world.workload(name, ros={"discovery": {"mode": "Multicast"}}, **more))
        if scene.refers:
            _deploy(scene.refers, name, server)
    plurals = {
        "FailurePolicy": "failurepolicies",
        "FallbackPool": "fallbackpools",
        "RobotWorkload": "robotworkloads",
    }
    for item in items:
        created = {"creationTimestamp": stamp(EPOCH)} if scene.muxed else {}  # orders begin with it
        metadata = {**item["metadata"], **created, "namespace": NAMESPACE, "generation": 1}
        server.write(plurals[item["kind"]], (NAMESPACE, metadata["name"]), {**item, "metadata": metadata}, "somebody")


def _deploy(kind: str, workload: str, server: ApiServer) -> None:
    """A Deployment that somebody has, and its ReplicaSet; or a StatefulSet."""
    name = f"app-{workload}"
    labels = {REFERRED: workload}
    template = {"metadata": {"labels": {**labels, "pod-template-hash": "1"}}, "spec": world.TEMPLATE["spec"]}
    metadata = {"name": name, "namespace": NAMESPACE, "uid": f"uid-{name}", "generation": 1}
    spec = {"replicas": 1, "selector": {"matchLabels": labels}, "template": template}
    made = {"apiVersion": "apps/v1", "kind": kind, "metadata": metadata, "spec": spec}
    server.write(f"{kind.lower()}s", (NAMESPACE, name), made, "somebody")
    if kind != "Deployment":
        return
    owner = {"apiVersion": "apps/v1", "kind": "Deployment", "name": name, "uid": f"uid-{name}", "controller": True}
    metadata = {
        **metadata,
        "name": f"{name}-1",
        "uid": f"uid-{name}-1",
        "labels": labels,
        "ownerReferences": [owner],
    }
    made = {"apiVersion": "apps/v1", "kind": "ReplicaSet", "metadata": metadata, "spec": spec}
    server.write("replicasets", (NAMESPACE, f"{name}-1"), made, "somebody")

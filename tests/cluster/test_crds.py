"""The three kinds as a real API server takes, refuses, fills in and shows them.

Each file in ``manifests/bad`` says in its first lines what the refusal must contain: the field, and what would be right.
"""

from __future__ import annotations

import copy
from pathlib import Path

import pytest

from tests.cluster.conftest import Release
from tests.support.cluster import Cluster, Object, Refused, load, until
from understudy.api.base import API_VERSION
from understudy.api.schema.definitions import definitions
from understudy.api.schema.printed_kinds import KINDS
from understudy.kube.client import WORKLOADS, Client
from understudy.kube.kubeconfig import load_access
from understudy.kube.undeclared_fields import apply_declared

MANIFESTS = Path(__file__).parent / "manifests"
GOOD = sorted((MANIFESTS / "good").glob("*.yaml"))
BAD = sorted((MANIFESTS / "bad").glob("*.yaml"))
_REFUSED = "# refused: "

pytestmark = pytest.mark.usefixtures("release")


@pytest.fixture
def make(cluster: Cluster, namespace: str):
    """Creates the object of a good manifest."""

    def create(name: str) -> Object:
        (item,) = load(MANIFESTS / "good" / f"{name}.yaml")
        return cluster.create(item, namespace, strict=True)

    return create


def test_the_definitions_served_are_those_of_the_models(cluster: Cluster) -> None:
    for definition in definitions().values():
        served = cluster.get("apiextensions.k8s.io/v1", "CustomResourceDefinition", definition["metadata"]["name"])
        schema = definition["spec"]["versions"][0]["schema"]["openAPIV3Schema"]
        assert served["spec"]["versions"][0]["schema"]["openAPIV3Schema"] == schema
        problems = [c for c in served["status"]["conditions"] if c["type"] == "NonStructuralSchema"]
        assert problems == []


@pytest.mark.parametrize("file", GOOD, ids=lambda file: file.stem)
def test_good_manifests_are_taken_whole(cluster: Cluster, file: Path) -> None:
    (item,) = load(file)
    created = cluster.create(item, "default", strict=True, dry_run=True)
    assert _contains(created["spec"], item["spec"]), "the API server dropped or changed what was said"


@pytest.mark.parametrize("file", BAD, ids=lambda file: file.stem)
def test_invalid_manifests_are_refused_with_the_field_and_a_correction(cluster: Cluster, file: Path) -> None:
    (item,) = load(file)
    expected = [line.removeprefix(_REFUSED) for line in file.read_text().splitlines() if line.startswith(_REFUSED)]
    assert expected, "say what the refusal must contain"
    with pytest.raises(Refused) as refused:
        cluster.create(item, "default", strict=True, dry_run=True)
    assert refused.value.status in (400, 422)
    missing = [text for text in expected if text not in refused.value.message]
    assert not missing, refused.value.message


def test_the_table_of_bad_manifests_is_long_enough() -> None:
    assert len(BAD) >= 30
    assert {load(file)[0]["kind"] for file in BAD} == {kind.name for kind in KINDS}


def test_defaults_are_filled_in(make) -> None:
    assert make("workload-of-a-deployment")["spec"] == {
        "workloadRef": {"kind": "Deployment", "name": "nav2"},
        "outputs": [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}],
        "failurePolicyRef": {"name": "navigation"},
        "ros": {"domainId": 0, "discovery": {"mode": "Managed"}},
        "gate": {"kind": "NetworkPolicy"},
        "draining": {"holdFor": "5m"},
        "monitor": {"diagnostics": False, "snapshots": False},
        "poolPriority": 0,
    }
    policy = make("policy-short")["spec"]
    assert policy["monitoring"]["debounce"] == "0s"
    assert policy["monitoring"]["startupGrace"] == "30s"
    assert policy["strategies"] == [{"type": "Restart", "verifyWithin": "30s"}]
    assert policy["limits"] == {"cooldown": "0s", "healthyDelay": "2s"}


def test_defaults_reach_objects_that_were_begun(cluster: Cluster) -> None:
    (item,) = load(MANIFESTS / "good" / "workload-with-multicast.yaml")
    created = cluster.create(item, "default", dry_run=True)
    assert created["spec"]["ros"] == {"domainId": 0, "discovery": {"mode": "Multicast"}}


def test_template_and_reference_cannot_be_exchanged(cluster: Cluster, make) -> None:
    workload = make("workload-of-a-deployment")
    template = load(MANIFESTS / "good" / "workload-with-a-template.yaml")[0]["spec"]["template"]
    with pytest.raises(Refused, match=r"spec: .*template cannot be replaced by workloadRef"):
        cluster.patch(workload, {"spec": {"workloadRef": None, "template": template}})


def test_another_controller_can_be_referred_to(cluster: Cluster, make) -> None:
    workload = make("workload-of-a-deployment")
    changed = cluster.patch(workload, {"spec": {"workloadRef": {"name": "nav3"}}})
    assert changed["metadata"]["generation"] == 2


def test_readiness_is_immutable(cluster: Cluster, make) -> None:
    pool = make("pool-executing")
    with pytest.raises(Refused, match=r"spec.readiness: .*readiness is immutable"):
        cluster.patch(pool, {"spec": {"readiness": "Initialized"}})


def test_a_shared_pool_scales(cluster: Cluster, make) -> None:
    pool = make("pool-shared")
    name, namespace = pool["metadata"]["name"], pool["metadata"]["namespace"]
    cluster.kubectl("scale", "fbp", name, "--replicas=7", "--namespace", namespace)
    assert cluster.get(API_VERSION, "FallbackPool", name, namespace)["spec"]["replicas"] == 7
    cluster.patch(pool, {"status": {"replicas": 3, "selector": "understudy.dev/pool=spare"}}, subresource="status")
    scale = cluster.get(API_VERSION, "FallbackPool", name, namespace, "scale")
    assert scale["spec"] == {"replicas": 7}
    assert scale["status"] == {"replicas": 3, "selector": "understudy.dev/pool=spare"}


def test_a_pool_whose_size_follows_the_failures_does_not_scale(cluster: Cluster, make) -> None:
    pool = make("pool-with-sizing")
    with pytest.raises(Refused, match=r"spec.replicas: .*Remove sizing to set replicas"):
        cluster.patch(pool, {"spec": {"replicas": 3}}, subresource="scale")
    by_hand = cluster.patch(pool, {"spec": {"replicas": 3, "sizing": None}})
    assert by_hand["spec"]["replicas"] == 3


def test_a_pool_per_workload_does_not_scale(cluster: Cluster, make) -> None:
    pool = make("pool-executing")
    with pytest.raises(Refused, match="needs perWorkload"):
        cluster.patch(pool, {"spec": {"replicas": 3}}, subresource="scale")


def test_status_is_written_apart_from_the_spec(cluster: Cluster, make) -> None:
    workload = make("workload-of-a-deployment")
    cluster.patch(workload, {"status": {"health": "Healthy"}})
    assert "status" not in cluster.get(
        API_VERSION, "RobotWorkload", workload["metadata"]["name"], workload["metadata"]["namespace"]
    )
    after = cluster.patch(workload, {"status": {"health": "Healthy"}, "spec": {"outputs": []}}, subresource="status")
    assert after["status"] == {"health": "Healthy"}
    assert after["spec"] == workload["spec"]
    assert after["metadata"]["generation"] == 1


def test_operator_and_monitor_each_own_their_part_of_the_status(cluster: Cluster, make) -> None:
    workload = make("workload-of-a-deployment")
    metadata = {"name": workload["metadata"]["name"]}
    namespace = workload["metadata"]["namespace"]
    identity = {"apiVersion": API_VERSION, "kind": "RobotWorkload", "metadata": metadata}

    def apply(manager: str, status: Object) -> Object:
        body = copy.deepcopy(identity) | {"status": status}
        return cluster.apply(body, namespace, subresource="status", manager=manager)["status"]

    accepted = _condition("Accepted", "True")
    healthy = _condition("Healthy", "True")
    recovery = {
        "id": "1",
        "reason": "no /cmd_vel for 500 ms",
        "result": "Recovered",
        "parts": {"detection": 0.5, "cluster": 0, "startup": 0, "reinitialization": 1e-6},
        "moments": {"detected": "2026-01-02T03:04:05.678901Z"},
    }
    apply("understudy-operator", {"standby": "Executing (1/1)", "conditions": [accepted]})
    both = apply("understudy-monitor", {"health": "Healthy", "conditions": [healthy], "recoveries": [recovery]})
    assert both["standby"] == "Executing (1/1)"
    assert both["conditions"] == [accepted, healthy]
    assert both["recoveries"] == [recovery], "nothing is filled in that nobody said"
    without = apply("understudy-monitor", {"health": "Failed"})
    assert without == {"standby": "Executing (1/1)", "health": "Failed", "conditions": [accepted]}


async def test_a_status_with_fields_of_a_newer_version_is_taken_but_for_these(cluster: Cluster, make) -> None:
    workload = make("workload-of-a-deployment")
    namespace, name = workload["metadata"]["namespace"], workload["metadata"]["name"]
    known: Object = {
        "health": "Healthy",
        "gate": {"epoch": 3, "active": "a"},
        "recoveries": [{"id": "1", "reason": "r", "result": "Recovered"}],
        "conditions": [_condition("Accepted", "True"), _condition("Healthy", "True")],
    }
    said = copy.deepcopy(known) | {"mood": "bright"}
    said["gate"]["colour"] = "green"
    said["recoveries"][0]["cost"] = {"euro": 3}
    said["conditions"][1]["because"] = "of it"
    body: Object = {"apiVersion": API_VERSION, "kind": "RobotWorkload", "metadata": {"name": name}, "status": said}
    async with Client(load_access(str(cluster.kubeconfig))) as client:
        answer, unknown = await apply_declared(
            client, WORKLOADS, namespace, body, manager="understudy-monitor", subresource="status"
        )
    assert answer["status"] == known
    assert set(unknown) == {
        ".status.mood",
        ".status.gate.colour",
        ".status.recoveries[0].cost",
        '.status.conditions[type="Healthy"].because',
    }


@pytest.mark.parametrize(
    ("status", "field"),
    [
        ({"health": "Fine"}, "status.health"),
        ({"lastRecoveryTime": "yesterday"}, "status.lastRecoveryTime"),
        ({"conditions": [{"type": "Ready", "status": "True"}]}, "status.conditions[0].reason"),
        (
            {
                "conditions": [
                    {"type": "R", "status": "yes", "reason": "R", "lastTransitionTime": "2026-01-02T03:04:05Z"}
                ]
            },
            "status.conditions[0].status",
        ),
        (
            {"recoveries": [{"id": str(i), "reason": "r", "result": "Recovered"} for i in range(11)]},
            "status.recoveries",
        ),
    ],
    ids=["health", "time", "condition-without-a-reason", "condition-status", "too-many-recoveries"],
)
def test_a_bad_status_is_refused(cluster: Cluster, make, status: Object, field: str) -> None:
    with pytest.raises(Refused, match=field.replace("[", r"\[").replace("]", r"\]")):
        cluster.patch(make("workload-of-a-deployment"), {"status": status}, subresource="status")


@pytest.mark.parametrize(
    ("path", "texts"),
    [
        ("robotworkload", ["One application of one robot", "spec\t<Object> -required-"]),
        (
            "rw.spec",
            [
                "failurePolicyRef\t<Object> -required-",
                "outputs\t<[]Object> -required-",
                "The gate controls all of them",
            ],
        ),
        ("rw.spec.outputs", ["type\t<string> -required-", "ROS type, such as geometry_msgs/msg/Twist"]),
        ("rw.spec.ros.discovery", ["enum: Managed, External, Multicast", "runs a Fast DDS discovery server"]),
        ("rw.spec.template.spec", ["containers\t<[]Object> -required-"]),
        ("rw.status.recoveries.parts", ["detection\t<number>", "From the last healthy output"]),
        ("fp.spec.strategies", ["verifyWithin\t<string>", "an instance from a pool takes over"]),
        ("fbp.spec", ["readiness\t<string> -required-", "held (start later) until a workload claims"]),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_kubectl_explains_the_fields(cluster: Cluster, path: str, texts: list[str]) -> None:
    # The published OpenAPI follows a changed definition within seconds, not at once.
    def missing() -> list[str]:
        page = " ".join(cluster.kubectl("explain", path).replace("\t", "TAB").split()).replace("TAB", "\t")
        return [text for text in texts if text not in page]

    until(lambda: not missing(), f"kubectl explain {path} to say {texts}")


def test_printed_columns(cluster: Cluster, make) -> None:
    workload = make("workload-of-a-deployment")
    policy, pool = make("policy-short"), make("pool-executing")
    namespace = workload["metadata"]["namespace"]
    cluster.patch(
        workload,
        {
            "status": {
                "active": "robot-17-7k2xq",
                "health": "Healthy",
                "standby": "Executing (1/1)",
                "strategy": "Executing",
                "strategies": "Executing (hot), Restart",
                "recoveryCount": 3,
                "conditions": [_condition("Protected", "True")],
                "lastRecoveryTime": workload["metadata"]["creationTimestamp"],
                "situation": {"name": "carrying", "since": workload["metadata"]["creationTimestamp"]},
                "kept": "/amcl_pose, /map",
                "state": [
                    {"name": "/amcl_pose", "kind": "Topic", "takenAt": workload["metadata"]["creationTimestamp"]},
                    {"name": "/map", "kind": "Topic"},
                ],
            }
        },
        subresource="status",
    )
    cluster.patch(
        policy,
        {"status": {"workloads": 2, "strategies": "Restart", "conditions": [_condition("Accepted", "True")]}},
        subresource="status",
    )
    cluster.patch(pool, {"status": {"desired": 2, "ready": 1, "claimed": 0}}, subresource="status")

    rows = _table(cluster.kubectl("get", "rw", "--namespace", namespace))
    assert rows[0] == ["NAME", "ACTIVE", "HEALTH", "PROTECTED", "STANDBY", "STRATEGY", "RECOVERIES", "LAST", "AGE"]
    assert rows[1][:7] == ["robot-17", "robot-17-7k2xq", "Healthy", "True", "Executing (1/1)", "Executing", "3"]
    assert rows[1][7].endswith("s")
    wide = dict(zip(*_table(cluster.kubectl("get", "rw", "--namespace", namespace, "-o", "wide"))[:2], strict=True))
    assert wide["ORDER"] == "Executing (hot), Restart"
    assert wide["SITUATION"] == "carrying"
    assert wide["KEPT"] == "/amcl_pose, /map"
    assert wide["TAKEN"].endswith("s")
    rows = _table(cluster.kubectl("get", "fp", "--namespace", namespace))
    assert rows[0] == ["NAME", "ACCEPTED", "WORKLOADS", "STRATEGIES", "AGE"]
    assert rows[1][:4] == ["navigation", "True", "2", "Restart"]
    rows = _table(cluster.kubectl("get", "fbp", "--namespace", namespace))
    assert rows[0] == ["NAME", "READINESS", "DESIRED", "READY", "CLAIMED", "AGE"]
    assert rows[1][:5] == ["hot", "Executing", "2", "1", "0"]


def test_one_word_lists_all_three_kinds(cluster: Cluster, make) -> None:
    namespace = make("workload-of-a-deployment")["metadata"]["namespace"]
    make("policy-short")
    make("pool-executing")
    listed = cluster.kubectl("get", "understudy", "--namespace", namespace, "--output", "name").split()
    assert sorted(listed) == [
        "failurepolicy.understudy.dev/navigation",
        "fallbackpool.understudy.dev/hot",
        "robotworkload.understudy.dev/robot-17",
    ]


def test_people_with_the_cluster_role_view_may_see_and_edit_may_change(cluster: Cluster, release: Release) -> None:
    def rules(name: str) -> set[tuple[str, str]]:
        role = cluster.get("rbac.authorization.k8s.io/v1", "ClusterRole", name)
        return {
            (resource, verb)
            for rule in role["rules"]
            if "understudy.dev" in rule.get("apiGroups", [])
            for resource in rule["resources"]
            for verb in rule["verbs"]
        }

    def settled() -> bool:
        return ("robotworkloads", "list") in rules("view") and ("robotworkloads", "create") in rules("edit")

    until(settled, "the roles view and edit to be put together")
    assert {verb for _, verb in rules("view")} == {"get", "list", "watch"}
    assert ("fallbackpools/scale", "patch") in rules("edit")
    assert not any(
        resource == "robotworkloads/status" and verb in ("patch", "update") for resource, verb in rules("edit")
    )


def _condition(kind: str, status: str) -> Object:
    return {"type": kind, "status": status, "reason": "Tested", "lastTransitionTime": "2026-01-02T03:04:05Z"}


def _table(text: str) -> list[list[str]]:
    """The cells of what kubectl prints: columns are apart by three spaces."""
    return [[cell.strip() for cell in line.split("   ") if cell.strip()] for line in text.strip().splitlines()]


def _contains(found: object, said: object) -> bool:
    if isinstance(said, dict):
        return isinstance(found, dict) and all(key in found and _contains(found[key], said[key]) for key in said)
    if isinstance(said, list):
        return isinstance(found, list) and len(found) == len(said) and all(map(_contains, found, said))
    return found == said

"""What the author of a RobotWorkload, a FailurePolicy or a FallbackPool may have the operator do, asked of a real API server."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest

from tests.cluster.conftest import Release
from tests.cluster.monitor_accounts import allow, refusal, until_refused
from tests.cluster.operators import hot, policy, spare, template, workload
from tests.cluster.strangers.conftest import PODS, refers, user_with
from tests.support.cluster import Cluster, Object, Refused, account, until
from understudy.api import names

NETWORKS: Object = {"apiGroups": ["networking.k8s.io"], "resources": ["networkpolicies"], "verbs": ["create"]}
DEPLOYMENT: Object = {
    "apiGroups": ["apps"],
    "resources": ["deployments"],
    "resourceNames": ["nav2"],
    "verbs": ["patch"],
}
STATEFUL_SET: Object = DEPLOYMENT | {"resources": ["statefulsets"]}
IMAGE = "registry.example/mine:1"
MUCH: Object = {"requests": {"cpu": "8"}, "limits": {"memory": "64Gi"}}
ROBOTS = {"robots": ["10.7.0.0/24"]}
PEERS: Object = {"peers": [{"namespaceSelector": {}}]}


def _template(**spec: object) -> Object:
    found = template()
    found["spec"] |= spec
    return found


def _keeps(claim: str) -> Object:
    found = policy("hot")
    found["spec"]["state"] = {"storage": {"claimName": claim}}
    return found


SECRET = {"name": "stolen", "secret": {"secretName": "root-password"}}

ATTACKS: dict[str, tuple[Object, str]] = {
    "template": (workload(), "spec.template"),
    "service-account": (workload(template=_template(serviceAccountName="admin")), "spec.template"),
    "secret": (workload(template=_template(volumes=[SECRET])), "spec.template"),
    "pool": (spare(), "spec.template"),
    "deployment": (refers("database"), "spec.workloadRef"),
    "stateful-set": (refers("database", "StatefulSet"), "spec.workloadRef"),
    "storage": (_keeps("accounts"), "spec.state.storage.claimName"),
    "resources": (refers(monitor={"resources": MUCH}), "spec.monitor.resources"),
}
"""What a tenant creates, with the field that is refused."""

CHANGES: dict[str, tuple[Object, Object, str]] = {
    "template": (workload(), {"template": _template(serviceAccountName="admin")}, "spec.template"),
    "image-beside-a-template": (workload(), {"monitor": {"image": IMAGE}}, "spec.monitor.image"),
    "image-beside-a-reference": (refers(), {"monitor": {"image": IMAGE}}, "spec.monitor.image"),
    "other-image": (refers(monitor={"image": "a"}), {"monitor": {"image": IMAGE}}, "spec.monitor.image"),
    "resources": (workload(), {"monitor": {"resources": MUCH}}, "spec.monitor.resources"),
    "other-resources": (
        refers(monitor={"resources": {"limits": {"memory": "1Gi"}}}),
        {"monitor": {"resources": MUCH}},
        "spec.monitor.resources",
    ),
    "no-limit": (
        refers(monitor={"resources": MUCH}),
        {"monitor": {"resources": {"limits": None}}},
        "spec.monitor.resources",
    ),
    "robots": (workload(), {"gate": ROBOTS}, "spec.gate.robots"),
    "more-robots": (workload(gate=ROBOTS), {"gate": {"robots": ["10.7.0.0/24", "10.8.0.0/16"]}}, "spec.gate.robots"),
    "peers": (workload(), {"gate": PEERS}, "spec.gate.peers"),
    "other-peers": (workload(gate=PEERS), {"gate": {"peers": [{"podSelector": {}}]}}, "spec.gate.peers"),
    "reference": (refers(), {"workloadRef": {"name": "database"}}, "spec.workloadRef"),
    "kind-of-reference": (refers(), {"workloadRef": {"kind": "StatefulSet"}}, "spec.workloadRef"),
    "pool": (spare(), {"template": _template(serviceAccountName="admin")}, "spec.template"),
    "storage": (policy("hot"), {"state": {"storage": {"claimName": "accounts"}}}, "spec.state.storage.claimName"),
    "other-storage": (_keeps("mine"), {"state": {"storage": {"claimName": "yours"}}}, "spec.state.storage.claimName"),
}
"""An object of somebody else, what a tenant changes, and the field that is refused."""

HARMLESS: dict[str, tuple[Object, Object]] = {
    "label": (workload(), {"metadata": {"labels": {"team": "blue"}}}),
    "request": (workload(), {"metadata": {"annotations": {names.SWITCHOVER: "now"}}}),
    "finalizer": (workload(), {"metadata": {"finalizers": ["example.com/stay"]}}),
    "pause": (workload(gate=ROBOTS), {"spec": {"pause": {"reason": "cleaning", "owner": "me"}}}),
    "reference-stays": (refers(monitor={"image": IMAGE}), {"spec": {"poolPriority": 3}}),
    "default-image": (workload(monitor={"image": IMAGE}), {"spec": {"monitor": {"image": None}}}),
    "default-resources": (workload(monitor={"resources": MUCH}), {"spec": {"monitor": {"resources": None}}}),
    "fewer-robots": (workload(gate={"robots": ["10.7.0.0/24", "10.8.0.0/24"]}), {"spec": {"gate": ROBOTS}}),
    "no-peers": (workload(gate=PEERS), {"spec": {"gate": {"peers": []}}}),
    "resize": (spare(1), {"spec": {"replicas": 2}}),
    "limits": (_keeps("mine"), {"spec": {"limits": {"cooldown": "1m"}}}),
    "no-storage": (_keeps("mine"), {"spec": {"state": {"storage": None}}}),
}
"""An object of somebody else, and a change for which rights on the kinds suffice."""

RIGHTS: dict[str, tuple[Object, Object]] = {
    "template": (workload(), PODS),
    "pool": (spare(), PODS),
    "storage": (_keeps("mine"), PODS),
    "deployment": (refers(), DEPLOYMENT),
    "stateful-set": (refers(kind="StatefulSet"), STATEFUL_SET),
}
"""An object, and the right that its author needs besides those on the kinds."""


@pytest.mark.parametrize(("item", "field"), ATTACKS.values(), ids=ATTACKS)
def test_a_tenant_creates_nothing_that_uses_rights_of_the_operator(
    cluster: Cluster, namespace: str, tenant: str, item: Object, field: str
) -> None:
    message = refusal(lambda: cluster.create(item, namespace, user=tenant))
    assert f"{tenant} may not set {field} of {item['kind']} {namespace}/{item['metadata']['name']}" in message
    assert f"in namespace {namespace}" in message


@pytest.mark.parametrize("item", [workload(), policy("hot"), hot()], ids=["workload", "policy", "pool"])
def test_nobody_gives_an_object_so_many_labels_that_its_status_has_no_room(
    cluster: Cluster, namespace: str, item: Object, release: Release
) -> None:
    few, many = ({f"a{index}": "b" for index in range(number)} for number in (200, 201))
    words = "metadata.labels of .* must have at most 200 entries; it has 201"
    labelled = {**item, "metadata": {**item["metadata"], "labels": many}}
    with pytest.raises(Refused, match=words):
        cluster.create(labelled, namespace)
    made = cluster.create({**item, "metadata": {**item["metadata"], "labels": few}}, namespace)
    with pytest.raises(Refused, match=words):
        cluster.patch(made, {"metadata": {"labels": many}})


def test_a_tenant_mounts_no_host_path_where_pods_may(cluster: Cluster, namespace: str, tenant: str) -> None:
    space = cluster.get("v1", "Namespace", namespace)
    cluster.patch(space, {"metadata": {"labels": {"pod-security.kubernetes.io/enforce": "privileged"}}})
    item = workload(template=_template(volumes=[{"name": "root", "hostPath": {"path": "/"}}]))
    assert "may not set spec.template" in refusal(lambda: cluster.create(item, namespace, user=tenant))


@pytest.mark.parametrize(("item", "spec", "field"), CHANGES.values(), ids=CHANGES)
def test_a_tenant_does_not_change_what_others_created_to_use_rights_of_the_operator(
    cluster: Cluster, namespace: str, tenant: str, item: Object, spec: Object, field: str
) -> None:
    made = cluster.create(item, namespace)
    message = refusal(lambda: cluster.patch(made, {"spec": spec}, user=tenant))
    assert f"{tenant} may not set {field} of {item['kind']} {namespace}/{item['metadata']['name']}" in message
    assert cluster.patch(made, {"spec": spec})["spec"] != made["spec"], "the cluster's administrator may"


@pytest.mark.parametrize(("item", "change"), HARMLESS.values(), ids=HARMLESS)
def test_a_tenant_changes_everything_else(
    cluster: Cluster, namespace: str, tenant: str, item: Object, change: Object
) -> None:
    made = cluster.create(item, namespace)
    changed = cluster.patch(made, change, user=tenant)
    assert changed["metadata"]["resourceVersion"] != made["metadata"]["resourceVersion"]
    if changed["metadata"].get("finalizers"):
        cluster.patch(made, {"metadata": {"finalizers": None}}, user=tenant)
    cluster.delete(changed, user=tenant)


def test_a_tenant_creates_what_needs_no_rights_of_the_operator(cluster: Cluster, namespace: str, tenant: str) -> None:
    for item in (policy("hot"), hot(), spare(templateFrom={"workload": "w"})):
        cluster.create(item, namespace, user=tenant)
    pool = cluster.get(f"{names.GROUP}/v1alpha1", "FallbackPool", "spare", namespace)
    cluster.patch(pool, {"spec": {"replicas": 5}}, subresource="scale", user=tenant)


@pytest.mark.parametrize(("item", "rule"), RIGHTS.values(), ids=RIGHTS)
def test_an_author_with_the_right_creates_it(
    cluster: Cluster, release: Release, namespace: str, item: Object, rule: Object
) -> None:
    author = user_with(cluster, namespace, "author@example.com", rule)
    cluster.create(item, namespace, user=author)


def test_an_author_who_creates_pods_chooses_the_monitor_s_image_and_no_controller(
    cluster: Cluster, namespace: str, author: str
) -> None:
    cluster.create(workload(monitor={"image": IMAGE}), namespace, user=author)
    assert "may not set spec.workloadRef" in refusal(lambda: cluster.create(refers(), namespace, user=author))


def test_an_author_who_creates_networkpolicies_chooses_robots_and_peers(
    cluster: Cluster, release: Release, namespace: str
) -> None:
    author = user_with(cluster, namespace, "author@example.com", NETWORKS, DEPLOYMENT)
    cluster.create(refers(gate=ROBOTS | PEERS), namespace, user=author)


def test_whoever_may_edit_the_namespace_may_write_all_of_it(cluster: Cluster, release: Release, namespace: str) -> None:
    group = "rbac.authorization.k8s.io"
    cluster.create(
        {
            "apiVersion": f"{group}/v1",
            "kind": "RoleBinding",
            "metadata": {"name": "editor"},
            "roleRef": {"apiGroup": group, "kind": "ClusterRole", "name": "edit"},
            "subjects": [{"kind": "User", "name": "editor@example.com", "apiGroup": group}],
        },
        namespace,
    )
    items = (
        workload(monitor={"image": IMAGE}, gate=ROBOTS),
        {**refers(), "metadata": {"name": "referring"}},
        _keeps("mine"),
        spare(),
    )
    for item in items:
        until(
            lambda item=item: _allowed(lambda: cluster.create(item, namespace, user="editor@example.com")),  # type: ignore[misc]
            "the role binding to count",
        )


def _allowed(action: Callable[[], object]) -> bool:
    try:
        action()
    except Refused as error:
        if "ValidatingAdmissionPolicy" in error.message:
            raise
        return False
    return True


@pytest.mark.parametrize("who", ["operator", "monitor"])
def test_the_accounts_of_understudy_write_the_status(
    cluster: Cluster, release: Release, namespace: str, tenant: str, who: str
) -> None:
    made = cluster.create(workload(monitor={"image": IMAGE}, gate=ROBOTS), namespace)
    user = release.user
    if who == "monitor":
        user = account(namespace, names.monitor_account("w"))
        rule = {"apiGroups": [names.GROUP], "resources": ["robotworkloads/status"], "verbs": ["patch"]}
        allow(cluster, namespace, user, rule)
    body = {"status": {"recoveryCount": 1}}
    until(lambda: _allowed(lambda: cluster.patch(made, body, subresource="status", user=user)), "its rights to count")


def test_the_account_of_helm_test_asks_whether_a_workload_is_accepted(
    cluster: Cluster, release: Release, tenant: str
) -> None:
    user = account(release.namespace, f"{release.name}-test-understudy-monitor")
    cluster.create(refers("verified"), release.namespace, user=user, dry_run=True)
    assert "may not set spec.workloadRef" in refusal(
        lambda: cluster.create(refers(), release.namespace, user=user, dry_run=True)
    )


def test_a_large_template_is_within_the_cost_limit_of_the_policies(
    cluster: Cluster, namespace: str, author: str
) -> None:
    app = template()["spec"]["containers"][0]
    variables = [{"name": f"VARIABLE_{number}", "value": "x" * 40} for number in range(250)]
    ports = [{"containerPort": number + 1} for number in range(50)]
    containers = [{**app, "name": f"app-{number}", "env": variables, "ports": ports} for number in range(32)]
    volumes = [{"name": f"v{number}", "configMap": {"name": "settings"}} for number in range(200)]
    item = workload(template=_template(containers=containers, initContainers=containers, volumes=volumes))
    made = cluster.create(item, namespace, user=author)
    changed = copy.deepcopy(item["spec"]["template"])
    changed["spec"]["volumes"].pop()
    cluster.patch(made, {"spec": {"template": changed}}, user=author)


@pytest.fixture
def earlier(cluster: Cluster, namespace: str, author: str) -> Object:
    """A RobotWorkload from before images were listed."""
    return cluster.create(workload("earlier", monitor={"image": "earlier:1"}), namespace, user=author)


@pytest.fixture
def listed(
    cluster: Cluster, namespace: str, author: str, earlier: Object, author_policies: Callable[..., None]
) -> None:
    """Images of monitors are listed for the namespace."""
    author_policies(monitorImages=[IMAGE, "registry.example/fleet/*"])
    until_refused(
        lambda: _create_with(cluster, namespace, author, "other:1"), "may only be one of", "the list to be enforced"
    )


def _create_with(cluster: Cluster, namespace: str, author: str, image: str) -> None:
    cluster.create(workload(monitor={"image": image}), namespace, user=author, dry_run=True)


@pytest.mark.usefixtures("listed")
def test_only_images_of_the_list_are_monitors(cluster: Cluster, namespace: str, author: str) -> None:
    for image in (IMAGE, "registry.example/fleet/nav:2", "understudy/monitor:0.2.0"):
        _create_with(cluster, namespace, author, image)
    for image in ("other:1", IMAGE + "0", "registry.example/fleet", "registry.example/fleet-of-others/nav:2"):
        message = refusal(lambda image=image: _create_with(cluster, namespace, author, image))  # type: ignore[misc]
        assert f"spec.monitor.image of RobotWorkload {namespace}/w is {image}, but may only be one of" in message
        assert "registry.example/fleet/*" in message


@pytest.mark.usefixtures("listed")
def test_an_image_from_before_the_list_stays(cluster: Cluster, author: str, earlier: Object) -> None:
    cluster.patch(earlier, {"spec": {"poolPriority": 1}}, user=author)
    image = {"spec": {"monitor": {"image": "other:1"}}}
    assert "may only be one of" in refusal(lambda: cluster.patch(earlier, image, user=author))

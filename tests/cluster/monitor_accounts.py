"""Accounts of monitors, with the rights that the operator gives them, and users with rights of their own."""

from __future__ import annotations

import base64
import copy
import ssl
from collections.abc import Callable, Sequence

import pytest
import yaml

from tests.support.cluster import Cluster, Object, Refused, account, until
from understudy.api import names
from understudy.controller.desired import monitor_deployment
from understudy.kube.client import Access
from understudy.kube.gates.base import GateKind, Reach
from understudy.kube.gates.kinds.network_policy import GATE

MINE, OTHER = "robot-17", "robot-18"
ACTIVE, STANDBY = "robot-17-a", "robot-17-b"
OWNER = {"apiVersion": f"{names.GROUP}/none", "kind": "RobotWorkload", "name": MINE, "uid": "uid-w", "controller": True}
"""An owner, of a version that does not exist: the garbage collector does not look for it."""

NOWHERE = {"containers": [{"name": "c", "image": "none.invalid/none"}], "nodeSelector": {"no": "node"}}
"""The spec of a pod on no node, for tests of who may write a pod, not of what it does."""


def create(
    cluster: Cluster,
    namespace: str,
    workload: str,
    *,
    source: tuple[str, str] = ("Deployment", "nav2"),
    pools: Sequence[str] = ("spare",),
    kind: GateKind = GATE,
) -> str:
    """Create the account of a workload's monitor and its rights, and return its user name. ``kind`` is that of its gate."""
    for _, item in monitor_deployment.access(workload, source=source, policy="policy", pools=pools, gate=kind):
        item = copy.deepcopy(item)
        for subject in item.get("subjects", ()):
            subject["namespace"] = namespace
        cluster.create(item, namespace)
    return account(namespace, names.monitor_account(workload))


def allow(cluster: Cluster, namespace: str, user: str, *rules: Object) -> None:
    """Give a user the rights of these rules in a namespace."""
    group, name = "rbac.authorization.k8s.io", f"allowed-{user.split(':')[-1].split('@')[0]}"
    role: Object = {"apiVersion": f"{group}/v1", "kind": "Role", "metadata": {"name": name}}
    cluster.create({**role, "rules": list(rules)}, namespace)
    subject = {"kind": "User", "name": user, "apiGroup": group}
    reference = {"apiGroup": group, "kind": "Role", "name": name}
    cluster.create({**role, "kind": "RoleBinding", "roleRef": reference, "subjects": [subject]}, namespace)


def access(cluster: Cluster, namespace: str, workload: str) -> Access:
    """Return the access of a monitor's pod to the API server, with a token of its account."""
    path = cluster.path("v1", "ServiceAccount", namespace, names.monitor_account(workload), "token")
    request = {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest", "spec": {}}
    token = cluster.request("POST", path, body=request)["status"]["token"]
    server = yaml.safe_load(cluster.kubeconfig.read_text())["clusters"][0]["cluster"]
    authority = base64.b64decode(server["certificate-authority-data"]).decode()
    return Access(server=server["server"], context=ssl.create_default_context(cadata=authority), token=token)


def gate() -> Object:
    """Return the gate of MINE at epoch 7, open for ACTIVE."""
    made = GATE.closed(MINE, Reach(), epoch=7)
    made["metadata"] |= {"labels": {"app.kubernetes.io/managed-by": "understudy"}, "ownerReferences": [OWNER]}
    made["metadata"]["annotations"] |= {names.ACTIVE: ACTIVE, names.ACTIVE_UID: "uid-a"}
    made["spec"]["podSelector"] = {
        "matchExpressions": GATE.routing(MINE, ACTIVE)["spec"]["podSelector"]["matchExpressions"]
    }
    return made


def until_refused(action: Callable[[], object], words: str, what: str) -> None:
    """Repeat an action until the API server refuses it with these words: roles and policies take effect once its watches have seen them."""

    def effective() -> bool:
        try:
            action()
        except Refused as error:
            return words in error.message
        return False

    until(effective, what)


def refusal(action: Callable[[], object]) -> str:
    """Return the message with which the API server forbids an action."""
    with pytest.raises(Refused) as refused:
        action()
    assert (refused.value.status, refused.value.reason) == (403, "Forbidden")
    return refused.value.message

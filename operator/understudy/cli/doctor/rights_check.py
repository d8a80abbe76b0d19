"""Checks the rights of the user and of the operator's account, by access reviews of the API server, which change nothing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from understudy.api import names
from understudy.cli.common.cluster_access.kubectl_proxy import Api, Refused
from understudy.cli.doctor.findings import Finding
from understudy.cli.doctor.installation_check import Installed
from understudy.controller.desired import monitor_deployment
from understudy.kube.client import Object
from understudy.kube.gates import registry

_REVIEWS = "/apis/authorization.k8s.io/v1"


@dataclass(frozen=True)
class Right:
    """A verb on a resource, and what needs it."""

    group: str
    resource: str
    verb: str
    use: str = ""

    def attributes(self, namespace: str) -> Object:
        """Return the attributes of an access review."""
        resource, _, sub = self.resource.partition("/")
        return {
            "namespace": namespace,
            "group": self.group,
            "resource": resource,
            "subresource": sub,
            "verb": self.verb,
        }

    @property
    def words(self) -> str:
        """Return the right as ``kubectl auth can-i`` takes it."""
        return f"{self.verb} {self.resource}{f'.{self.group}' if self.group else ''}"


def _each(group: str, resource: str, verbs: str, use: str) -> list[Right]:
    return [Right(group, resource, verb, use) for verb in verbs.split()]


def _fencing(verbs: str, use: str = "") -> list[Right]:
    return [right for one in registry.FENCING_RESOURCES for right in _each(one.group, one.plural, verbs, use)]


OURS = (
    *_each(names.GROUP, "robotworkloads", "get list watch", "status"),
    *_each(names.GROUP, "fallbackpools", "list", "status"),
    *_each(names.GROUP, "failurepolicies", "list", "explain"),
    *_each("", "pods", "list", "explain, doctor"),
    *_fencing("list", "status, explain"),
    *_fencing("watch", "status"),
    *_each("", "events", "list", "explain"),
    *_each("", "pods/portforward", "create", "tree"),
    *_each(names.GROUP, "robotworkloads", "patch", "pause, resume, failover, failback"),
    *_fencing("get", "status NAME, fence, doctor"),
    *_fencing("patch", "fence, doctor"),
    *_each("", "configmaps", "get", "robot-profile, doctor"),
    *_each("", "pods", "get delete", "inject, doctor"),
    *_each("", "pods/exec", "create", "inject, doctor"),
    *_each("", "pods/ephemeralcontainers", "patch", "inject partition"),
    *_each("", "pods/log", "get", "inject partition"),
    *_each("", "pods", "create", "doctor"),
    *_each(registry.DEFAULT.resource.group, registry.DEFAULT.resource.plural, "create delete", "doctor"),
)
"""The rights that the verbs of this command need."""


def operators() -> Iterator[Right]:
    """Yield the rights that the operator needs in a namespace with robots: for what it creates there, and what it
    grants to monitors."""
    for group, resource, verbs in (
        (names.GROUP, "robotworkloads", "get list watch"),
        (names.GROUP, "robotworkloads/status", "patch"),
        (names.GROUP, "failurepolicies/status", "patch"),
        (names.GROUP, "fallbackpools/status", "patch"),
        ("", "events", "create patch"),
        ("", "pods", "create patch delete"),
        ("apps", "replicasets", "create patch delete"),
        ("apps", "deployments", "create patch delete"),
        *((one.group, one.plural, "create patch") for one in registry.FENCING_RESOURCES),
        (registry.DEFAULT.resource.group, registry.DEFAULT.resource.plural, "delete"),
        ("policy", "poddisruptionbudgets", "create patch delete"),
        ("", "services", "create patch delete"),
        ("", "configmaps", "create patch delete"),
        ("", "secrets", "create patch delete"),
        ("", "serviceaccounts", "create patch delete"),
        ("rbac.authorization.k8s.io", "roles", "create patch delete"),
        ("rbac.authorization.k8s.io", "rolebindings", "create patch delete"),
    ):
        yield from _each(group, resource, verbs, "")
    for kind, item in monitor_deployment.access("robot", source=("ReplicaSet", "robot"), policy=None, pools=["pool"]):
        if kind == "Role":
            for rule in item["rules"]:
                for resource in rule["resources"]:
                    yield from _each(rule["apiGroups"][0], resource, " ".join(rule["verbs"]), "")


def of_this_user(api: Api, namespace: str) -> Finding:
    """Check whether the user has the rights that the verbs of this command need."""
    check = "your rights"
    missing = _missing(api, namespace, OURS, "selfsubjectaccessreviews", {})
    if not missing:
        return Finding(check, "OK", f"you have all rights that the verbs of this command need in {namespace}")
    listed = ", ".join(f"{right.words} (for {right.use})" for right in missing)
    return Finding(
        check,
        "WARN",
        f"you lack rights in {namespace}: {listed}",
        "if you need these verbs, ask an administrator for the ClusterRole edit (the chart's *-edit adds to it) in this namespace; "
        "that ClusterRole does not contain pods/ephemeralcontainers, which needs a Role",
    )


def of_the_operator(api: Api, namespace: str, found: Installed) -> Finding:
    """Check whether the operator has the rights for its work in a namespace."""
    check = "operator's rights"
    account = {"user": found.account, "groups": _groups(found)}
    try:
        missing = _missing(api, namespace, dict.fromkeys(operators()), "subjectaccessreviews", account)
    except Refused as refused:
        if refused.status != 403:
            raise
        cure = "run this as a user who may create subjectaccessreviews, such as a cluster administrator"
        return Finding(check, "WARN", "unknown: you are not allowed to review another account's rights", cure)
    if not missing:
        return Finding(check, "OK", f"{found.account} has all rights that it needs in {namespace}")
    return Finding(
        check,
        "FAIL",
        f"{found.account} lacks rights in {namespace}: {', '.join(right.words for right in missing)}",
        "helm upgrade the chart with rbac.create=true, or give the account the permissions of the chart's ClusterRole. "
        "An operator that is limited to some namespaces (watchNamespaces) needs them in this namespace",
    )


def _missing(api: Api, namespace: str, rights: Iterable[Right], review: str, account: Object) -> list[Right]:
    """Return the rights that an account lacks, by access reviews of a kind."""

    def allowed(right: Right) -> bool:
        spec = account | {"resourceAttributes": right.attributes(namespace)}
        body = {"apiVersion": "authorization.k8s.io/v1", "spec": spec}
        status = api.request("POST", f"{_REVIEWS}/{review}", body).body.get("status") or {}
        return bool(status.get("allowed"))

    return [right for right in rights if not allowed(right)]


def _groups(found: Installed) -> list[str]:
    """Return the groups to which the API server assigns a ServiceAccount."""
    namespace = found.item["metadata"]["namespace"]
    return ["system:serviceaccounts", f"system:serviceaccounts:{namespace}", "system:authenticated"]

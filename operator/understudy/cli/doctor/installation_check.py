"""Checks what is installed, and whether it fits this version: the operator, the kinds, and Kubernetes itself."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from understudy import __version__
from understudy.api import names
from understudy.api.base import VERSION
from understudy.api.schema.definitions import definitions
from understudy.cli.common.cluster_access.kubectl_proxy import Api, Refused
from understudy.cli.doctor.findings import Finding
from understudy.controller.plan import Images
from understudy.kube.client import CRDS, DEPLOYMENTS, Object

OLDEST = (1, 30)
"""The oldest Kubernetes version that serves what the chart contains (ValidatingAdmissionPolicy)."""

SELECTOR = "app.kubernetes.io/name=understudy,app.kubernetes.io/component=operator"

_UPGRADE = "helm upgrade the chart of the version that you want, and use this command of the same version"
_ENVIRONMENT = {
    "monitor": names.MONITOR_IMAGE_VARIABLE,
    "pull_policy": "UNDERSTUDY_IMAGE_PULL_POLICY",
    "pull_secrets": "UNDERSTUDY_IMAGE_PULL_SECRETS",
}


@dataclass(frozen=True)
class Installed:
    """The operator's Deployment."""

    item: Object

    @property
    def where(self) -> str:
        """Its namespace and name."""
        return f"{self.item['metadata']['namespace']}/{self.item['metadata']['name']}"

    @property
    def version(self) -> str:
        """The version that the chart states."""
        return str((self.item["metadata"].get("labels") or {}).get("app.kubernetes.io/version", ""))

    @property
    def account(self) -> str:
        """The user name of its ServiceAccount."""
        name = self.item["spec"]["template"]["spec"].get("serviceAccountName", "default")
        return f"system:serviceaccount:{self.item['metadata']['namespace']}:{name}"

    @property
    def images(self) -> Images | None:
        """The images from which it creates monitors; None if it does not state them."""
        (container, *_) = self.item["spec"]["template"]["spec"]["containers"]
        variables = {entry["name"]: entry.get("value", "") for entry in container.get("env") or []}
        settings = {key: variables.get(name, "") for key, name in _ENVIRONMENT.items()}
        if not settings["monitor"]:
            return None
        secrets = tuple(name for name in settings["pull_secrets"].split(",") if name)
        return Images(settings["monitor"], settings["pull_policy"] or "IfNotPresent", secrets)


def find(api: Api) -> Installed | None:
    """Return the installed operator; None if there is none, or if the user may not see it."""
    try:
        items = api.get(f"{DEPLOYMENTS.path(None)}?labelSelector={SELECTOR}")["items"]
    except Refused as refused:
        if refused.status != 403:
            raise
        return None
    return Installed(items[0]) if items else None


def kubernetes(api: Api) -> Finding:
    """Check whether the API server is new enough."""
    answer = api.get("/version")
    found = tuple(int(re.match(r"\d*", answer.get(key, ""))[0] or 0) for key in ("major", "minor"))  # type: ignore[index]
    version = answer.get("gitVersion", "")
    if found < OLDEST:
        return Finding("Kubernetes", "FAIL", version, f"use {'.'.join(map(str, OLDEST))} or newer")
    return Finding("Kubernetes", "OK", version)


def operator(found: Installed | None) -> Finding:
    """Check whether the operator runs, in this version."""
    if found is None:
        return Finding(
            "operator",
            "WARN",
            f"no Deployment with the labels {SELECTOR} is there, or you may not list Deployments of all namespaces",
            "helm install it (charts/understudy); or ask who may list them to run this",
        )
    spec, status = found.item["spec"], found.item.get("status") or {}
    ready, wanted = status.get("readyReplicas", 0), spec.get("replicas", 1)
    text = f"{found.where} version {found.version or 'unknown'}, {ready} of {wanted} ready"
    if not ready:
        namespace, _, name = found.where.partition("/")
        cure = f"kubectl describe deployment -n {namespace} {name}; failovers go on meanwhile, nothing new is set up"
        return Finding("operator", "FAIL", text, cure)
    if found.version != __version__:
        return Finding("operator", "WARN", f"{text}, and this command is of version {__version__}", _UPGRADE)
    if ready < wanted:
        return Finding("operator", "WARN", text, "kubectl get pods -A -l " + SELECTOR)
    return Finding("operator", "OK", text)


def definitions_served(api: Api) -> Iterator[Finding]:
    """Check whether the kinds are those of this version."""
    for wanted in definitions().values():
        name = wanted["metadata"]["name"]
        check = f"CRD {wanted['spec']['names']['plural']}"
        try:
            yield definition(check, wanted, api.get(CRDS.path(None, name)))
        except Refused as refused:
            if refused.status == 403:
                cure = "have somebody run this who may get customresourcedefinitions"
                yield Finding(check, "WARN", f"this cannot be determined: {refused}", cure)
            elif refused.status == 404:
                yield Finding(check, "FAIL", "it is not there", "helm install the chart, or kubectl apply -f crds/")
            else:
                raise


def definition(check: str, wanted: Object, live: Object) -> Finding:
    """Check whether a definition is that of this version."""
    version = next((one for one in live["spec"]["versions"] if one["name"] == VERSION), None)
    if version is None or not version.get("served"):
        return Finding(check, "FAIL", f"{VERSION} isn't served", _UPGRADE)
    refused = [
        c["message"]
        for c in (live.get("status") or {}).get("conditions") or []
        if (c["type"], c["status"])
        in (("Established", "False"), ("NamesAccepted", "False"), ("NonStructuralSchema", "True"))
    ]
    if refused:
        return Finding(check, "FAIL", f"the API server refuses it: {refused[0]}", _UPGRADE)
    expected = wanted["spec"]["versions"][0]
    others = list(differences(expected["schema"]["openAPIV3Schema"], version["schema"]["openAPIV3Schema"]))
    others += list(differences(expected.get("subresources"), version.get("subresources"), "subresources"))
    if others:
        more = f", and {len(others) - 1} more" if len(others) > 1 else ""
        cure = (
            f"the API server drops the fields that the CRD does not have: {_UPGRADE}. CRDs are upgraded with "
            "the chart unless crds.install is false"
        )
        return Finding(check, "FAIL", f"it is not that of version {__version__}: {others[0]}{more}", cure)
    return Finding(check, "OK", f"{VERSION} of version {__version__}")


def differences(wanted: Any, live: Any, path: str = "") -> Iterator[str]:
    """Yield the differences between two definitions as sentences. Descriptions are not compared."""
    if isinstance(wanted, Mapping) and isinstance(live, Mapping):
        for key in [*wanted, *(key for key in live if key not in wanted)]:
            if key == "description" and isinstance(wanted.get(key, ""), str):
                continue
            # Name the field as a reader would: the levels in between are keywords of the schema language.
            below = path if key in ("properties", "items", "additionalProperties") else f"{path}.{key}".lstrip(".")
            if key not in live:
                yield f"{below} is missing"
            elif key not in wanted:
                yield f"{below} is there, which this version does not know"
            else:
                yield from differences(wanted[key], live[key], below)
    elif _is_list(wanted) and _is_list(live) and len(wanted) == len(live):
        for one, other in zip(wanted, live, strict=True):
            yield from differences(one, other, path)
    elif wanted != live:
        yield f"{path} is another"


def _is_list(found: object) -> bool:
    return isinstance(found, Sequence) and not isinstance(found, str)

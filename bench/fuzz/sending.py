"""Requests to the API server with bodies that are texts, since Python's own encoder ends at deep values."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kubernetes import config
from kubernetes.client import Configuration
from urllib3.exceptions import HTTPError

from bench.fuzz.samples import Sample
from bench.fuzz.values import OWN, SLOTS, slot
from understudy.api import names
from understudy.kube.client import CONFIG_MAPS, POLICIES, POOLS, WORKLOADS, Resource
from understudy.kube.decoding import decode

RESOURCES: dict[str, Resource] = {
    "RobotWorkload": WORKLOADS, "FailurePolicy": POLICIES, "FallbackPool": POOLS, "ConfigMap": CONFIG_MAPS,
}  # fmt: skip

WITHIN = 60.0
"""Seconds within which an object that the API server stores must have a verdict. The next try after a refusal of a write is earlier."""

LENIENT = "fieldValidation=Ignore"
"""Unknown fields are dropped without a warning about each of them, of which there may be too many for an answer."""

JSON = "application/json"
PATCH = "application/json-patch+json"
MERGE = "application/merge-patch+json"


@dataclass(frozen=True)
class Sent:
    """What the cluster did with one object."""

    sample: Sample
    at: float
    status: int
    """The API server's answer to the object; 0 if there was none."""
    verdict: str = ""
    """The condition Accepted: its status and reason. Empty for objects without one."""
    seconds: float | None = None
    """Time from the answer to the verdict. None without a verdict."""
    late: bool = False
    """Whether the object had no verdict in time."""

    @property
    def stored(self) -> bool:
        """Whether the API server took the object."""
        return 200 <= self.status < 300


class Api:
    """The API server, for several threads."""

    def __init__(self, kubeconfig: Path) -> None:
        settings = Configuration()
        settings.connection_pool_maxsize = 64
        self._api = config.new_client_from_config(str(kubeconfig), client_configuration=settings)

    def send(self, method: str, path: str, text: str | None = None, content_type: str = JSON) -> tuple[int, bytes]:
        """Return status and body of an answer; status 0 if there is none."""
        host, manager = self._api.configuration.host, self._api.rest_client.pool_manager
        headers = {"Accept": JSON, "Content-Type": content_type}
        for setting in self._api.configuration.auth_settings().values():
            if setting["in"] == "header":
                headers[setting["key"]] = setting["value"]
        body = None if text is None else text.encode(errors="surrogatepass")
        try:
            answer = manager.request(method, f"{host}{path}", body=body, headers=headers, retries=False, timeout=30.0)
        except HTTPError:
            return 0, b""
        return answer.status, answer.data

    def get(self, path: str) -> dict[str, Any] | None:
        """Return an object, or None."""
        status, body = self.send("GET", path)
        return decode(body) if status == 200 else None


def verdict(item: dict[str, Any] | None) -> str:
    """Return the verdict about the present generation of an object; empty if there is none yet."""
    status = (item or {}).get("status") or {}
    if item is None or status.get("observedGeneration") != item["metadata"].get("generation"):
        return ""
    found = [one for one in status.get("conditions") or [] if one["type"] == "Accepted"]
    return f"{found[0]['status']} {found[0]['reason']}" if found else ""


class Sender:
    """Creates or changes the objects of samples, waits for their verdicts, and removes them."""

    def __init__(self, api: Api, namespace: str) -> None:
        self._api, self._namespace = api, namespace

    def path(self, kind: str, name: str = "") -> str:
        """Return the path of an object, or of its collection."""
        return RESOURCES[kind].path(self._namespace, name or None)

    def put_slots(self, originals: dict[str, dict[str, Any]]) -> None:
        """Create the objects that exist all the time."""
        for kind, original in originals.items():
            for number in range(SLOTS):
                name = slot(kind, number)
                item = {**original, "metadata": {**original.get("metadata", {}), "name": name}}
                status, body = self._api.send("POST", self.path(kind), json.dumps(item))
                if status not in (201, 409):
                    raise SystemExit(f"{kind} {name}: {body[:500]!r}")

    def send(self, sample: Sample) -> Sent:
        """Send a new object, or a change of one that exists, and return the result."""
        field = "data" if sample.kind == "ConfigMap" else "spec"
        at, new = time.time(), sample.way == "create" or not sample.part(field)
        if new:
            name = sample.name
            status, _ = self._api.send("POST", f"{self.path(sample.kind)}?{LENIENT}", sample.text)
        else:
            name = slot(sample.kind, sample.seed % SLOTS)
            patch = f'[{{"op":"replace","path":"/{field}","value":{sample.part(field)}}}]'
            status, _ = self._api.send("PATCH", f"{self.path(sample.kind, name)}?{LENIENT}", patch, PATCH)
        sent = Sent(sample, at, status)
        if sent.stored and sample.kind != "ConfigMap":
            sent = self._judged(sent, self.path(sample.kind, name))
        if sent.stored and new:
            self._api.send("DELETE", f"{self.path(sample.kind, name)}?propagationPolicy=Background")
        return sent

    def _judged(self, sent: Sent, path: str) -> Sent:
        begun, pause, found = time.monotonic(), 0.1, ""
        while not found and time.monotonic() - begun < WITHIN:
            time.sleep(pause)
            pause = min(1.0, pause * 1.5)
            found = verdict(self._api.get(path))
        passed = time.monotonic() - begun
        return Sent(sent.sample, sent.at, sent.status, found, passed if found else None, late=not found)


def refusing_pods(name: str, namespace: str) -> list[dict[str, Any]]:
    """Return an admission policy against the pods of generated objects, of which no machine could run as many.

    These are also the pods of generated pools for other workloads, which a pool may serve.

    A dry run is admitted: by one, the operator asks whether the pods of a template would be.
    """
    metadata = "object.metadata"
    owners = (f"{metadata}.?generateName", f"{metadata}.?name", f"{metadata}.?labels['{names.POOL}']")
    ours = " || ".join(f"{owner}.orValue('').startsWith('{OWN}-')" for owner in owners)
    rule = {"apiGroups": [""], "apiVersions": ["v1"], "operations": ["CREATE"], "resources": ["pods"]}
    group = "admissionregistration.k8s.io/v1"
    spec = {
        "failurePolicy": "Fail",
        "matchConstraints": {
            "resourceRules": [rule],
            "namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": namespace}},
        },
        "validations": [
            {"expression": f"request.?dryRun.orValue(false) || !({ours})", "message": "the bench runs no such pods"}
        ],
    }
    binding = {"policyName": name, "validationActions": ["Deny"]}
    return [
        {"apiVersion": group, "kind": "ValidatingAdmissionPolicy", "metadata": {"name": name}, "spec": spec},
        {"apiVersion": group, "kind": "ValidatingAdmissionPolicyBinding", "metadata": {"name": name}, "spec": binding},
    ]

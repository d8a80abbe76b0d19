"""Accesses the cluster under test with the official client, because tests must not use the code under test for that."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlencode

import yaml
from kubernetes import config

Object = dict[str, Any]
T = TypeVar("T")

MERGE = "application/merge-patch+json"
APPLY = "application/apply-patch+yaml"


class Refused(Exception):
    """The API server refused a request."""

    def __init__(self, status: int, reason: str, message: str) -> None:
        super().__init__(f"{status} {reason}: {message}")
        self.status = status
        self.reason = reason
        self.message = message


class Cluster:
    """One API server."""

    def __init__(self, kubeconfig: Path) -> None:
        self.kubeconfig = kubeconfig
        self._api = config.new_client_from_config(str(kubeconfig))
        self._resource = cache(self._discovered)

    @property
    def user(self) -> str:
        """The name of the user that the API server knows by these credentials."""
        review = {"apiVersion": "authentication.k8s.io/v1", "kind": "SelfSubjectReview"}
        answer = self.request("POST", "/apis/authentication.k8s.io/v1/selfsubjectreviews", body=review)
        found: str = answer["status"]["userInfo"]["username"]
        return found

    def request(
        self,
        method: str,
        path: str,
        *,
        body: Any = None,
        params: Mapping[str, str] | None = None,
        content_type: str = "application/json",
        user: str | None = None,
    ) -> Object:
        """Send one request, as another user if one is named. Raises Refused."""
        headers = {"Content-Type": content_type} | ({"Impersonate-User": user} if user is not None else {})
        data = None if body is None else json.dumps(body).encode()
        response = self._send(method, path, params, headers, body=data, timeout=30.0)
        if not 200 <= response.status <= 299:
            raise _refused(response.status, response.data)
        answer: Object = json.loads(response.data)
        return answer

    def _send(
        self, method: str, path: str, params: Mapping[str, str] | None, headers: Mapping[str, str], **more: Any
    ) -> Any:
        found = {"Accept": "application/json", **headers}
        for setting in self._api.configuration.auth_settings().values():  # a token, if the configuration has one
            if setting["in"] == "header":
                found[setting["key"]] = setting["value"]
        url = f"{self._api.configuration.host}{path}{f'?{urlencode(params)}' if params else ''}"
        return self._api.rest_client.pool_manager.request(method, url, headers=found, retries=False, **more)

    def watch(self, api_version: str, kind: str, namespace: str) -> Iterator[tuple[str, Object]]:
        """Yield the present objects as added, and then every change for as long as the API server sends them."""
        path = self.path(api_version, kind, namespace)
        response = self._send("GET", path, {"watch": "true"}, {}, preload_content=False, timeout=None)
        rest = b""
        with response:
            for part in response.stream(amt=None, decode_content=False):
                *lines, rest = (rest + part).split(b"\n")
                for event in map(json.loads, lines):
                    yield event["type"], event["object"]

    def path(self, api_version: str, kind: str, namespace: str | None, name: str = "", subresource: str = "") -> str:
        """Return the path of an object, or of its collection."""
        plural, namespaced = self._resource(api_version, kind)
        parts = [_root(api_version)]
        if namespaced:
            parts.append(f"namespaces/{namespace}")
        return "/".join([*parts, plural, *([name] if name else []), *([subresource] if subresource else [])])

    def create(
        self,
        item: Object,
        namespace: str | None = None,
        *,
        strict: bool = False,
        dry_run: bool = False,
        user: str | None = None,
    ) -> Object:
        """Create an object; ``strict`` refuses unknown fields as kubectl does."""
        params = {"fieldValidation": "Strict"} if strict else {}
        if dry_run:
            params["dryRun"] = "All"
        path = self.path(item["apiVersion"], item["kind"], namespace or item["metadata"].get("namespace"))
        return self.request("POST", path, body=item, params=params, user=user)

    def apply(
        self, item: Object, namespace: str | None = None, *, subresource: str = "", manager: str = "tests"
    ) -> Object:
        """Server-side apply."""
        path = self.path(
            item["apiVersion"],
            item["kind"],
            namespace or item["metadata"].get("namespace"),
            item["metadata"]["name"],
            subresource,
        )
        params = {"fieldManager": manager, "force": "true"}
        return self.request("PATCH", path, body=item, params=params, content_type=APPLY)

    def patch(
        self, item: Object, body: Object, *, subresource: str = "", user: str | None = None, dry_run: bool = False
    ) -> Object:
        """Merge-patch an object that was read or created before."""
        params = {"dryRun": "All"} if dry_run else {}
        path = self._path_of(item, subresource)
        return self.request("PATCH", path, body=body, params=params, content_type=MERGE, user=user)

    def get(
        self, api_version: str, kind: str, name: str, namespace: str | None = None, subresource: str = ""
    ) -> Object:
        """Return an object. Raises Refused with 404 if it does not exist."""
        return self.request("GET", self.path(api_version, kind, namespace, name, subresource))

    def find(self, api_version: str, kind: str, name: str, namespace: str | None = None) -> Object | None:
        """Return an object; None if it does not exist."""
        try:
            return self.get(api_version, kind, name, namespace)
        except Refused as error:
            if error.status == 404:
                return None
            raise

    def list(self, api_version: str, kind: str, namespace: str | None = None, *, labels: str = "") -> list[Object]:
        """Return the objects of a kind in a namespace."""
        params = {"labelSelector": labels} if labels else {}
        items: list[Object] = self.request("GET", self.path(api_version, kind, namespace), params=params)["items"]
        return items

    def delete(self, item: Object, *, user: str | None = None, dry_run: bool = False) -> None:
        """Delete an object at once, without a grace period. It is no error if the object is gone."""
        params = {"gracePeriodSeconds": "0"} | ({"dryRun": "All"} if dry_run else {})
        try:
            self.request("DELETE", self._path_of(item), params=params, user=user)
        except Refused as error:
            if error.status != 404:
                raise

    def kubectl(self, *arguments: str) -> str:
        """Run kubectl and return its output. Raises CalledProcessError with its error output."""
        command = ["kubectl", "--kubeconfig", str(self.kubeconfig), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        if done.returncode:
            raise AssertionError(f"{' '.join(command)} ended with {done.returncode}: {done.stderr}")
        return done.stdout

    def _path_of(self, item: Object, subresource: str = "") -> str:
        metadata = item["metadata"]
        return self.path(item["apiVersion"], item["kind"], metadata.get("namespace"), metadata["name"], subresource)

    def _discovered(self, api_version: str, kind: str) -> tuple[str, bool]:
        for resource in self.request("GET", _root(api_version))["resources"]:
            if resource["kind"] == kind and "/" not in resource["name"]:
                return resource["name"], resource["namespaced"]
        raise LookupError(f"the cluster has no kind {kind} in {api_version}")


def account(namespace: str, name: str) -> str:
    """Return the user name of a ServiceAccount."""
    return f"system:serviceaccount:{namespace}:{name}"


def load(file: Path) -> list[Object]:
    """Return the objects in a YAML file."""
    return [item for item in yaml.safe_load_all(file.read_text()) if item]


def until(found: Callable[[], T], what: str, *, seconds: float = 30.0, every: float = 0.1) -> T:
    """Call a function until it returns a true value, and return that. The failure message names what was awaited and
    the last value."""
    deadline = time.monotonic() + seconds
    while not (value := found()):
        if time.monotonic() > deadline:
            raise AssertionError(f"waited {seconds:g} s for {what}; the last seen was {value!r}")
        time.sleep(every)
    return value


def _root(api_version: str) -> str:
    return f"/apis/{api_version}" if "/" in api_version else f"/api/{api_version}"


def _refused(status: int, body: bytes) -> Refused:
    try:
        answer = json.loads(body)
        return Refused(status, answer.get("reason", ""), answer.get("message", ""))
    except ValueError:
        return Refused(status, "", body.decode(errors="replace"))

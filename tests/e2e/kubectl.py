"""kubectl for tests: what a user would type, with the answers as objects."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from urllib3.exceptions import HTTPError

from tests.support.cluster import Cluster, Refused
from understudy.kube.gates.cilium import OF_NAMESPACE

Object = dict[str, Any]

TIMEOUT = 60.0
"""Seconds for one command."""

READ_WITHIN = 90.0
"""Seconds within which a network has read a label. Cilium needs up to 35 s by default."""

KILLED = 128 + 9
"""What a command exits with that was ended by SIGKILL."""


class Failed(AssertionError):
    """A command ended with an error; the message is what it said."""

    def __init__(self, message: str, status: int = 1) -> None:
        super().__init__(message)
        self.status = status
        """What the command exited with."""


def is_ready(item: Object) -> bool:
    """Whether Kubernetes counts a node or pod as ready."""
    return any((c["type"], c["status"]) == ("Ready", "True") for c in item["status"].get("conditions") or [])


class Reader:
    """Reads objects over one connection, by the names that kubectl takes. Each start of kubectl takes a tenth of a second of a
    processor, and tests read several times a second.
    """

    def __init__(self, kubeconfig: Path) -> None:
        self._cluster = Cluster(kubeconfig)
        self._collections: dict[str, tuple[str, str, bool]] = {}
        """By each name of a kind: the path of its API group, its plural, and whether it is namespaced."""

    def read(self, namespace: str, kind: str, name: str = "", selector: str = "") -> Object:
        """Return an object, or the list of a kind. Raises Failed, with status 404 if there is no such object."""
        try:
            root, plural, namespaced = self._collection(kind)
            path = "/".join(
                [root, *(["namespaces", namespace] if namespaced else []), plural, *([name] if name else [])]
            )
            return self._cluster.request("GET", path, params={"labelSelector": selector} if selector else None)
        except Refused as error:
            raise Failed(f"get {kind} {name}: {error}", error.status) from error
        except HTTPError as error:
            raise Failed(f"get {kind} {name}: {error}") from error

    def _collection(self, kind: str) -> tuple[str, str, bool]:
        if kind not in self._collections:
            groups = self._cluster.request("GET", "/apis")["groups"]
            versions = [group["preferredVersion"]["groupVersion"] for group in groups]
            for root in ["/api/v1", *(f"/apis/{version}" for version in versions)]:
                for one in self._cluster.request("GET", root)["resources"]:
                    self._note(root, one)
        if kind not in self._collections:
            raise Failed(f"the cluster has no kind {kind}")
        return self._collections[kind]

    def _note(self, root: str, resource: Mapping[str, Any]) -> None:
        plural = resource["name"]
        group = root.split("/")[2] if root.startswith("/apis/") else ""
        for name in (plural, resource["singularName"], *resource.get("shortNames", ()), f"{plural}.{group}"):
            self._collections.setdefault(name, (root, plural, resource["namespaced"]))


reader = cache(Reader)
"""The reader of a cluster."""


class Kubectl:
    """kubectl bound to a kubeconfig and a namespace."""

    def __init__(self, kubeconfig: Path, namespace: str) -> None:
        program = shutil.which("kubectl")
        assert program, "kubectl is not on the PATH: scripts/test puts it there"
        self._program, self.kubeconfig, self.namespace = program, kubeconfig, namespace

    def in_namespace(self, namespace: str) -> Kubectl:
        """The same for another namespace."""
        return Kubectl(self.kubeconfig, namespace)

    def command(self, *arguments: str) -> list[str]:
        """The command line."""
        return [self._program, f"--kubeconfig={self.kubeconfig}", "-n", self.namespace, *arguments]

    def __call__(self, *arguments: str, given: str | None = None, timeout: float = TIMEOUT) -> str:
        """Run a command; its standard output. Raises Failed."""
        done = subprocess.run(
            self.command(*arguments), input=given, capture_output=True, text=True, timeout=timeout, check=False
        )
        if done.returncode:
            raise Failed(
                f"kubectl {' '.join(arguments)}: {done.stderr.strip() or done.stdout.strip()}", done.returncode
            )
        return done.stdout

    def apply(self, objects: Iterable[Object]) -> None:
        """Apply objects as a user's file would be."""
        items = {"apiVersion": "v1", "kind": "List", "items": list(objects)}
        self("apply", "-f", "-", given=json.dumps(items))

    def get(self, kind: str, name: str) -> Object:
        """An object. Raises Failed where it isn't there."""
        found = reader(self.kubeconfig).read(self.namespace, kind, name)
        found["metadata"].pop("managedFields", None)  # as kubectl does
        return found

    def find(self, kind: str, name: str) -> Object | None:
        """An object, or None."""
        try:
            return self.get(kind, name)
        except Failed as error:
            if error.status == 404:
                return None
            raise

    def list(self, kinds: str, selector: str = "") -> list[Object]:
        """Objects of one or more kinds (comma separated)."""
        found = []
        for kind in kinds.split(","):
            listed = reader(self.kubeconfig).read(self.namespace, kind, selector=selector)
            # Items of a list do not say what they are.
            about = {"apiVersion": listed["apiVersion"], "kind": listed["kind"].removesuffix("List")}
            found += [about | item for item in listed["items"]]
        return found

    def label_namespace(self, *labels: str) -> None:
        """Label the namespace (``key=value``, ``key-``), and wait until the network has read that. Raises Failed.

        Cilium makes identities of these labels too. A pod that waits for its identity gets no change of a policy, for up to 35 s.
        """
        self("label", "--overwrite", "namespace", self.namespace, *labels)
        end = time.monotonic() + READ_WITHIN
        while not self._network_follows(labels):
            if time.monotonic() > end:
                raise Failed(f"the network has not read {', '.join(labels)} within {READ_WITHIN:g} s")
            time.sleep(0.5)

    def _network_follows(self, labels: Sequence[str]) -> bool:
        try:
            endpoints = self.list("ciliumendpoints")
        except Failed:  # it is another network
            return True
        for status in (one.get("status") or {} for one in endpoints):
            found = {label.removeprefix(OF_NAMESPACE) for label in (status.get("identity") or {}).get("labels") or []}
            present = {label.partition("=")[0] for label in found}
            if status.get("state") != "ready" or any(
                label.removesuffix("-") in present if label.endswith("-") else label not in found for label in labels
            ):
                return False
        return True

    def patch(self, kind: str, name: str, body: Any, *, kind_of_patch: str = "merge") -> None:
        """Patch an object."""
        self("patch", kind, name, f"--type={kind_of_patch}", "-p", json.dumps(body))

    def shell(self, pod: str, container: str, script: str, *arguments: str, timeout: float = TIMEOUT) -> str:
        """Run a shell script in a container."""
        return self("exec", pod, "-c", container, "--", "sh", "-c", script, "sh", *arguments, timeout=timeout)

    def kill(self, pod: str, *command: str, container: str) -> None:
        """Run in a container what kills its processes, which may end the container and with it the command itself."""
        try:
            self("exec", pod, "-c", container, "--", *command)
        except Failed as error:
            if error.status != KILLED:
                raise


def helm(kubeconfig: Path, *arguments: str, timeout: float = 300.0) -> str:
    """Run helm; its standard output. Raises Failed."""
    program = shutil.which("helm")
    assert program, "helm is not on the PATH: scripts/test puts it there"
    command: Sequence[str] = [program, f"--kubeconfig={kubeconfig}", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    if done.returncode:
        raise Failed(f"helm {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stdout

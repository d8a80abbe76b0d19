"""Reads a Deployment or StatefulSet from the cluster or from files."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from understudy.cli.common.errors import CommandError
from understudy.cli.manifests import manifest_reader
from understudy.cli.manifests.manifest_reader import at, items

_KINDS = {
    **dict.fromkeys(("deployment", "deployments", "deploy", "deployments.apps"), "Deployment"),
    **dict.fromkeys(("statefulset", "statefulsets", "sts", "statefulsets.apps"), "StatefulSet"),
}
"""How a user may write the kinds, as for kubectl."""


_POD_DEFAULTS = {
    "dnsPolicy": "ClusterFirst",
    "restartPolicy": "Always",
    "schedulerName": "default-scheduler",
    "securityContext": {},
    "terminationGracePeriodSeconds": 30,
}
_CONTAINER_DEFAULTS = {
    "resources": {},
    "terminationMessagePath": "/dev/termination-log",
    "terminationMessagePolicy": "File",
}


@dataclass(frozen=True)
class Reference:
    """The name of a Deployment or StatefulSet."""

    kind: str
    name: str

    def __str__(self) -> str:
        """Return it as kubectl prints it."""
        return f"{self.kind.lower()}/{self.name}"


def reference(text: str) -> Reference:
    """Parse a reference such as ``deployment/nav2``, for ``type=`` of an argument."""
    kind, slash, name = text.partition("/")
    if not slash or not name or kind.lower() not in _KINDS:
        raise argparse.ArgumentTypeError(f"found {text!r:.60}; give deployment/NAME or statefulset/NAME")
    return Reference(_KINDS[kind.lower()], name)


@dataclass(frozen=True)
class Application:
    """A Deployment or StatefulSet, as the API has it."""

    item: Mapping[str, Any]

    @property
    def kind(self) -> str:
        """Deployment or StatefulSet."""
        return str(at(self.item, "kind"))

    @property
    def name(self) -> str:
        """Its name."""
        return str(at(self.item, "metadata", "name"))

    @property
    def replicas(self) -> int:
        """How many pods it runs."""
        found = at(self.item, "spec", "replicas")
        return found if isinstance(found, int) else 1

    @property
    def containers(self) -> tuple[Mapping[str, Any], ...]:
        """The containers of its pods."""
        found = items(self._pod, "containers")
        return tuple(one for one in found if isinstance(one, Mapping) and isinstance(one.get("name"), str))

    @property
    def template(self) -> dict[str, Any]:
        """The template of its pods, without what the API server fills in."""
        found = at(self.item, "spec", "template")
        metadata, spec = at(found, "metadata"), at(found, "spec")
        kept = {key: value for key, value in (metadata or {}).items() if key in ("labels", "annotations") and value}
        return {**({"metadata": kept} if kept else {}), "spec": _without_defaults(spec)}

    @property
    def uses_host_network(self) -> bool:
        """Whether its pods use the network of their node."""
        return at(self._pod, "hostNetwork") is True

    @property
    def environment(self) -> dict[str, str]:
        """The variables that its containers set to a text of their own, those of the first container last."""
        variables = (one for container in reversed(self.containers) for one in items(container, "env"))
        pairs = ((at(one, "name"), at(one, "value")) for one in variables)
        return {name: value for name, value in pairs if isinstance(name, str) and isinstance(value, str)}

    @property
    def _pod(self) -> Any:
        return at(self.item, "spec", "template", "spec")


def _without_defaults(spec: Any) -> dict[str, Any]:
    """Return the spec of a pod without fields that have the API server's default values."""
    containers = [
        {
            key: value
            for key, value in container.items()
            if key not in _CONTAINER_DEFAULTS or _CONTAINER_DEFAULTS[key] != value
        }
        for container in items(spec, "containers")
        if isinstance(container, Mapping)
    ]
    own = spec.items() if isinstance(spec, Mapping) else ()
    kept = {key: value for key, value in own if key not in _POD_DEFAULTS or _POD_DEFAULTS[key] != value}
    return {**kept, "containers": containers}


def lacking(container: Mapping[str, Any], variables: Iterable[str]) -> list[str]:
    """Return which of these environment variables a container does not set."""
    there = {at(one, "name") for one in items(container, "env")}
    return [name for name in variables if name not in there]


def from_files(files: Iterable[str], wanted: Reference) -> Application:
    """Return an application of these files. Raises CommandError if it is not in them."""
    found: list[Application] = []
    for name, content in manifest_reader.contents(files).items():
        manifests, findings = manifest_reader.read(name, content)
        errors = [finding for finding in findings if finding.severity == "error"]
        if errors:
            raise CommandError(str(errors[0]))
        found += [Application(one.data) for one in manifests if one.kind in _KINDS.values()]
    chosen = [one for one in found if (one.kind, one.name) == (wanted.kind, wanted.name)]
    if not chosen:
        there = ", ".join(f"{one.kind.lower()}/{one.name}" for one in found) or "no Deployment or StatefulSet"
        raise CommandError(f"{wanted} is not in the given files, which have {there}")
    return chosen[0]


def from_cluster(get: Callable[[str, str], Any], wanted: Reference) -> Application:
    """Return an application of the cluster; ``get`` takes a resource and a name. Raises CommandError."""
    return Application(get(f"{wanted.kind.lower()}s.apps", wanted.name))

"""The result of the pure functions: the writes that bring the cluster to its desired state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from understudy.kube.client import MERGE, Object, Resource


@dataclass(frozen=True)
class Apply:
    """A complete object that should exist exactly as given."""

    resource: Resource
    body: Object


@dataclass(frozen=True)
class Create:
    """An object that the operator creates once and does not change afterwards."""

    resource: Resource
    body: Object
    counted: bool = False
    """Whether the number of such objects has a maximum that must not be exceeded.

    The operator then counts it before it is observed.
    """


@dataclass(frozen=True)
class Patch:
    """A patch on exactly one object, identified by its UID."""

    resource: Resource
    item: Object
    body: Object
    subresource: str | None = None
    kind: str = MERGE
    """The patch type: its content type."""


@dataclass(frozen=True)
class Delete:
    """The deletion of exactly one object, as it was read."""

    resource: Resource
    item: Object


Write = Apply | Create | Patch | Delete


MEMORY_LIMIT = "1Gi"
"""Default memory limit of Understudy's containers beside the operator.

At rest they use 60 to 115 MB, and an agent that restored 220 MiB of state used 282 MB. The limit is high, because a monitor that the
kernel ends protects nobody. It keeps a process that strangers fill, for example by DDS, from using up the memory of its node.
"""

MAX_MEMORY_LIMIT = "4Gi"
"""Default of the highest memory limit that a policy can give its monitors, which it lets keep messages and state."""

UNANSWERED = "WebhookUnavailable"
"""Reason of a Problem that is not the object's own: an admission webhook for the write does not answer."""


@dataclass(frozen=True)
class Problem:
    """A problem that prevents an object from being accepted or built."""

    reason: str
    message: str


@dataclass
class Plan:
    """Writes, in order."""

    writes: list[Write] = field(default_factory=list)
    again_after: float | None = None
    """Seconds until the object is reconciled again even if nothing changes; None if it is not."""

    def later(self, delay: float) -> None:
        """Reconcile again after at most this number of seconds."""
        self.again_after = delay if self.again_after is None else min(self.again_after, delay)


@dataclass(frozen=True)
class Images:
    """The image of Understudy's own containers, how its pods pull the image and are scheduled, and their memory."""

    monitor: str
    pull_policy: str = "IfNotPresent"
    pull_secrets: tuple[str, ...] = ()
    """Names of the pull Secrets in the namespace of the workload."""
    priority_class: str = ""
    """PriorityClass of monitors and discovery servers. It does not apply to agents, which run in the user's pods."""
    metrics_from: tuple[Object, ...] = ()
    """Who may read the metrics of monitors, as the peers of a NetworkPolicy; nobody by default."""
    memory_limit: str = MEMORY_LIMIT
    """Memory limit of each container; empty for none."""
    max_memory_limit: str = MAX_MEMORY_LIMIT
    """Highest memory limit of a monitor whose policy needs more."""


def variables(environment: Mapping[str, str]) -> list[Object]:
    """Return the env of a container with these values."""
    return [{"name": key, "value": value} for key, value in sorted(environment.items())]


def from_field(name: str, path: str) -> Object:
    """Return an entry of a container's env whose value is a field of its pod."""
    return {"name": name, "valueFrom": {"fieldRef": {"apiVersion": "v1", "fieldPath": path}}}


def config_map(name: str, data: Mapping[str, str]) -> Object:
    """Return a ConfigMap."""
    return {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": name}, "data": dict(data)}


def deployment(name: str, labels: Mapping[str, str], annotations: Mapping[str, str], pod: Object) -> Object:
    """Return a Deployment of one pod, whose predecessor ends before it starts."""
    template = {"labels": labels, "annotations": annotations} if annotations else {"labels": labels}
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": name, "labels": labels},
        "spec": {
            "replicas": 1,
            "strategy": {"type": "Recreate"},
            "selector": {"matchLabels": labels},
            "template": {"metadata": template, "spec": {"enableServiceLinks": False, **pod}},
        },
    }


def resources(requests: Mapping[str, str], memory_limit: str) -> Object:
    """Return the resources of one of Understudy's containers. ``memory_limit`` is empty for none."""
    limits = {"limits": {"memory": memory_limit}} if memory_limit else {}
    return {"requests": dict(requests), **limits}


def priority(images: Images) -> Object:
    """Return the priorityClassName field of a pod spec, or an empty mapping."""
    return {"priorityClassName": images.priority_class} if images.priority_class else {}


def pull_secrets(names: Sequence[str], existing: Sequence[Object] = ()) -> Object:
    """Return the imagePullSecrets field of a pod spec with these Secrets and the given ones, or an empty mapping."""
    added = [{"name": name} for name in names if {"name": name} not in existing]
    return {"imagePullSecrets": [*existing, *added]} if existing or added else {}

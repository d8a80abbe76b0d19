"""What the pure functions answer: the writes that would make the cluster as it should be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from understudy.kube.client import MERGE, Object, Resource


@dataclass(frozen=True)
class Apply:
    """An object that should be just so, whole."""

    resource: Resource
    body: Object


@dataclass(frozen=True)
class Create:
    """An object to make once and then leave alone."""

    resource: Resource
    body: Object
    counted: bool = False
    """Whether it's one of a number that must not be exceeded: remembered until it is observed."""


@dataclass(frozen=True)
class Patch:
    """A patch on exactly one object (by UID)."""

    resource: Resource
    item: Object
    body: Object
    subresource: str | None = None
    kind: str = MERGE
    """What sort of patch it is: its content type."""


@dataclass(frozen=True)
class Delete:
    """The deletion of exactly one object, as it was read."""

    resource: Resource
    item: Object


Write = Apply | Create | Patch | Delete


UNANSWERED = "WebhookUnavailable"
"""Reason of a Problem that says nothing of the object: whoever is to judge what is written doesn't answer."""


@dataclass(frozen=True)
class Problem:
    """Something that keeps an object from being accepted or built."""

    reason: str
    message: str


@dataclass
class Plan:
    """The writes, in order."""

    writes: list[Write] = field(default_factory=list)
    again_after: float | None = None
    """Seconds until it should be looked at again though nothing changes."""

    def later(self, delay: float) -> None:
        """Look again after so many seconds at the latest."""
        self.again_after = delay if self.again_after is None else min(self.again_after, delay)


@dataclass(frozen=True)
class Images:
    """The image of everything that Understudy runs itself, and how its own pods get it and a place."""

    monitor: str
    pull_policy: str = "IfNotPresent"
    pull_secrets: tuple[str, ...] = ()
    """Names of Secrets, in the workload's namespace, by which the image is pulled."""
    priority_class: str = ""
    """PriorityClass of monitors and discovery servers; an agent is in a pod of the user's."""


def priority(images: Images) -> Object:
    """The field of the spec of a pod of our own with its PriorityClass; empty where there is none."""
    return {"priorityClassName": images.priority_class} if images.priority_class else {}


def pull_secrets(names: Sequence[str], given: Sequence[Object] = ()) -> Object:
    """The field of a pod's spec with these Secrets, and those that are given there; empty where there are none."""
    added = [{"name": name} for name in names if {"name": name} not in given]
    return {"imagePullSecrets": [*given, *added]} if given or added else {}

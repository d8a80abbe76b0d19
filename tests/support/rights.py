"""What ``kubectl auth can-i --list`` says that an account may do; and what it says of a monitor's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class Right(NamedTuple):
    """A line of it."""

    resource: str
    names: frozenset[str]
    """Of objects; none for all of the namespace."""
    verbs: frozenset[str]


OF_ALL = {
    # Of which the admission policy leaves its own to be changed: see test_admission.py.
    "pods": {"get", "list", "watch", "patch", "delete"},
    "pods.metrics.k8s.io": {"list"},
    "events": {"create", "patch", "list"},  # list: what stands in a black box
    "selfsubjectreviews.authentication.k8s.io": {"create"},
    "selfsubjectaccessreviews.authorization.k8s.io": {"create"},
    "selfsubjectrulesreviews.authorization.k8s.io": {"create"},
}
"""What a monitor may do to any object of its namespace, by kind. The last three everybody may."""

WHO_WAITS = {"networkpolicies.networking.k8s.io": {"list", "watch"}}
"""The same, where it may have to wait for a pod of a shared pool in turn with others."""


def listed(text: str) -> list[Right]:
    """The lines about resources."""
    head, *lines = text.splitlines()
    starts = [head.index(title) for title in ("Resources", "Non-Resource URLs", "Resource Names", "Verbs")]
    rows = [[line[a:b].strip() for a, b in zip(starts, [*starts[1:], None], strict=True)] for line in lines]
    return [
        Right(resource, frozenset(only.strip("[]").split()), frozenset(verbs.strip("[]").split()))
        for resource, _, only, verbs in rows
        if resource
    ]


def named(rights: Sequence[Right]) -> dict[str, set[str]]:
    """The objects that are named, by kind."""
    found: dict[str, set[str]] = {}
    for right in rights:
        if right.names:
            found.setdefault(right.resource, set()).update(right.names)
    return found


def of_all(rights: Sequence[Right]) -> dict[str, set[str]]:
    """What may be done to any object of the namespace, by kind."""
    return {right.resource: set(right.verbs) for right in rights if not right.names}

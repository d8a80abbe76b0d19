"""Parses the output of ``kubectl auth can-i --list``, and lists the expected rights of a monitor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class Right(NamedTuple):
    """One line of the output."""

    resource: str
    names: frozenset[str]
    """Names of objects; empty for all objects of the namespace."""
    verbs: frozenset[str]


OF_ALL = {
    # The admission policy restricts the changes to the monitor's own pods: see test_admission.py.
    "pods": {"get", "list", "watch", "patch", "delete"},
    "pods.metrics.k8s.io": {"list"},
    "events": {"create", "patch", "list"},  # list: for the recordings of the black box
    "selfsubjectreviews.authentication.k8s.io": {"create"},
    "selfsubjectaccessreviews.authorization.k8s.io": {"create"},
    "selfsubjectrulesreviews.authorization.k8s.io": {"create"},
}
"""The rights of a monitor to all objects of its namespace, by kind. Every account has the last three."""

WHO_WAITS = {"networkpolicies.networking.k8s.io": {"list", "watch"}}
"""Additional rights of a monitor that may have to queue for a pod of a shared pool."""


def listed(text: str) -> list[Right]:
    """Parse the lines about resources."""
    head, *lines = text.splitlines()
    starts = [head.index(title) for title in ("Resources", "Non-Resource URLs", "Resource Names", "Verbs")]
    rows = [[line[a:b].strip() for a, b in zip(starts, [*starts[1:], None], strict=True)] for line in lines]
    return [
        Right(resource, frozenset(only.strip("[]").split()), frozenset(verbs.strip("[]").split()))
        for resource, _, only, verbs in rows
        if resource
    ]


def named(rights: Sequence[Right]) -> dict[str, set[str]]:
    """Return the rights to named objects, by kind."""
    found: dict[str, set[str]] = {}
    for right in rights:
        if right.names:
            found.setdefault(right.resource, set()).update(right.names)
    return found


def of_all(rights: Sequence[Right]) -> dict[str, set[str]]:
    """Return the rights to all objects of the namespace, by kind."""
    return {right.resource: set(right.verbs) for right in rights if not right.names}

"""Parses the output of ``kubectl auth can-i --list``, and lists the expected rights of a monitor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from tests.support.cluster import Cluster


class Right(NamedTuple):
    """One line of the output."""

    resource: str
    names: frozenset[str]
    """Names of objects; empty for all objects of the namespace."""
    verbs: frozenset[str]


OF_EVERYBODY = {
    "selfsubjectreviews.authentication.k8s.io": {"create"},
    "selfsubjectaccessreviews.authorization.k8s.io": {"create"},
    "selfsubjectrulesreviews.authorization.k8s.io": {"create"},
}
"""The rights of every account, to questions about itself."""

OF_ALL = OF_EVERYBODY | {
    # The admission policy restricts the changes to the monitor's own pods: see test_admission.py.
    "pods": {"get", "list", "watch", "patch", "delete"},
    "pods.metrics.k8s.io": {"list"},
    "events": {"create", "patch", "list"},  # list: for the recordings of the black box
}
"""The rights of a monitor to all objects of its namespace, by kind."""

WHO_WAITS = {
    "networkpolicies.networking.k8s.io": {"list", "watch"},
    "leases.coordination.k8s.io": {"list", "watch"},
}
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


def rights_of(cluster: Cluster, namespace: str, user: str) -> list[Right]:
    """Return what a user may do in a namespace, according to the API server."""
    return listed(cluster.kubectl("auth", "can-i", "--list", f"--as={user}", f"--namespace={namespace}"))


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


def as_lines(rights: Sequence[Right]) -> list[str]:
    """Return one line for each right, in a stable order: the resource, the names if it is restricted to some, and the verbs."""
    found = []
    for right in rights:
        only = f" {' '.join(sorted(right.names))}" if right.names else ""
        found.append(f"{right.resource}{only}: {' '.join(sorted(right.verbs))}")
    return sorted(found)

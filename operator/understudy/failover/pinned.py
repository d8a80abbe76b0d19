"""The identities of the instances that the gate let through of late, or that reached the robot although it did not.

They stay known after their pods' objects are gone, because a process may outlive its object, for example on a node that the cluster has
lost. The list is written with every commit of the gate, so that a new monitor knows them too.
"""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import TypeAdapter, ValidationError

from understudy.api.base import Model

MOST = 8
"""Maximum number of identities in the list."""


class PinnedPod(Model):
    """A pod that the gate let through. The host id in the GIDs of its DDS writers follows from its IP (ros.rmw, ``host_at``)."""

    name: str
    uid: str
    ip: str


_LIST = TypeAdapter(list[PinnedPod])


def read(text: str) -> tuple[PinnedPod, ...]:
    """Return the list from its JSON; empty if there is none or it is invalid."""
    try:
        return tuple(_LIST.validate_json(text)) if text else ()
    except ValidationError:
        return ()


def write(pods: Sequence[PinnedPod]) -> str:
    """Return the list as JSON."""
    return _LIST.dump_json(list(pods)).decode()


def with_pods(known: Sequence[PinnedPod], *let_through: PinnedPod) -> tuple[PinnedPod, ...]:
    """Return the list with these pods at its head, newest first. Pods without an address cannot be recognized and are left out."""
    pods = {pod.uid: pod for pod in (*known, *let_through) if pod.ip}
    order = dict.fromkeys(pod.uid for pod in (*let_through, *known) if pod.ip)
    return tuple(pods[uid] for uid in order)[:MOST]

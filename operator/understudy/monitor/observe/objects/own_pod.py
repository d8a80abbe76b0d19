"""Finds that this monitor's own pod was deleted while the monitor could not reach the API server.

Kubernetes deletes the pods of a node that it has lost, and starts others. If the node only was cut off, their processes live on beside
their successors, after the node's return too: its kubelet may need ten seconds to end them.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging

from understudy.kube.client import PODS, ApiError
from understudy.kube.repeated_requests import answered
from understudy.monitor.observe.objects.cluster_view import ClusterView

_logger = logging.getLogger(__name__)

ASKED_WITHIN = 2.0
"""Seconds that the API server has to answer at the start."""

REPORTED_WITHIN = 1.0
"""Seconds in which the action proxy learns of it, before the monitor ends."""


class PodDeleted(Exception):
    """This monitor's pod was deleted, so another monitor has replaced it. The text is for the log."""


async def end_if_deleted(view: ClusterView) -> None:
    """Ask for the monitor's pod when the API server answers first, and again after each outage. Raises PodDeleted."""
    returns = 0
    while view.me is not None:
        returns = await view.client.contact.returned(returns)
        if await _is_deleted(view):
            view.pod_deleted = True
            await asyncio.sleep(REPORTED_WITHIN)
            raise _ended(view)
        view.pod_confirmed = returns


def is_confirmed(view: ClusterView) -> bool:
    """Return whether the monitor's pod exists, as far as the API server was asked since it last returned. True if the pod is not known."""
    return view.me is None or view.pod_confirmed >= view.client.contact.returns


async def end_at_start_if_deleted(view: ClusterView) -> None:
    """Ask once, before this monitor continues a recovery: its successor may carry it out already. Raises PodDeleted.

    Kubernetes may start a container again whose pod is about to end. A server that does not answer does not delay the start for long.
    """
    if view.me is not None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(ASKED_WITHIN):
                if await _is_deleted(view):
                    raise _ended(view)


def _ended(view: ClusterView) -> PodDeleted:
    assert view.me is not None, "it was checked before"
    return PodDeleted(f"pod {view.me.name} was deleted, which this monitor had not noticed: it ends")


async def _is_deleted(view: ClusterView) -> bool:
    me = view.me
    assert me is not None, "it was checked before"
    try:
        pod = await answered(lambda: view.client.get(PODS, view.namespace, me.name))
    except ApiError as error:
        _logger.log(logging.INFO if error.not_found else logging.WARNING, "pod %s: %s", me.name, error)
        return error.not_found
    return "deletionTimestamp" in pod["metadata"] or me.uid not in ("", pod["metadata"]["uid"])

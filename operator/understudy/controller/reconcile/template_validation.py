"""Lets the API server validate a pod template before anything is built from it, and remembers the answer."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable

from understudy.controller.plan import Problem
from understudy.controller.pods import instance_pod
from understudy.controller.reconcile.executor import NamespaceTerminating
from understudy.kube.client import PODS, ApiError, Client, Object

FORGET_REFUSAL = 30.0
"""Seconds after which a refused template is validated again: a quota, an account or an admission rule may have changed."""
_REMEMBERED_MOST = 2048
_NO_ROOM = "exceeded quota"
"""Text of the error if a ResourceQuota has no room for the pod, which is no problem of the template."""
_POD_SECURITY = "violates PodSecurity"
_ADVICE = (
    ". Set these fields in the template, or enforce another level in the namespace. Understudy's own containers comply with every level. "
    "See docs/how-to/production.md"
)


class Judge:
    """Dry runs of pods, by template hash and namespace."""

    def __init__(self, client: Client, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._client, self._clock = client, clock
        self._known: OrderedDict[tuple[str, str], tuple[Problem | None, float]] = OrderedDict()

    async def judge(self, pod: Object, path: str) -> Problem | None:
        """Return the API server's objection to a pod made from a template, or None.

        Raises ApiError if the server cannot answer now, and NamespaceTerminating if the namespace is being deleted.
        """
        namespace = pod["metadata"]["namespace"]
        key = (namespace, instance_pod.template_hash(pod))
        known = self._known.get(key)
        if known is not None and (known[0] is None or self._clock() - known[1] < FORGET_REFUSAL):
            return known[0]
        found: Problem | None = None
        try:
            await self._client.create(PODS, namespace, pod, dry_run=True)
        except ApiError as error:
            if error.status == 403 and "being terminated" in error.message:
                raise NamespaceTerminating from error
            if error.status == 409 or (error.status == 403 and _NO_ROOM in error.message):
                found = None  # Name taken or quota exhausted: both are checked last, so the template passed.
            elif error.final and error.status in (400, 403, 422):
                advice = _ADVICE if _POD_SECURITY in error.message else ""
                words = f"{path}: the API server rejects a pod with this template: {error.message}{advice}"
                found = Problem("TemplateInvalid", words)
            else:
                raise
        self._known[key] = (found, self._clock())
        if len(self._known) > _REMEMBERED_MOST:
            self._known.popitem(last=False)
        return found

"""Leader election by a ``coordination.k8s.io`` Lease, so that only one of two operators acts.

A candidate judges expiry by how long its own clock has seen the lease's record unchanged. It never compares clocks of
two machines (client-go's leaderelection does the same). A holder that cannot renew in time gives up before another may
take over. The caller then ends the process, since nothing less stops every write that may be in progress.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime

from understudy.kube.client import FAILURES, LEASES, ApiError, Client, Object

_logger = logging.getLogger(__name__)


class LeadershipLost(Exception):
    """The lease could not be renewed in time, or another candidate holds it. The caller must stop acting at once."""


@dataclass(frozen=True)
class Timing:
    """When a lease is renewed, given up and taken over, in seconds.

    The defaults are those of Kubernetes' own components.
    """

    lasts: float = 15.0
    """Seconds after which an unchanged lease may be taken over."""

    renew_within: float = 10.0
    """Seconds after which a holder that could not renew gives up. Less than ``lasts``, so that it stops before another
    starts."""

    every: float = 2.0
    """Seconds between two attempts to renew or to acquire it."""


class Lease:
    """One candidate for a lease."""

    def __init__(
        self,
        client: Client,
        namespace: str,
        name: str,
        identity: str,
        *,
        timing: Timing | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._client, self._namespace, self._name, self._identity = client, namespace, name, identity
        self._timing = timing or Timing()
        self._clock = clock
        self._record: tuple[str, str, int] | None = None
        self._changed_at = 0.0
        self._renewed: float | None = None

    @property
    def held(self) -> bool:
        """Whether this candidate may act now: it renewed the lease within ``renew_within``."""
        return self._renewed is not None and self._clock() - self._renewed < self._timing.renew_within

    async def acquire(self) -> None:
        """Wait until this candidate holds the lease."""
        holder = None
        while True:
            try:
                if await self._attempt():
                    _logger.info("lease %s/%s is held by %s", self._namespace, self._name, self._identity)
                    return
                if self._record is not None and self._record[0] != holder:
                    holder = self._record[0]
                    _logger.info("lease %s/%s: waiting, it is held by %s", self._namespace, self._name, holder)
            except FAILURES as error:
                _logger.warning("lease %s/%s: %s", self._namespace, self._name, error)
            await asyncio.sleep(self._timing.every)

    async def keep(self) -> None:
        """Renew the lease forever.

        Raises LeadershipLost if that fails for too long or another candidate has taken it.
        """
        while True:
            await asyncio.sleep(self._timing.every)
            assert self._renewed is not None, "acquire it first"
            left = self._timing.renew_within - (self._clock() - self._renewed)
            try:
                async with asyncio.timeout(max(left, 0)):
                    if not await self._attempt():
                        raise LeadershipLost(f"lease {self._namespace}/{self._name} was taken over")
            except FAILURES as error:
                _logger.warning("lease %s/%s could not be renewed: %s", self._namespace, self._name, error)
            if not self.held:
                raise LeadershipLost(
                    f"lease {self._namespace}/{self._name} was not renewed for {self._timing.renew_within:g} s"
                )

    async def release(self) -> None:
        """Let another candidate take the lease at once. Call this only after everything has stopped acting."""
        if not self.held:
            return
        self._renewed = None
        with contextlib.suppress(*FAILURES):
            lease = await self._client.get(LEASES, self._namespace, self._name)
            if lease["spec"].get("holderIdentity") == self._identity:
                await self._write(lease, holder="", lasts=1, transitions=lease["spec"].get("leaseTransitions") or 0)

    async def _attempt(self) -> bool:
        """Acquire or renew the lease if that is allowed. Returns whether this candidate holds it now."""
        started = self._clock()
        lease = await self._client.find(LEASES, self._namespace, self._name)
        if lease is None:
            try:
                await self._client.create(LEASES, self._namespace, self._new())
            except ApiError as error:
                if error.conflict:
                    return False
                raise
            self._renewed = started
            return True
        spec = lease.get("spec") or {}
        holder = spec.get("holderIdentity") or ""
        transitions = spec.get("leaseTransitions") or 0
        record = (holder, spec.get("renewTime") or "", transitions)
        if record != self._record:
            self._record, self._changed_at = record, self._clock()  # it may have been renewed just before the answer
        lasts = float(spec.get("leaseDurationSeconds") or self._timing.lasts)
        if holder not in ("", self._identity) and started - self._changed_at < lasts:
            return False
        try:
            await self._write(
                lease,
                holder=self._identity,
                lasts=self._timing.lasts,
                transitions=transitions + (holder != self._identity),
            )
        except ApiError as error:
            if error.conflict:  # another candidate came first; the next attempt sees its record
                return False
            raise
        self._renewed = started
        return True

    async def _write(self, lease: Object, *, holder: str, lasts: float, transitions: int) -> None:
        spec: Object = {
            "holderIdentity": holder,
            "leaseDurationSeconds": max(1, round(lasts)),
            "renewTime": _now(),
            "leaseTransitions": transitions,
        }
        if holder != (lease.get("spec") or {}).get("holderIdentity"):
            spec["acquireTime"] = spec["renewTime"]
        version = lease["metadata"]["resourceVersion"]
        body = {"metadata": {"resourceVersion": version}, "spec": spec}
        await self._client.patch(LEASES, self._namespace, self._name, body)

    def _new(self) -> Object:
        return {
            "apiVersion": "coordination.k8s.io/v1",
            "kind": "Lease",
            "metadata": {"name": self._name, "namespace": self._namespace},
            "spec": {
                "holderIdentity": self._identity,
                "leaseDurationSeconds": max(1, round(self._timing.lasts)),
                "acquireTime": _now(),
                "renewTime": _now(),
                "leaseTransitions": 0,
            },
        }


def _now() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")

"""The recovery record at a workload's gate.

The monitor writes it with the first commit, before its status mentions the recovery.
"""

from __future__ import annotations

import functools

from understudy.api import names
from understudy.controller.observed import kube_objects
from understudy.failover import progress as recoveries
from understudy.failover.progress import LASTS as LASTS
from understudy.failover.progress import Committed
from understudy.kube.client import Object


def beside(gate: Object | None) -> Committed | None:
    """Return the recovery at a gate; None if there is none or it cannot be read."""
    text = kube_objects.notes(gate).get(names.RECOVERY, "") if gate is not None else ""
    return _read(text)


def under_way(workload: Object, gate: Object | None, now: float) -> bool:
    """Whether the gate has a recovery in progress that the workload's status does not report yet."""
    recorded = (workload.get("status") or {}).get("recoveries") or []
    return recoveries.under_way(
        beside(gate), ((one.get("id", ""), (one.get("moments") or {}).get("detected")) for one in recorded), now
    )


@functools.lru_cache(maxsize=4096)
def _read(text: str) -> Committed | None:
    progress = recoveries.beside(text)
    return Committed.of(progress) if progress is not None else None

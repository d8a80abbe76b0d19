"""The recovery beside a workload's gate: its monitor writes it with the first commit, which is before its status says anything of it."""

from __future__ import annotations

import functools
from dataclasses import dataclass

from understudy.api import names
from understudy.cluster.client import Object
from understudy.controller import objects
from understudy.mitigation import progress as recoveries

LASTS = 10.0
"""Seconds after its detection for which a recovery that the status doesn't know counts as under way: the status follows within three
where its monitor lives (understudy.monitor.reporting), and the next monitor says so itself.
"""


@dataclass(frozen=True)
class Committed:
    """What a gate says of the recovery that committed to it last."""

    id: str
    detected: float
    """When the failure was detected, or the hand-over began, in unix seconds."""
    planned: bool
    """Whether nothing had failed."""


def beside(gate: Object | None) -> Committed | None:
    """The recovery beside a gate; None where there is none, or it can't be read."""
    text = objects.notes(gate).get(names.RECOVERY, "") if gate is not None else ""
    return _read(text)


def under_way(workload: Object, gate: Object | None, now: float) -> bool:
    """Whether a recovery stands beside the gate that the workload's status doesn't tell of yet."""
    found = beside(gate)
    if found is None or now >= found.detected + LASTS:
        return False
    told = (workload.get("status") or {}).get("recoveries") or []
    return found.id not in {one.get("id") for one in told}


@functools.lru_cache(maxsize=4096)
def _read(text: str) -> Committed | None:
    progress = recoveries.beside(text)
    if progress is None:
        return None
    planned = progress.planned or progress.switchover is not None
    return Committed(progress.id, progress.moments.get("detected", 0.0), planned)

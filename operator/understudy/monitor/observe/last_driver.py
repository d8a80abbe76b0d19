"""Finds which instance a closed gate admitted last, for who decides for whom it opens and for who gives state to another one."""

from __future__ import annotations

from collections.abc import Sequence

from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import PodIdentity
from understudy.monitor.notices import PublishedStatus


def last_driver(gate: GateState, status: PublishedStatus, instances: Sequence[Instance]) -> PodIdentity | None:
    """Return the instance that the gate admitted last; None if that is not known.

    The gate's record names it. If somebody deletes the gate, the record goes with it. The operator creates the gate again at the same
    epoch, and the status of the monitor before this one names who was active then. That is a name, which the next pod of a StatefulSet has
    too.
    """
    if gate.pinned:
        return PodIdentity(name=gate.pinned[0].name, uid=gate.pinned[0].uid)
    if not gate.closed or gate.recovery is not None or status.driven_epoch != gate.epoch:
        return None
    found = next((i for i in instances if i.name == status.adopted and not i.from_source), None)
    return PodIdentity(name=found.name, uid=found.uid) if found is not None else None

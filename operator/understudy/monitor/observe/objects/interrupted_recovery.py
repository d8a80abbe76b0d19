"""Finds the last recovery of another monitor: one to continue, one that is under way, or one that has ended.

A recovery is recorded in three places, one after the other: the journal, the gate and the workload's status.
"""

from __future__ import annotations

from collections.abc import Collection
from datetime import datetime

from understudy.clock import CLOCK
from understudy.failover.interfaces import Gate
from understudy.failover.journal import Journal
from understudy.failover.progress import Committed, Progress, under_way
from understudy.monitor.notices import PublishedStatus


def interrupted(
    journal: Journal, gate: Gate, published: PublishedStatus, given_up: Collection[str] = ()
) -> Progress | None:
    """Return the recovery that an earlier monitor began and did not record in the status; None if there is none.

    ``given_up`` has the ids of abandoned recoveries, which are not continued: the failed instance may be healthy again, or
    another one may be active.
    """
    committed = gate.state.recovery
    kept = [p for p in (journal.load(), committed) if p is not None]
    over = {*published.recorded, *given_up}
    open_ones = [p for p in kept if p.id not in over and p.result != "Failed"]
    if committed is not None and committed not in open_ones:
        # If the recovery at the gate has ended, only a later one is still open. An earlier one was replaced by another monitor's.
        open_ones = [p for p in open_ones if p.id != committed.id and p.began > committed.began]
    if not open_ones:
        return None
    progress = open_ones[0]
    if committed is not None and committed.id != progress.id and committed in open_ones:
        progress = committed  # the journal has an older recovery than the gate
    return progress.model_copy(update={"resumed": True}, deep=True)


def late_attempt(gate: Gate, progress: Progress) -> Progress | None:
    """Return an interrupted recovery as of its last commit, if that put an instance in control that was given up since.

    The journal is written before the next commit fences that instance, so the gate has the earlier record. None otherwise.
    """
    committed, active = gate.state.recovery, gate.state.active_uid
    if committed is None or committed.id != progress.id or committed.target is None:
        return None
    is_given_up = committed.target.uid == active and progress.has_failed(active)
    return committed.model_copy(update={"resumed": True}, deep=True) if is_given_up else None


def unconcluded(gate: Gate, published: PublishedStatus, given_up: Collection[str] = ()) -> Progress | None:
    """Return the recovery in the gate's record, if no monitor has recorded its end; None if there is none.

    While this monitor recovers nothing, another monitor carries it out, or did until it stopped. A planned switchover does not count.
    """
    found = gate.state.recovery
    if found is None or found.switchover is not None or found.id in given_up:
        return None
    return found if under_way(Committed.of(found.moved(CLOCK.step())), published.listed) else None


def concluded(gate: Gate, published: PublishedStatus) -> Progress | None:
    """Return the last recovery of an earlier monitor, if the gate still has its record and the status lists it as recovered."""
    left, last = gate.state.recovery, published.last
    if left is None or last is None or (last.id, last.result) != (left.id, "Recovered"):
        return None
    if left.switchover is not None:
        return None  # a planned switchover: no instance failed
    done = left.model_copy(update={"result": "Recovered"}, deep=True)
    if last.moments.verified is not None:
        done.moments["verified"] = CLOCK.of_system(datetime.fromisoformat(last.moments.verified).timestamp())
    return done

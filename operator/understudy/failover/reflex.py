"""What follows when the robot's own readers have fallen over to a standby: commit what happened, and fence the loser.

The robot is driven again before anything is decided, so only the detection counts (t_cluster, t_startup and
t_re-initialization are zero). What is left is to keep the loser, which is the stronger one, from taking the robot back.
"""

from __future__ import annotations

import asyncio
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from understudy.failover.availability import INSTANCE_GONE, Availability
from understudy.failover.interfaces import Instance, NotAvailable
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.strategies.base import Strategy, StrategyContext
from understudy.failover.strategies.steps import PROBE_SECONDS

FENCE_QUIET = 0.03
"""Seconds without a packet of the loser, whose agent sends one every ten milliseconds at least, before it counts as fenced."""

FENCE_WITHIN = 1.0
"""Seconds to wait for that."""


@dataclass(frozen=True)
class ReflexSwitch:
    """A standby drives the robot instead of the instance that the gate names. Times are unix seconds."""

    standby: PodIdentity
    last: float
    """Last output of the instance that was in control."""
    first: float
    """First output of the standby after it."""


JITTER = 0.05
"""Part of the gaps between outputs that may be longer than the deadline before it counts as too short."""

ENOUGH = 10
"""Outputs that must have been seen before anything is said about their period."""

ENOUGH_FOR = 2.0
"""Seconds over which they must have been seen."""


def switched(
    active: Sequence[float], standby: Sequence[float], *, deadline: float, now: float
) -> tuple[float, float] | None:
    """When the instance in control was last heard and the standby first after it, where the standby drives now; else None.

    ``active`` and ``standby`` are when samples of them were received, by a reader that chooses as the robot's does, in unix
    seconds; ``deadline`` is in seconds. Nothing is concluded where the one in control was never heard: discovery may find the
    standby seconds before it.

    A standby that is a little ahead when both begin after a pause is heard for a moment: so after a longer silence the one
    in control gets another deadline.
    """
    if not active:
        return None
    last = active[-1]
    place = bisect_right(standby, last)
    if place == len(standby) or now - last < deadline:
        return None
    first = standby[place]
    if first - last >= 2 * deadline and now - first < deadline:
        return None
    return last, first


def longest_gap(arrivals: Sequence[float], deadline: float) -> float | None:
    """The longest gap between outputs (seconds) where the deadline is too short for them: longer ones come again and again.

    None where it is long enough, or where not enough was seen to say so.
    """
    gaps = [later - earlier for earlier, later in pairwise(arrivals)]
    over = [gap for gap in gaps if gap > deadline]
    return max(over) if len(over) >= 3 and len(over) > JITTER * len(gaps) else None


def measured(arrivals: Sequence[float], now: float) -> bool:
    """Whether enough outputs were seen of late to know their period."""
    return len(arrivals) >= ENOUGH and arrivals[-1] - arrivals[0] >= ENOUGH_FOR and now - arrivals[-1] < ENOUGH_FOR


def begin(taken: ReflexSwitch, active: PodIdentity, deadline: float) -> Progress:
    """The recovery that the reflex has all but carried out."""
    progress = Progress.begin(
        f"{active.name} sent nothing for more than {deadline * 1000:.0f} ms (spec.gate.reflex.deadline), so the robot's readers "
        f"switched to {taken.standby.name}",
        last_healthy=taken.last,
        detected=taken.first,
        failed=[active],
    )
    progress.taken_over, progress.strategy = taken.standby, ReflexFallback.name
    progress.moments["routed"] = progress.moments["first_output"] = taken.first
    return progress


async def commit(progress: Progress, context: StrategyContext) -> None:
    """Have the gate name the standby that took over, however long the API server is away. Raises Superseded.

    Nothing is committed where that standby is gone, or where it was done before: recover() finds out.
    """
    taken = progress.taken_over
    target = _instance_taken_over(progress, context)
    if taken is None or target is None or context.gate.state.active_uid == taken.uid:
        return
    progress.target = taken
    progress.moments.setdefault("decided", context.clock())
    progress.moments["committing"] = context.clock()
    context.save(progress)
    for instance in context.instances.of_workload():
        if progress.has_failed(instance.uid):
            # No API server is needed for this, and a crashed container is back in a second.
            await context.agents.give_way(instance)
            await context.agents.probe(instance, PROBE_SECONDS)
    await context.gate.commit(target, progress)
    progress.moments["committed"] = context.clock()


class ReflexFallback(Strategy):
    """The robot's readers chose the standby by themselves; it is seen to be fenced off from the one that was in control."""

    name = "Fallback/Executing (reflex)"

    def availability(self, context: StrategyContext, progress: Progress | None = None) -> Availability:
        """Return whether the recovery can continue with the standby that took over."""
        if progress is None or progress.taken_over is None:
            return Availability(False, INSTANCE_GONE, "no standby has taken over")
        if _instance_taken_over(progress, context) is None:
            return Availability(False, INSTANCE_GONE, f"{progress.taken_over.name}, which took over, is gone")
        if context.gate.state.active_uid != progress.taken_over.uid:
            words = f"the gate admits {context.gate.state.active or 'no pod'}, not {progress.taken_over.name}"
            return Availability(False, INSTANCE_GONE, words)
        return Availability(True)

    async def prepare(self, progress: Progress, context: StrategyContext, *, within: float) -> Instance:
        """Wait until the loser is fenced. Raises NotAvailable."""
        target = _instance_taken_over(progress, context)
        if target is None or (reason := self.available(context, progress)) is not None:
            reason = self.available(context, progress) or ""
            if progress.taken_over is not None and not progress.has_failed(progress.taken_over.uid):
                progress.failed.append(progress.taken_over)  # from here on, time is lost again
            raise NotAvailable(reason)
        progress.target = PodIdentity(name=target.name, uid=target.uid)
        await _fenced(progress, context)
        for part in ("cluster", "startup", "reinitialization"):
            progress.parts.setdefault(part, 0.0)
        return target


def _instance_taken_over(progress: Progress, context: StrategyContext) -> Instance | None:
    taken = progress.taken_over
    if taken is None:
        return None
    return next((i for i in context.instances.of_workload() if i.uid == taken.uid and i.usable), None)


async def _fenced(progress: Progress, context: StrategyContext) -> None:
    """Note when the loser was: at the commit, or with its last packet that got through after it."""
    committed = progress.moments.get("committed", context.clock())
    started = context.clock()
    while True:
        last = max((context.gate.last_packet(pod.uid) or 0.0 for pod in progress.failed), default=0.0)
        fenced = max(committed, last)
        now = context.clock()
        if now - fenced >= FENCE_QUIET or now - started >= FENCE_WITHIN:
            break
        await asyncio.sleep(FENCE_QUIET / 6)
    progress.moments["fenced"] = fenced

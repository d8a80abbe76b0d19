"""The recovery after the robot's own readers switched to a standby: commit that switch and fence the failed instance.

The robot is driven again before the monitor decides, so only the detection counts (t_cluster, t_startup and t_re-initialization are zero).
What remains is to prevent the failed instance, whose writers are stronger, from taking the robot back.
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
"""Seconds without a packet of the failed instance before it counts as fenced. Its agent sends one at least every 10 ms."""

FENCE_WITHIN = 1.0
"""Maximum seconds to wait until the failed instance is fenced."""


@dataclass(frozen=True)
class ReflexSwitch:
    """A standby drives the robot instead of the instance that the gate names. Times are unix seconds."""

    standby: PodIdentity
    last: float
    """Time of the last output of the instance that was active."""
    first: float
    """Time of the first output of the standby after that."""


JITTER = 0.05
"""Fraction of the gaps between outputs that may exceed the deadline before it counts as too short."""

ENOUGH = 10
"""Minimum number of outputs before their period counts as measured."""

ENOUGH_FOR = 2.0
"""Minimum seconds that these outputs must cover."""


def switched(
    active: Sequence[float], standby: Sequence[float], *, deadline: float, now: float
) -> tuple[float, float] | None:
    """Return the last sample of the active instance and the first of the standby after it, if the standby drives now; else None.

    ``active`` and ``standby`` are the times (unix seconds) at which a reader received samples of them. This reader selects a writer as the
    robot's readers do. ``deadline`` is in seconds. If the active instance was never heard, the result is None, because discovery may find
    the standby seconds before it.

    If both begin after a pause and the standby is a little ahead, the reader accepts it for a moment. So after a silence of two deadlines
    or more, the active instance gets another deadline.
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
    """Return the longest gap between outputs (seconds) if the deadline is too short for them, because longer gaps are frequent.

    None if the deadline is long enough, or if too few outputs were received to decide.
    """
    gaps = [later - earlier for earlier, later in pairwise(arrivals)]
    over = [gap for gap in gaps if gap > deadline]
    return max(over) if len(over) >= 3 and len(over) > JITTER * len(gaps) else None


def measured(arrivals: Sequence[float], now: float) -> bool:
    """Return whether enough recent outputs were received to know their period."""
    return len(arrivals) >= ENOUGH and arrivals[-1] - arrivals[0] >= ENOUGH_FOR and now - arrivals[-1] < ENOUGH_FOR


def begin(taken: ReflexSwitch, active: PodIdentity, deadline: float, switcher: str = "the robot's readers") -> Progress:
    """Return the recovery for a switch that the robot's readers, or the mux, have already made."""
    progress = Progress.begin(
        f"{active.name} sent nothing for more than {deadline * 1000:.0f} ms (spec.gate.reflex.deadline), so {switcher} "
        f"switched to {taken.standby.name}",
        last_healthy=taken.last,
        detected=taken.first,
        failed=[active],
    )
    progress.taken_over, progress.strategy = taken.standby, ReflexFallback.name
    progress.moments["routed"] = progress.moments["first_output"] = taken.first
    return progress


async def commit(progress: Progress, context: StrategyContext) -> None:
    """Commit the standby that took over to the gate, however long the API server does not answer. Raises Superseded.

    Commits nothing if that standby is gone or the gate already names it. ``recover`` handles both cases.
    """
    taken = progress.taken_over
    if (
        taken is not None and context.instances.find(taken.uid) is None
    ):  # a pod without its label is not listed, and drives
        await context.instances.regain(taken.name, taken.uid)
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
        if instance.uid != target.uid:
            await context.agents.probe(instance, PROBE_SECONDS)
    await context.gate.commit(target, progress)
    progress.moments["committed"] = context.clock()


class ReflexFallback(Strategy):
    """The robot's readers have selected the standby themselves; this strategy waits until the failed instance is fenced."""

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
        """Wait until the failed instance is fenced. Raises NotAvailable."""
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
    """Record when the failed instance was fenced: at the commit, or at its last packet that passed after the commit."""
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

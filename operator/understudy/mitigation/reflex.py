"""What follows when the robot's own readers have fallen over to a standby: commit what happened, and fence the loser.

The robot is driven again before anything is decided, so only the detection counts (t_cluster, t_startup and
t_re-initialization are zero). What is left is to keep the loser, which is the stronger one, from taking the robot back.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from understudy.mitigation.interfaces import Instance, NotAvailable
from understudy.mitigation.progress import PodIdentity, Progress
from understudy.mitigation.strategies import PROBE_SECONDS, Means, Strategy

FENCE_QUIET = 0.03
"""Seconds without a packet of the loser, whose agent sends one every millisecond, before it counts as fenced."""

FENCE_WITHIN = 1.0
"""Seconds to wait for that."""


@dataclass(frozen=True)
class TakenOver:
    """A standby drives the robot instead of the instance that the gate names. Times are unix seconds."""

    standby: PodIdentity
    last: float
    """Last output of the instance that was in control."""
    first: float
    """First output of the standby after it."""


def judge(active: float | None, others: dict[str, tuple[float, float]], *, deadline: float) -> str | None:
    """The name of the standby that drives the robot now; None while the instance in control does.

    ``active`` is when that was last received at a reader that has the robot's QoS; ``others`` has, for each standby, when
    it was first received since and when last. A reader that is late, since its process was stalled, may deliver a standby's
    sample too: so the instance in control must have been silent for the deadline (seconds) before it.
    """
    found = [
        (last, name)
        for name, (first, last) in others.items()
        if active is None or (last > active and first - active >= deadline)
    ]
    return max(found)[1] if found else None


def begin(taken: TakenOver, active: PodIdentity, deadline: float) -> Progress:
    """The recovery that the reflex has all but carried out."""
    progress = Progress.begin(
        f"{active.name} was silent for more than the deadline of {deadline * 1000:.0f} ms and {taken.standby.name} took over "
        f"by the reflex",
        last_healthy=taken.last,
        detected=taken.first,
        failed=[active],
    )
    progress.taken_over = taken.standby
    progress.moments["routed"] = progress.moments["first_output"] = taken.first
    return progress


async def commit(progress: Progress, means: Means) -> None:
    """Have the gate name the standby that took over, however long the API server is away. Raises Superseded.

    Nothing is committed where that standby is gone, or where it was done before: recover() finds out.
    """
    taken = progress.taken_over
    target = _standing(progress, means)
    if taken is None or target is None or means.gate.state.active_uid == taken.uid:
        return
    progress.target = taken
    progress.moments.setdefault("decided", means.clock())
    progress.moments["committing"] = means.clock()
    means.save(progress)
    for instance in means.instances.of_workload():
        if progress.has_failed(instance.uid):
            await means.agents.probe(instance, PROBE_SECONDS)
    await means.gate.commit(target, progress)
    progress.moments["committed"] = means.clock()


class ReflexFallback(Strategy):
    """The robot's readers chose the standby by themselves; it is seen to be fenced off from the one that was in control."""

    name = "Fallback/Executing (reflex)"

    def available(self, means: Means, progress: Progress | None = None) -> str | None:
        """Why what the reflex did can't be built upon."""
        if progress is None or progress.taken_over is None:
            return "no standby has taken over"
        if _standing(progress, means) is None:
            return f"{progress.taken_over.name}, which took over, is gone"
        if means.gate.state.active_uid != progress.taken_over.uid:
            return f"the gate names {means.gate.state.active or 'no pod'} and not {progress.taken_over.name}"
        return None

    async def prepare(self, progress: Progress, means: Means, *, within: float) -> Instance:
        """Wait until the loser is fenced. Raises NotAvailable."""
        target = _standing(progress, means)
        if target is None or (reason := self.available(means, progress)) is not None:
            reason = self.available(means, progress) or ""
            if progress.taken_over is not None and not progress.has_failed(progress.taken_over.uid):
                progress.failed.append(progress.taken_over)  # from here on, time is lost again
            raise NotAvailable(reason)
        progress.target = PodIdentity(name=target.name, uid=target.uid)
        await _fenced(progress, means)
        for part in ("cluster", "startup", "reinitialization"):
            progress.parts.setdefault(part, 0.0)
        return target


def _standing(progress: Progress, means: Means) -> Instance | None:
    taken = progress.taken_over
    if taken is None:
        return None
    return next((i for i in means.instances.of_workload() if i.uid == taken.uid and i.usable), None)


async def _fenced(progress: Progress, means: Means) -> None:
    """Note when the loser was: at the commit, or with its last packet that got through after it."""
    committed = progress.moments.get("committed", means.clock())
    begun = means.clock()
    while True:
        last = max((means.gate.last_packet(pod.uid) or 0.0 for pod in progress.failed), default=0.0)
        fenced = max(committed, last)
        now = means.clock()
        if now - fenced >= FENCE_QUIET or now - begun >= FENCE_WITHIN:
            break
        await asyncio.sleep(FENCE_QUIET / 6)
    progress.moments["fenced"] = fenced

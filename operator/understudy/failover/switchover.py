"""A planned switchover: nothing has failed, so the active instance is kept until its successor is seen to drive.

The order differs from a recovery. First a strategy prepares an understudy behind the gate, with the state of the active instance. If no
strategy succeeds, nothing was changed. Then one write of the gate fences the active instance and routes the understudy. The former instance
keeps running until outputs of the understudy reach the robot; if they do not, the gate is given back to it. Only then is the former
instance retired.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from understudy.api.kinds.robot_workload import Attempt
from understudy.failover.interfaces import Instance, NotAvailable, NotVerified, StillDriven, Superseded
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.protocol import alone, retire, unless_lost
from understudy.failover.strategies.base import Choice, StrategyContext, Unfit
from understudy.failover.strategies.steps import open_for, restore, wait_enforced

_logger = logging.getLogger(__name__)

COMMIT_WITHIN = 2.0
"""Seconds that the API server has to carry out the switch. The robot is driven meanwhile, but not monitored."""

SEEN_WITHIN = 2.0
"""Seconds within which outputs of the understudy, which it already published behind the gate, must reach the gated readers."""


HEARD_WITHIN = 3.0
"""Seconds that the robot's side has to hear an understudy that is ready: a mux learns of its writers and reports once a second."""


@dataclass(frozen=True)
class Preparation:
    """The result of a preparation."""

    progress: Progress
    target: Instance | None = None
    """The understudy that is ready to drive, or None."""
    attempts: list[Attempt] = field(default_factory=list)
    """The failed attempts, with their reasons."""

    @property
    def reason(self) -> str:
        """Why no understudy is ready."""
        return "; ".join(f"{attempt.strategy}: {attempt.message}" for attempt in self.attempts)

    @property
    def passing(self) -> bool:
        """Whether every strategy was unavailable, so that nothing was changed and another try may succeed soon."""
        return all(attempt.result == "NotAvailable" for attempt in self.attempts)


async def prepare(progress: Progress, choices: Sequence[Choice], context: StrategyContext, unfit: Unfit) -> Preparation:
    """Prepare an understudy with the first strategy that makes one ready to drive within its time.

    The gate does not change, and nothing is stored that a new monitor would continue: a new monitor begins again.
    """
    aside = replace(context, save=lambda progress: None)
    attempts: list[Attempt] = []
    for index, choice in enumerate(choices):
        progress.index, progress.strategy = index, choice.strategy.name
        result: Literal["NotVerified", "NotAvailable"] = "NotVerified"
        try:
            async with asyncio.timeout(choice.verify_within):
                work = choice.strategy.make_ready(progress, aside, within=choice.verify_within, unfit=unfit)
                target = await unless_lost(work, progress, context, crashing_counts=True)
            await _heard(target, context)
            return Preparation(progress, target, attempts)
        except NotAvailable as error:
            result, reason = "NotAvailable", str(error)
        except NotVerified as error:
            reason = str(error)
        except TimeoutError:
            reason = f"no new instance was ready within {choice.verify_within:g} s"
        pod = progress.target.name if progress.target else ""
        attempts.append(Attempt(strategy=choice.strategy.name, pod=pod, result=result, message=reason))
        if progress.target is not None:  # nobody else would finish what was begun with it
            progress.fail_target()
            await retire(progress, context)
        progress.forget_attempt()
    return Preparation(progress, None, attempts)


async def _heard(target: Instance, context: StrategyContext) -> None:
    """Wait until the robot's side hears an understudy, but not for long: one that waits for a goal may send nothing."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(HEARD_WITHIN):
            await context.outputs.heard_held_back(target)


async def switch(prepared: Preparation, context: StrategyContext) -> Progress:
    """Switch the robot from the active instance to a prepared understudy.

    Returns the progress with its result. If that is Failed, the former instance drives. Raises NotAvailable if the understudy is gone or
    no longer ready, Superseded, and TimeoutError if the API server did not answer: the gate shows later whether it was switched.
    """
    progress, target, state = prepared.progress, prepared.target, context.gate.state
    assert target is not None, "it was prepared"
    _assert_ready(target, context)
    progress.former = PodIdentity(name=state.active, uid=state.active_uid)
    progress.attempts = list(prepared.attempts)
    if progress.state:
        # The active instance has continued since the understudy was prepared, and drives until the gate is switched.
        progress.moments["last_healthy"] = context.clock()
        await restore(target, progress, context)
    now = context.clock()
    # The preparation cost the robot nothing: its time counts from here.
    progress.parts, progress.cursor = {}, now
    progress.moments |= {"last_healthy": now, "detected": now, "decided": now}
    progress.charge("detection", now)
    async with asyncio.timeout(COMMIT_WITHIN):
        await open_for(target, progress, context)
    return await settle(progress, context)


def _assert_ready(prepared: Instance, context: StrategyContext) -> None:
    """Raise NotAvailable if an understudy failed after it was prepared: the active instance drives better."""
    found = next((i for i in context.instances.of_workload() if i.uid == prepared.uid and i.usable), None)
    if found is None:
        raise NotAvailable(f"{prepared.name}, which was ready, is gone")
    is_ready, reason = context.agents.is_ready(found) if found.has_agent else (found.ready, "")
    if not is_ready:
        raise NotAvailable(f"{prepared.name}, which was ready, is not ready any more{f': {reason}' if reason else ''}")


def committed(progress: Progress, context: StrategyContext) -> bool:
    """Return whether this switchover was the last commit to the gate."""
    state = context.gate.state
    target = progress.target.uid if progress.target is not None else ""
    return state.recovery is not None and state.recovery.id == progress.id and state.active_uid == target


async def settle(progress: Progress, context: StrategyContext) -> Progress:
    """Check which instance drives after the switch, and retire the former instance or give the gate back to it.

    Can continue a switchover that another monitor began. Raises Superseded.
    """
    if progress.result == "Running":
        _still_ours(progress, context)
        uid = progress.target.uid if progress.target is not None else ""
        target = context.instances.find(uid)
        if target is None or not await _is_observed(target, progress, context):
            return await _give_back(target, progress, context)
        if progress.former is not None:
            progress.fail(progress.former)  # from here on it is treated as a failed pod
        pod, strategy = target.name, progress.strategy
        try:
            await alone(target, progress, context)
        except StillDriven as error:
            progress.strategy, progress.result = "", "Failed"
            progress.attempts.append(Attempt(strategy=strategy, pod=pod, result="NotVerified", message=str(error)))
        else:
            progress.result = "Recovered"
            progress.attempts.append(Attempt(strategy=strategy, pod=pod, result="Verified"))
        progress.epoch = context.gate.state.epoch
        context.save(progress)
    await retire(progress, context)
    return progress


async def _is_observed(target: Instance, progress: Progress, context: StrategyContext) -> bool:
    """Return whether outputs of an instance reach the robot."""
    try:
        async with asyncio.timeout(SEEN_WITHIN):
            await wait_enforced(target, progress, context)
            since = progress.moments.get("committing", progress.cursor)
            first = await context.outputs.first_from(target, since=since)
    except TimeoutError:
        return False
    if first is not None:
        progress.note_first_output(first)
    last, _ = context.outputs.last_from_others(target)
    if last:
        progress.moments["last_output"] = last
    return True


async def _give_back(target: Instance | None, progress: Progress, context: StrategyContext) -> Progress:
    """Give the gate back to the former instance, and retire the understudy whose outputs did not arrive."""
    _still_ours(progress, context)
    uid = progress.former.uid if progress.former is not None else ""
    former = context.instances.find(uid)
    pod = progress.target.name if progress.target is not None else ""
    words = f"{pod} is gone" if target is None else f"no output of {pod} arrived within {SEEN_WITHIN:g} s"
    strategy, progress.strategy, progress.result = progress.strategy, "", "Failed"
    gone = former is None or not former.usable
    message = f"{words}{', and the former instance is gone' if gone else ''}"
    progress.attempts.append(Attempt(strategy=strategy, pod=pod, result="NotVerified", message=message))
    if former is None or gone:  # the monitor then detects the failure of the understudy
        context.save(progress)
        return progress
    progress.fail_target()
    await context.gate.commit(former, progress)
    progress.epoch = context.gate.state.epoch
    context.save(progress)
    await retire(progress, context)
    return progress


def _still_ours(progress: Progress, context: StrategyContext) -> None:
    """Raise Superseded if somebody else has committed to the gate since."""
    if not committed(progress, context):
        state = context.gate.state
        raise Superseded(
            f"another process changed the gate, which now admits {state.active or 'no pod'} (epoch {state.epoch})"
        )

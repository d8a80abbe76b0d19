"""One recovery: choose a strategy, carry it out, verify it, escalate to the next one.

A recovery can continue the progress of an interrupted run: every step reads the present state before it acts.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Coroutine, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

from understudy.api.kinds.robot_workload import Attempt
from understudy.failover.interfaces import (
    ClaimsLost,
    Instance,
    NoLongerNeeded,
    NotAvailable,
    NotVerified,
    StillDriven,
    Superseded,
)
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.strategies.base import Choice, StrategyContext
from understudy.failover.strategies.steps import Outage, answered_time, is_committed, last_sign

_logger = logging.getLogger(__name__)

T = TypeVar("T")

IN_FLIGHT = 0.010
"""Seconds for which samples of the failed pod may still arrive after it was fenced."""

LOST = 2.0
"""Seconds without its pod after which an instance that is being brought up counts as lost; the watch shows a claimed pod earlier."""

LOST_CHECK_PERIOD = 0.1
"""Seconds between two checks whether the instance is lost."""

SILENCE_MARGIN = 0.100
"""Seconds that nobody else must be heard besides one of the others' periods, before an instance counts as the only one that drives."""

PERIOD_MOST = 1.0
"""Longest period in seconds of others' outputs that is waited for. The workload is not monitored meanwhile; after that, the sole driver is
watched for (understudy.monitor.judge.sole_driver)."""

SILENCE_CHECK_PERIOD = 0.010
"""Seconds between two checks whether another instance is heard."""

STALL = 0.25
"""Seconds between two such checks that show that this process was stalled. What arrived meanwhile may not have been read yet: samples, and
that another process has changed the gate."""

STALLS = 5
"""How often such a stall restarts the time in which the others must be silent. The recovery must end on any machine."""

DELETED_WITHIN = 2.0
"""Seconds that the API server has to delete the pods that failed while another instance is to be verified."""

DRIVES_WITHIN = 1.0
"""Seconds within which a slow instance must be heard again and again, so that it counts as one that drives."""

SILENT_WITHIN = 5.0
"""Seconds after the first output of an instance within which every other one must be silent. A leak that lasts is not the fault of the
instance, so it is not replaced."""


_SWITCHED = "{} fell silent, and the robot's side switched to {} by itself"


async def recover(progress: Progress, choices: Sequence[Choice], context: StrategyContext) -> Progress:
    """Activate a healthy instance with the first strategy that is verified.

    Returns the progress with its result, Recovered or Failed.
    Raises Superseded when another monitor commits to the gate.
    """
    if progress.result == "Recovered":
        await retire(progress, context)
        return progress
    state = context.gate.state
    if progress.failed and progress.failed[0].uid == state.active_uid:  # of one that an earlier monitor began, too
        progress.open_at = state.epoch
    if is_committed(progress, context) and context.instances.find(state.active_uid) is None:
        await context.instances.regain(state.active, state.active_uid)
    slow = SlowInstance(progress, context)
    try:
        await _try_in_order(progress, choices, context, slow)
    finally:
        slow.forget()
    return progress


async def _try_in_order(
    progress: Progress, choices: Sequence[Choice], context: StrategyContext, slow: SlowInstance
) -> None:
    index, resume_at = progress.index, 0
    while index < len(choices):
        choice = choices[index]
        progress.index, progress.strategy = index, choice.strategy.name
        # The first run has decided already if this one continues it.
        progress.charge("cluster", progress.moments.setdefault("decided", context.clock()))
        if progress.attempts:
            context.save(progress)  # otherwise nothing was done yet, and the first commit must not wait
        result, message = await _attempt(progress, choices[: index + 1], context, last=index == len(choices) - 1)
        if result == "NoLongerNeeded" and slow.attempt is not None:
            _logger.info("strategy %s: %s", choice.strategy.name, message)
            index = slow.attempt.index
            await slow.resume()
            continue
        pod = progress.target.name if progress.target else ""
        listed: Verdict = result if result in ("Verified", "NotAvailable") else "NotVerified"
        progress.attempts.append(Attempt(strategy=choice.strategy.name, pod=pod, result=listed, message=message))
        _logger.info("strategy %s with %s: %s %s", choice.strategy.name, pod or "no pod", result, message)
        if result == "Verified":
            progress.result = "Recovered"
            break
        if result == "StillDriven":  # neither the fault of this instance, nor would another one help
            progress.result, progress.strategy = "Failed", ""
            break
        if result == "TooSlow":
            slow.listen(index)
        progress.fail_target()
        progress.forget_attempt()
        # Strategies that failed already are not carried out again. A strategy that was overtaken had not failed.
        resume_at = max(resume_at, index if result == "Overtaken" else index + 1)
        back = _available_again(progress, choices[:index], context)
        index = back if back is not None else resume_at
    else:
        progress.result, progress.strategy = "Failed", ""
    context.save(progress)
    if progress.result == "Recovered":
        await retire(progress, context)


Verdict = Literal["Verified", "NotVerified", "NotAvailable"]


@dataclass(frozen=True)
class _SlowAttempt:
    index: int
    instance: Instance
    progress: Progress
    """The recovery as it was at the end of the attempt."""


class SlowInstance:
    """An instance that did not drive within the time of its strategy, and that the gate admits until the next commit is answered.

    If it drives by then, fencing it would stop a robot that is driven.
    """

    def __init__(self, progress: Progress, context: StrategyContext) -> None:
        self._progress, self._context = progress, context
        self.attempt: _SlowAttempt | None = None
        self._resumed: set[int] = set()
        self._listening: asyncio.Task[None] | None = None

    def listen(self, index: int) -> None:
        """Listen to the target of the strategy of this index, if the gate admits it. Otherwise listen to the one before, as it may be."""
        target = self._progress.target
        instance = self._context.instances.find(target.uid) if target is not None else None
        is_admitted = instance is not None and self._context.gate.state.active_uid == instance.uid
        if instance is not None and is_admitted:
            self.forget()
            if index in self._resumed:
                return
            self.attempt = _SlowAttempt(index, instance, self._progress.model_copy(deep=True))
            self._listening = asyncio.create_task(self._hear(instance))

    async def _hear(self, instance: Instance) -> None:
        pod = PodIdentity(name=instance.name, uid=instance.uid)
        while True:  # it may be silent again before a commit is answered
            first: float | None = None
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(DRIVES_WITHIN):
                    first = await self._context.outputs.first_from(instance, since=self._context.clock())
            self._progress.drives_late = pod if first is not None else None
            await asyncio.sleep(LOST_CHECK_PERIOD)

    async def resume(self) -> None:
        """Continue the attempt. The commit ends those that the API server received and did not answer. Raises what a commit raises."""
        assert self.attempt is not None
        attempt, progress = self.attempt, self._progress
        self._resumed.add(attempt.index)
        self.forget()
        progress.resume(attempt.progress)
        await self._context.gate.commit(attempt.instance, progress)

    def forget(self) -> None:
        """Listen to none any more."""
        if self._listening is not None:
            self._listening.cancel()
        self.attempt, self._listening, self._progress.drives_late = None, None, None


class _Overtaken(Exception):
    """A standby that was not ready before is ready, while the strategy still waits for a new pod. The text of the error is the reason."""


def _available_again(progress: Progress, choices: Sequence[Choice], context: StrategyContext) -> int | None:
    """Return the index of the first of these strategies that had no instance when it was tried, and whose standby is ready now.

    Each is tried once more, so that a standby that is ready and not, again and again, does not keep the recovery from its other strategies.
    """
    for index, one in enumerate(choices):
        results = [attempt.result for attempt in progress.attempts if attempt.strategy == one.strategy.name]
        is_candidate = one.strategy.has_own_instance and results == ["NotAvailable"]
        if is_candidate and context.holds(one.strategy) is None and one.strategy.available(context, progress) is None:
            return index
    return None


async def _attempt(
    progress: Progress, choices: Sequence[Choice], context: StrategyContext, *, last: bool
) -> tuple[Verdict | Literal["StillDriven", "Overtaken", "TooSlow", "NoLongerNeeded"], str]:
    """Try the last of these strategies, of which the others were tried before."""
    *before, choice = choices
    is_resumed = progress.target is not None or progress.waiting is not None  # by an earlier monitor
    if not is_resumed and (reason := context.holds(choice.strategy)) is not None:
        return "NotAvailable", reason
    outage = Outage()
    try:
        await _in_its_time(progress, choice, context, before, outage, last=last)
    except NotAvailable as reason:
        return "NotAvailable", outage.beside(str(reason))
    except NotVerified as reason:
        return "NotVerified", outage.beside(str(reason))
    except StillDriven as reason:
        return "StillDriven", outage.beside(str(reason))
    except _Overtaken as reason:
        return "Overtaken", str(reason)
    except NoLongerNeeded as reason:
        if progress.drives_late is None:
            raise
        return "NoLongerNeeded", str(reason)
    except TimeoutError:
        late = f"the strategy was not verified within {choice.verify_within:g} s: {_missing(progress)}"
        return "TooSlow", outage.beside(late)
    progress.epoch = context.gate.state.epoch
    return "Verified", outage.beside()


async def _in_its_time(
    progress: Progress,
    choice: Choice,
    context: StrategyContext,
    before: Sequence[Choice],
    outage: Outage,
    *,
    last: bool,
) -> None:
    """Wait for the resources of the strategy, carry it out within its time, and wait until its instance drives alone."""
    while True:
        await choice.strategy.wait(progress, context, within=choice.verify_within)
        try:
            async with answered_time(choice.verify_within, progress, context, outage):
                work = _unless_overtaken(_carry_out(progress, choice, context), progress, choice, context, before)
                target = await unless_lost(work, progress, context, crashing_counts=not last)
            await unless_lost(alone(target, progress, context), progress, context, crashing_counts=not last)
            return
        except ClaimsLost as reason:
            _logger.info("%s", reason)


async def _unless_overtaken(
    work: Coroutine[None, None, T],
    progress: Progress,
    choice: Choice,
    context: StrategyContext,
    before: Sequence[Choice],
) -> T:
    """Do the work and return its result, but raise _Overtaken if a standby of an earlier strategy is ready before there is a new pod.

    While the gate is not closed, a commit may be under way, which must not be left in progress.
    """
    if not choice.strategy.makes_pod or not before:
        return await work
    working = asyncio.create_task(work)
    try:
        while not (await asyncio.wait((working,), timeout=LOST_CHECK_PERIOD))[0]:
            context.agents.follow(context.instances.of_workload())  # also those that appear while it waits
            if progress.target is not None or not context.gate.state.closed:
                continue
            if (back := _available_again(progress, before, context)) is not None:
                name = before[back].strategy.name
                raise _Overtaken(f"there was no new pod yet, and strategy {name} can be carried out now")
        return working.result()
    finally:
        working.cancel()
        await asyncio.gather(working, return_exceptions=True)


async def _carry_out(progress: Progress, choice: Choice, context: StrategyContext) -> Instance:
    """Put an instance in control, wait until its outputs arrive, and return it."""
    target = await choice.strategy.prepare(progress, context, within=choice.verify_within)
    since = progress.moments.get("committing", progress.cursor)
    first = await context.outputs.first_from(target, since=since)
    if first is not None:
        progress.note_first_output(first)
    return target


async def unless_lost(
    work: Coroutine[None, None, T], progress: Progress, context: StrategyContext, *, crashing_counts: bool
) -> T:
    """Do the work and return its result, but stop if its instance is lost, so that the next strategy is tried.

    ``crashing_counts`` is whether a crash-looping instance is lost too: if no other strategy is left, it may still come up.
    Raises NotVerified.
    """
    working = asyncio.create_task(work)
    watching = asyncio.create_task(_loss(progress, context, crashing_counts=crashing_counts))
    try:
        await asyncio.wait((working, watching), return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise NotVerified(watching.result())
        return working.result()
    finally:
        for task in (working, watching):
            task.cancel()
        await asyncio.gather(working, watching, return_exceptions=True)


async def _loss(progress: Progress, context: StrategyContext, *, crashing_counts: bool) -> str:
    """Wait until the instance that is brought up is lost, and return the reason. Raises Superseded if the gate lets another one through."""
    missing: float | None = None
    while True:
        await asyncio.sleep(LOST_CHECK_PERIOD)
        if progress.target is None:
            continue
        uid, name = progress.target.uid, progress.target.name
        if "committed" in progress.moments:
            _assert_admitted(uid, name, context)
        found = context.instances.find(uid)
        if found is not None and (other := context.outputs.switched_to(found)):
            return _SWITCHED.format(name, other)
        if found is not None and found.terminating:
            return f"pod {name} is being deleted"
        # Before the commit, it is given its state again (steps.bring_up_and_open).
        given_restarts = progress.given_restarts if "committed" in progress.moments else None
        if found is not None and given_restarts is not None and found.restarts > given_restarts:
            return f"a container of pod {name} restarted after it was given its state"
        if found is not None and found.running:
            if crashing_counts and found.crashing and not context.agents.is_ready(found)[0]:
                return f"a container of pod {name} is crash-looping"
            missing = None
            continue
        missing = missing if missing is not None else context.clock()
        if context.clock() - missing < LOST:
            continue
        if found is None:  # a pod without its label is not listed, and may drive
            await context.instances.regain(name, uid)
            found = context.instances.find(uid)
        if found is None or not found.running:
            return f"pod {name} {'is gone' if found is None else 'has stopped running'}"


def _missing(progress: Progress) -> str:
    for moment, message in (
        ("routed", "no output of the new instance arrived through the gate"),
        ("ready", "the gate could not be opened"),
        ("started", "the outputs of the new instance did not become healthy"),
        ("claimed", "the processes of the new instance did not start"),
    ):
        if moment in progress.moments:
            return message
    return "no instance was running" if progress.target is None else "the processes of the new instance did not start"


async def alone(target: Instance, progress: Progress, context: StrategyContext) -> None:
    """Wait until only one instance drives: after the gate changed, nobody else is heard for one of the others' periods and a margin.

    Only time in which this process listens counts: not the time before a new monitor began, and not a stall. A pod that is heard later is
    deleted, because the gate stops packets and not processes. Raises StillDriven, NotVerified and Superseded.
    """
    moments, clock = progress.moments, context.clock
    listening_since = clock()
    silent_by = listening_since + SILENT_WITHIN
    fenced = min(moments.get("fenced", moments.get("committing", progress.cursor)), listening_since)
    silence = min(context.outputs.period_of_others(target), PERIOD_MOST) + SILENCE_MARGIN
    is_leaking, stalls = False, 0
    while True:
        last, pod = last_sign(target, progress, context)
        if last > fenced:
            moments["fenced"] = max(last, moments.get("fenced", last))
        if last > fenced + IN_FLIGHT and not is_leaking:
            is_leaking = True
            late = (last - fenced) * 1000
            _logger.warning(
                "%s still reached the robot %.0f ms after the gate was closed to it: waiting for silence", pod, late
            )
            await _end(progress, context)
            continue  # the pod may have gone on meanwhile
        quiet_from = max(fenced, last, listening_since)
        if (left := quiet_from + silence - clock()) <= 0:
            break
        if is_leaking and clock() >= silent_by:
            raise StillDriven(f"{pod} still reaches the robot, although the gate does not let it through")
        checked_at = clock()
        await asyncio.sleep(min(left, SILENCE_CHECK_PERIOD))
        if (apart := clock() - checked_at) >= STALL and stalls < STALLS:
            listening_since, silent_by, stalls = clock(), silent_by + apart, stalls + 1
    _assert_admitted(target.uid, target.name, context)
    if other := context.outputs.switched_to(target):
        raise NotVerified(_SWITCHED.format(target.name, other))
    moments["verified"] = clock()


def _assert_admitted(uid: str, name: str, context: StrategyContext) -> None:
    if (state := context.gate.state).active_uid != uid:
        raise Superseded(f"the gate admits {state.active or 'no pod'}, not {name}")


async def _end(progress: Progress, context: StrategyContext) -> None:
    """Delete the pods that failed, with the shortest grace period, because one of them still reaches the robot.

    An API server that refuses or does not answer is no fault of the instance that drives. The pods are deleted again after the recovery.
    """
    try:
        async with asyncio.timeout(DELETED_WITHIN):
            await retire(progress, context)
            for instance in context.instances.of_workload():
                if progress.has_failed(instance.uid):
                    await context.instances.end(instance)
    except Exception as error:  # whatever a request raises
        _logger.warning("the pods that failed are not deleted yet: %r", error)


async def retire(progress: Progress, context: StrategyContext) -> None:
    """Delete the pods that failed, because the gate stops packets and not processes."""
    for instance in context.instances.of_workload():
        if progress.has_failed(instance.uid) and not instance.terminating:
            await context.instances.retire(instance)

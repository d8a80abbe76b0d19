"""Planned switchovers: notices requests, prepares an understudy in the background, and reports the outcome.

A user requests a switchover with an annotation of the RobotWorkload; the operator requests one for a node that is being
drained. Both requests survive a restart of this process. So does the report about the last request, so that no request
is carried out twice. Until the gate is switched, nothing else changes, so an interrupted preparation starts again.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass

from understudy.api import names
from understudy.api.base import reported
from understudy.api.conditions import now as moment
from understudy.api.kinds.switchover_spec import ENDED, Drain, Kind, Phase, Request, SwitchoverStatus, parse
from understudy.clock import CLOCK
from understudy.failover import switchover
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import Instance, NotAvailable, Superseded
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.strategies.base import Choice
from understudy.failover.strategies.restart import Restart
from understudy.failover.switchover import Preparation
from understudy.kube.client import FAILURES
from understudy.monitor.act.instances.garbage_collection import GarbageCollection
from understudy.monitor.act.instances.state_manager import StateManager
from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.decide.strategy_options import StrategyOptions
from understudy.monitor.notices import Notices
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.outcome import Outcome

_logger = logging.getLogger(__name__)

EXPIRES = 600.0
"""Seconds after which a request has expired, because the user no longer waits for it. Long enough that a small error of
the user's clock does not matter."""

PATIENCE = 30.0
"""Seconds that a request waits for an understudy, or for the end of whatever prevents it: before the preparation and again after it. The
request of a drain waits as long as the drain lasts."""

CHECK_PERIOD = 1.0
"""Seconds between two checks whether a waiting request can begin."""

REPORT_PERIOD = 5.0
"""Minimum seconds between two updates of why a request waits. Figures in that message may change at every evaluation."""

AGAIN = 30.0
"""Seconds after which a drain tries again if an understudy existed but did not become active."""


@dataclass(frozen=True)
class Wanted:
    """A requested switchover."""

    kind: Kind
    reason: str
    request: str = ""
    drain: Drain | None = None

    @property
    def key(self) -> tuple[str, str, str]:
        """The identity of this request."""
        return self.kind, self.request, self.drain.uid if self.drain is not None else ""

    def unfit(self, instance: Instance) -> str | None:
        """Return why an instance does not satisfy the request; None if it does."""
        if self.kind == "Failback" and not instance.from_source:
            return "does not belong to the Deployment, StatefulSet or ReplicaSet of the workload"
        if self.drain is not None and instance.node in self.drain.cordoned:
            return f"is on {instance.node}, which is cordoned too"
        return None


class PlannedSwitchovers:
    """The planned switchovers of one workload."""

    def __init__(
        self,
        cluster: Cluster,
        options: StrategyOptions,
        state_manager: StateManager,
        current: CurrentRecovery,
        garbage: GarbageCollection,
        notices: Notices,
    ) -> None:
        self._view, self._fleet, self._gate = cluster.view, cluster.pods, cluster.gate
        self._options, self._state_manager, self._current = options, state_manager, current
        self._garbage, self._notices = garbage, notices
        self._task: asyncio.Task[Preparation] | None = None
        self._wanted: Wanted | None = None
        self._progress: Progress | None = None
        self._touched: PodIdentity | None = None
        """The understudy that was prepared for the switchover, and has no other use."""
        self._next = 0.0
        self._reported_at = 0.0
        self._waits_since: tuple[tuple[str, ...], float] = ((), 0.0)

    @property
    def preparing(self) -> str:
        """UID of the understudy that is being prepared, which nothing else may use meanwhile; empty if there is none."""
        target = self._progress.target if self._progress is not None else None
        return target.uid if target is not None else ""

    def advance(self, lacking: str) -> Preparation | None:
        """Continue the requested switchover. Return the prepared understudy once it can drive instead of the active instance.

        ``lacking`` is why no switchover may begin now; empty if one may. Called at every evaluation while nothing has failed;
        returns at once.
        """
        wanted = self._asked(time.time())
        now = time.monotonic()
        lacking = lacking or self._state_manager.awaited()
        if self._task is not None:
            if wanted is None or self._wanted is None or wanted.key != self._wanted.key:
                self._abandon("the request was withdrawn")
            elif self._task.done():
                prepared = self._outcome(self._task)
                if prepared is None or not lacking:
                    return prepared
                self._wait_prepared(wanted, prepared, lacking, now)
            elif now >= self._next and self._progress is not None:
                self._report_progress(self._progress, "Preparing", "An understudy is being prepared.")
            return None
        if wanted is None:
            self._close_report()
            return None
        if now < self._next:
            return None
        self._next = now + CHECK_PERIOD
        if lacking:
            self._wait(wanted, lacking, now)
        else:
            self._begin(wanted)
        return None

    def failed(self, reason: str) -> PodIdentity | None:
        """Cancel the switchover, because the failure comes first. Return the understudy that was being prepared by the first strategy, if
        there was one."""
        wanted = self._wanted if self._task is not None else self._asked(time.time())
        progress = self._progress if self._task is not None else None
        self._stop()
        if wanted is not None and wanted.request:
            self._end("NotDone", f"The switchover was cancelled, because a failure comes first: {reason}.", wanted)
        if progress is None or progress.target is None:
            return None
        if progress.index == 0 and wanted is not None and wanted.kind != "Failback":
            return progress.target
        self._leave(progress, progress.target)
        return None

    async def carry_out(self, prepared: Preparation) -> Outcome | None:
        """Switch the robot from the active instance to a prepared understudy, or check the outcome of a switch that
        an earlier monitor began.

        Returns None if the gate was not switched.
        """
        progress, context = prepared.progress, self._options.context()
        self._report_switching(prepared)
        _logger.warning("switchover (%s): %s", progress.switchover, progress.reason)
        try:
            with self._current.during(progress):
                async with self._state_manager.recovering():
                    if progress.former is None:
                        await switchover.switch(prepared, context)
                    else:
                        await switchover.settle(progress, context)
        except (NotAvailable, Superseded, *FAILURES) as error:
            if progress.result == "Running":
                reason = str(error) or f"the API server did not answer within {switchover.COMMIT_WITHIN:g} s"
                _logger.warning("switchover %s given up: %s", progress.id, reason)
                self._give_up(progress, reason)
                return None
            _logger.warning("the former pod is not deleted yet: %r", error)
        return Outcome("SwitchedOver" if progress.result == "Recovered" else "NotSwitchedOver", progress)

    def _report_switching(self, prepared: Preparation) -> None:
        self._task, progress = None, prepared.progress
        target = prepared.target or progress.target
        assert target is not None, "it was prepared"
        self._report_progress(progress, "Switching", f"The gate is being switched to {target.name}.")

    def _give_up(self, progress: Progress, reason: str) -> None:
        # If the commit was carried out after all, ``unsettled`` finds it in the gate's record.
        self._leave(progress, self._touched)
        self._stop()
        self._rest(progress.switchover)
        text = f"The gate was not switched: {reason}."
        self._notices.event("Warning", "SwitchoverNotDone", text)
        self._report_progress(progress, "NotDone", text)

    def done(self, progress: Progress, text: str) -> None:
        """Report the outcome ``text`` of a switchover that switched the gate."""
        self._stop()
        if progress.result != "Recovered":
            self._rest(progress.switchover)
        self._report_progress(
            progress, "Done" if progress.result == "Recovered" else "NotDone", text, recovery=progress.id
        )

    def unsettled(self) -> Progress | None:
        """Return a switchover whose gate was switched after it was abandoned, or by an earlier monitor."""
        found = self._gate.state.recovery
        if found is None or found.switchover is None or found.result != "Running":
            return None
        if found.id in self._notices.status.recorded or found.target is None:
            return None
        return found.model_copy(deep=True) if found.target.uid == self._gate.state.active_uid else None

    # -- requests ---------------------------------------------------------------------------------------------------

    def _asked(self, now: float) -> Wanted | None:
        text = ((self._view.object or {}).get("metadata", {}).get("annotations") or {}).get(names.SWITCHOVER)
        if text and not self._was_handled(text) and (wanted := self._requested(text, now)) is not None:
            return wanted
        drain = self._view.settings.drain if self._view.settings is not None else None
        if drain is None or drain.uid != self._gate.state.active_uid:
            return None
        return Wanted("Drain", f"node {drain.node} is being drained (it is cordoned)", drain=drain)

    def _was_handled(self, text: str) -> bool:
        published = self._notices.status.switchover
        return published is not None and published.handled == text

    def _requested(self, text: str, now: float) -> Wanted | None:
        """Return the switchover that a request asks for. Returns None if the request has no effect, and reports that."""
        try:
            found = parse(text)
        except ValueError as error:
            self._end("NotDone", f"Annotation {names.SWITCHOVER}: {error}.", Wanted("Failover", "", text))
            return None
        wanted = Wanted(found.kind, f"{found.kind.lower()} requested by annotation", text)
        if self._task is None and (over := self._over(found, now)) is not None:
            self._end("NotDone", over, wanted)
            return None
        active = self._fleet.find(self._gate.state.active_uid)
        if found.kind == "Failback" and self._task is None and active is not None and active.from_source:
            self._end("Done", f"{active.name} of the Deployment, StatefulSet or ReplicaSet is active already.", wanted)
            return None
        return wanted

    def _over(self, found: Request, now: float) -> str | None:
        """Return why a request comes too late; None if it does not."""
        if now - found.at > EXPIRES:
            return (
                f"The request expired: no monitor handled it for {now - found.at:.0f} s. Request the switchover again."
            )
        # The gate's record is reliable even if a late status write of an earlier monitor overwrote a newer status.
        last = self._gate.state.recovery
        if last is not None and CLOCK.to_system(last.moments.get("detected", 0.0)) > found.at:
            what = "another switchover took place" if last.planned else "the active instance failed and was recovered"
            return f"After the request, {what}. Request the switchover again if you still need it."
        return None

    # -- preparing --------------------------------------------------------------------------------------------------

    def _begin(self, wanted: Wanted) -> None:
        choices, context = self._options.choices(), self._options.context()
        started_at = CLOCK.now()
        progress = Progress.begin(wanted.reason, last_healthy=started_at, detected=started_at, planned=True)
        progress.switchover, progress.request = wanted.kind, wanted.request
        if wanted.kind == "Failback" and not any(isinstance(choice.strategy, Restart) for choice in choices):
            choices = [*choices, self._home(choices)]
        self._wanted, self._progress = wanted, progress
        if self._is_new(wanted):
            self._notices.event("Normal", "SwitchoverBegun", f"A switchover is being prepared: {wanted.reason}")
            self._report_progress(progress, "Preparing", "An understudy is being prepared.")
        self._task = asyncio.create_task(switchover.prepare(progress, choices, context, wanted.unfit))

    def _home(self, choices: Sequence[Choice]) -> Choice:
        """Return a choice that has the workload's own controller run a pod, for a policy without such a strategy."""
        spec = self._view.spec
        bring_up = BringUp.of("bringUp", spec.bring_up) if spec is not None else None
        return Choice(Restart(recovery=bring_up), max([PATIENCE, *(choice.verify_within for choice in choices)]))

    def _outcome(self, task: asyncio.Task[Preparation]) -> Preparation | None:
        wanted = self._wanted
        assert wanted is not None, "it was begun"
        try:
            prepared = task.result()
        except Exception as error:  # an error of the API server or of an agent is no failure: the robot is driven
            _logger.warning("preparing a switchover: %r", error)
            self._stop()
            self._wait(wanted, f"a request to the API server or to an agent failed ({error})", time.monotonic())
            return None
        if prepared.target is not None:
            self._touched = prepared.progress.target
            return prepared
        self._stop()
        if prepared.passing:
            self._wait(wanted, prepared.reason, time.monotonic())
        else:
            self._rest(wanted.kind)
            self._end("NotDone", f"No understudy became ready, and nothing was changed: {prepared.reason}.", wanted)
        return None

    def _wait(self, wanted: Wanted, reason: str, now: float) -> None:
        reason = reason.rstrip(".")
        if self._waited_too_long(wanted, now):
            self._end(
                "NotDone",
                f"The switchover could not begin within {PATIENCE:g} s and was cancelled; nothing was changed: {reason}.",
                wanted,
            )
            return
        new = self._is_new(wanted)
        if new:
            kind = "Warning" if wanted.drain is not None else "Normal"
            self._notices.event(kind, "SwitchoverWaits", f"{wanted.reason}: {reason}")
        published = self._notices.status.switchover
        if new or (published is not None and published.phase != "Waiting") or now - self._reported_at >= REPORT_PERIOD:
            self._reported_at = now
            self._report(wanted.kind, wanted.request, "Waiting", f"{reason}.")

    def _wait_prepared(self, wanted: Wanted, prepared: Preparation, reason: str, now: float) -> None:
        """Wait until a prepared understudy may drive. The phase stays Preparing, in which the operator keeps the understudy's pod."""
        reason = reason.rstrip(".")
        if self._waited_too_long(wanted, now, "prepared"):
            self._abandon(f"an understudy was prepared, but could not take over within {PATIENCE:g} s: {reason}")
        elif now - self._reported_at >= REPORT_PERIOD:
            self._reported_at = now
            assert prepared.target is not None, "it was prepared"
            self._report_progress(
                prepared.progress, "Preparing", f"{prepared.target.name} is prepared, and waits: {reason}."
            )

    def _waited_too_long(self, wanted: Wanted, now: float, *what: str) -> bool:
        key = (*wanted.key, *what)
        if self._waits_since[0] != key:
            self._waits_since = (key, now)
        return bool(wanted.request) and now - self._waits_since[1] >= PATIENCE

    def _abandon(self, reason: str) -> None:
        wanted, progress = self._wanted, self._progress
        self._stop()
        if progress is not None:
            self._leave(progress, progress.target)
        if wanted is not None:
            self._end("NotDone", f"Nothing was changed: {reason}.", wanted)

    def _close_report(self) -> None:
        """Close the report of an earlier monitor about a request that has been withdrawn since."""
        published = self._notices.status.switchover
        if published is not None and published.phase not in ENDED:
            message = "Nothing was changed: the request was withdrawn."
            self._report(
                published.kind,
                published.request,
                "NotDone",
                message,
                target=published.target,
                recovery=published.recovery,
            )

    def _leave(self, progress: Progress, target: PodIdentity | None) -> None:
        """Have an understudy deleted that was prepared and is not needed. A pod of the workload's own controller stays."""
        if target is not None and progress.strategy != Restart.name:
            self._garbage.add(target)

    def _rest(self, kind: Kind | None) -> None:
        """Delay the next attempt: by AGAIN seconds for a drain, else by CHECK_PERIOD."""
        self._next = time.monotonic() + (AGAIN if kind == "Drain" else CHECK_PERIOD)

    def _stop(self) -> None:
        if self._task is not None:
            self._task.cancel()
        self._task = self._wanted = self._progress = self._touched = None

    # -- reporting --------------------------------------------------------------------------------------------------

    def _is_new(self, wanted: Wanted) -> bool:
        """Whether the last report is about another request or about one that has ended."""
        published = self._notices.status.switchover
        return (
            published is None
            or published.phase in ENDED
            or (published.kind, published.request) != (wanted.kind, wanted.request)
        )

    def _report_progress(self, progress: Progress, phase: Phase, message: str, *, recovery: str = "") -> None:
        target = progress.target.name if progress.target is not None else ""
        kind = progress.switchover
        assert kind is not None, "it is a switchover"
        self._report(kind, progress.request, phase, message, target=target, recovery=recovery)

    def _end(self, phase: Phase, message: str, wanted: Wanted) -> None:
        """End the request without a change of the gate."""
        _logger.info("switchover (%s): %s", wanted.kind, message)
        known = self._notices.status.switchover
        self._report(wanted.kind, wanted.request, phase, message)
        if known is None or known.message != reported(message):
            kind, reason = ("Normal", "SwitchoverDone") if phase == "Done" else ("Warning", "SwitchoverNotDone")
            self._notices.event(kind, reason, message)

    def _report(
        self, kind: Kind, request: str, phase: Phase, message: str, *, target: str = "", recovery: str = ""
    ) -> None:
        before = self._notices.status.switchover
        status = SwitchoverStatus(
            kind=kind,
            request=request,
            handled=request if request and phase in ENDED else before.handled if before else "",
            phase=phase,
            message=message,
            target=target,
            recovery=recovery,
            since=before.since if before is not None and before.phase == phase else moment(),
        )
        self._notices.set_switchover(status)

"""The gate as the failover protocol uses it: commits over the last known epoch, and packets as the proof."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from pydantic import ValidationError

from understudy.api import names
from understudy.api.kinds.robot_workload import GateStatus
from understudy.clock import CLOCK
from understudy.failover import pinned
from understudy.failover.abandoned import AbandonedRecovery, ended
from understudy.failover.interfaces import GateState, Instance, NoLongerNeeded, Superseded
from understudy.failover.pinned import PinnedPod
from understudy.failover.progress import Progress, beside
from understudy.kube.client import FAILURES, NO_ANSWER, ApiError, Client, Object
from understudy.kube.gates.base import GateRecord, OwnSwitch, Proof
from understudy.kube.repeated_requests import RETRY_FIRST, RETRY_MOST, TRY_WITHIN, answered
from understudy.monitor.act.objects.pod_control import PodControl
from understudy.monitor.crash_points import CrashPoints
from understudy.monitor.notices import GateCommitted, Notices
from understudy.monitor.observe.objects.cluster_view import ClusterView

_logger = logging.getLogger(__name__)

WRITE_AGAIN = 1.0
"""Seconds before a failed repair of the gate is tried again."""

HEARD_AGAIN = 0.05
"""Seconds after the API server's return in which the robot may be heard again too, before an instance that is heard counts as failed."""

JUDGED_WITHIN = 0.2
"""Maximum seconds that a commit waits after the API server's return for a new judgement of the instance that it fences."""


@dataclass(frozen=True)
class OwnCommit:
    """The recovery that this monitor committed last."""

    recovery: str = ""
    """Its id; empty for none."""
    epoch: int = 0
    """The epoch of the gate since that commit."""
    sent: str = ""
    """The record that was sent with it."""

    def carried_out(self, record: GateRecord) -> bool:
        """Return whether the gate is as this commit made it: also one without an answer may have been carried out.

        The gate also has the record that was sent if another writer has closed it since and changed nothing else, so the epochs are
        compared too.
        """
        committed = beside(self.sent) if record.recovery == self.sent else None
        return committed is not None and record.epoch == committed.epoch


class _EarlierCommitFound(Exception):
    """The gate shows an earlier commit of the same recovery that was carried out without an answer."""


class GateControl:
    """Implements :class:`understudy.failover.interfaces.Gate` for one workload, over its kind of gate."""

    def __init__(
        self,
        client: Client,
        view: ClusterView,
        fleet: PodControl,
        probes: Proof,
        crash_points: CrashPoints,
        notices: Notices,
    ) -> None:
        self._client, self._view, self._fleet, self._probes = client, view, fleet, probes
        self._crash_points, self._kind, self._notices = crash_points, view.gate_kind, notices
        self._cached: tuple[int, GateState] = (-1, GateState())
        self._routed = -1
        """The revision of the gate that lets those through whom its record names."""
        self._refused: tuple[int, float] = (-1, 0.0)
        """The revision of the gate whose repair failed last, and when that may be tried again (monotonic seconds)."""
        self._own = OwnCommit()
        self._changing = asyncio.Lock()
        """Held while this monitor gives the gate a new epoch: it must not take one write of its own for that of another process."""

    @property
    def record(self) -> GateRecord | None:
        """The gate's record, as last seen or committed; None if there is no gate object."""
        return self._view.gate_record

    @property
    def exists(self) -> bool:
        """Whether the gate object exists."""
        return self.record is not None

    @property
    def state(self) -> GateState:
        """The gate's state, as last seen or committed."""
        if self._cached[0] != self._view.gates.revision:
            self._cached = (self._view.gates.revision, self._read())
        return self._cached[1]

    def _read(self) -> GateState:
        record = self.record
        if record is None:
            return GateState()
        recovery = None
        if record.recovery:
            try:
                recovery = Progress.of_record(record.recovery)
            except ValidationError as error:
                _logger.warning("the recovery record in the gate's annotations is invalid and is ignored: %s", error)
        return GateState(
            epoch=record.epoch,
            active=record.active,
            active_uid=record.active_uid,
            recovery=recovery,
            admitted=record.admitted,
            admitted_uid=record.admitted_uid,
            pinned=pinned.read(record.let_through),
        )

    async def commit(
        self,
        target: Instance | None,
        progress: Progress | None,
        *,
        leaking: Sequence[PinnedPod] = (),
        against: Collection[str] = (),
    ) -> GateState:
        """Open the gate for one instance, or close it (None), at the next epoch. The record keeps the identities of leaking instances too.

        ``against`` are the UIDs of those that must not reach the robot. Tries again until the API server answers.

        Raises ApiError if it refuses. Raises Superseded if another monitor lets one of ``against`` through, if a user has fenced the robot
        and the gate would be opened, if the gate does not exist, or if another writer changed it: during this commit, since the last commit
        of this recovery, or for a pod that this recovery is not about. Raises NoLongerNeeded if the instance that it would fence is healthy
        again, or was silent because somebody deleted the gate.
        """
        async with self._changing:
            while True:
                with contextlib.suppress(_EarlierCommitFound):
                    return await self._commit(target, progress, leaking, against)

    async def _commit(
        self,
        target: Instance | None,
        progress: Progress | None,
        leaking: Sequence[PinnedPod],
        against: Collection[str],
    ) -> GateState:
        previous = self.record
        if previous is None:
            raise Superseded(f"{self._kind.object_kind} {names.gate(self._view.workload)} does not exist")
        self._still_ours(previous, progress)
        self._probes.deciding()
        if (instance := target) is not None:
            await answered(lambda: self._fleet.label(instance))
        earlier = self._own
        record, retry, workload = previous, RETRY_FIRST, self._view.workload
        is_away = was_overtaken = False
        name, uid = (target.name, target.uid) if target else ("", "")
        self._crash_points.step("before commit")
        if progress is not None:
            _adopt_failures(progress, beside(previous.recovery), uid)
        recovery = progress.model_copy(update={"epoch": previous.epoch + 1}).record() if progress else ""
        waits_for = progress.waiting.pool if progress is not None and progress.waiting is not None else ""
        if progress is not None:
            self._own = OwnCommit(progress.id, previous.epoch, recovery)
        # The list lacks the active pod if an earlier version opened the gate for it.
        let_through = self._pinned(previous, target, self._fleet.find(previous.active_uid), leaking=leaking)
        asked = time.monotonic()
        while True:
            if reason := self._not_needed(record, progress):
                raise NoLongerNeeded(reason)
            if target is not None and self._view.fenced(record, time.time()):
                raise Superseded("a user has fenced the robot, and has not resumed it")
            try:
                patch = self._kind.commitment(
                    workload,
                    over=record,
                    active=name,
                    active_uid=uid,
                    recovery=recovery,
                    waits_for=waits_for,
                    let_through=let_through,
                )
                async with asyncio.timeout(TRY_WITHIN):
                    gate = await self._kind.write(self._client, self._view.namespace, workload, patch)
                break
            except ApiError as error:
                if error.not_found:
                    raise Superseded(f"{self._kind.object_kind} {names.gate(workload)} was deleted") from error
                if error.final and not error.conflict:
                    raise
                _logger.warning("could not commit to the gate, trying again: %s", error)
                if is_away:  # it answers again, and soon does what it is asked for
                    is_away, retry = False, RETRY_FIRST
                at_once, was_overtaken = error.conflict and not was_overtaken, was_overtaken or error.conflict
            except NO_ANSWER as error:
                _logger.warning("could not commit to the gate, trying again: the API server does not answer: %r", error)
                is_away, at_once = True, False
            if not at_once:
                await asyncio.sleep(retry)
                retry = min(2 * retry, RETRY_MOST)
            read = await self._reread(previous, uid, recovery, earlier)
            # The commit may have been carried out. That must be known first, because nothing records a recovery that was not needed.
            while read is None and self._not_needed(record, progress):
                await asyncio.sleep(retry)
                read = await self._reread(previous, uid, recovery, earlier)
            if read is not None and (read.active_uid in against or read.admitted_uid in against):
                raise Superseded(f"another process lets {read.admitted or read.active} through")
            record = read or record
            if record.epoch > previous.epoch:
                self._own = OwnCommit(self._own.recovery, record.epoch, recovery)
                return self.state
            if read is not None and progress is not None and self._fences_first(record, progress):
                await _judged_again(progress)
        self._notices.add(GateCommitted(time.monotonic() - asked))
        self._view.gates.put(gate)
        self._probes.committed(previous.epoch + 1)
        self._own = OwnCommit(self._own.recovery, previous.epoch + 1, recovery)
        self._crash_points.step("after commit")
        state = self.state
        self._notices.set(gate=GateStatus(epoch=state.epoch, active=state.active))
        return state

    async def take_over(self, progress: Progress) -> bool:
        """Name this monitor in the record of a recovery for which another one closed the gate, before it is continued. Returns False if
        another writer was first.

        The next epoch ends the commits of the other monitor, if it lives, and a third monitor sees who carries the recovery out. Does
        nothing if the record names this monitor, or another recovery. Raises what :meth:`commit` raises, except Superseded.
        """
        record, found = self.record, self.state.recovery
        if record is None or found is None or found.id != progress.id:
            return True
        if found.monitor == progress.monitor:
            # Also if a former process of this pod committed it, and the API server carried that out late.
            if found.epoch == record.epoch:
                self._own = OwnCommit(progress.id, record.epoch, record.recovery)
            return True
        if record.active:
            return True
        # This monitor may have carried it out before that other one did.
        self._own = OwnCommit(progress.id, record.epoch, record.recovery)
        try:
            await self.commit(None, progress)
        except Superseded as error:
            _logger.info("recovery %s is not continued: %s", progress.id, error)
            return False
        return True

    def _still_ours(self, previous: GateRecord, progress: Progress | None) -> None:
        """Raise Superseded if a recovery under way would undo the commit of another writer: a second monitor or ``understudy fence``.

        A commit for a recovery that is not under way may overwrite any other.
        """
        if progress is None or progress.result != "Running":
            return
        own = self._own
        if own.recovery == progress.id:
            if previous.epoch != own.epoch and not own.carried_out(previous):
                raise Superseded(
                    f"another process changed the gate to epoch {previous.epoch}; this recovery knew epoch {own.epoch}"
                )
            return
        about = [*progress.failed, progress.target, progress.former, progress.taken_over]
        if previous.active_uid and previous.active_uid not in {pod.uid for pod in about if pod is not None}:
            raise Superseded(
                f"another process changed the gate, which now admits {previous.active}; this recovery is for another instance"
            )
        was_open = progress.open_at is not None and previous.epoch != progress.open_at
        if was_open and not previous.active and (other := progress.another(beside(previous.recovery))) is not None:
            raise Superseded(f"recovery {other.id} has closed the gate since this recovery began")

    def _pinned(self, over: GateRecord, *let_through: Instance | None, leaking: Sequence[PinnedPod] = ()) -> str:
        """Return the pods that the gate let through of late, with these and those that leak, as JSON for its record; empty for none.

        The first is the one that drives, or that drove last.
        """
        named = [PinnedPod(name=i.name, uid=i.uid, ip=i.ip) for i in let_through if i is not None]
        pods = pinned.with_pods(pinned.read(over.let_through), *named, *leaking)
        return pinned.write(pods) if pods else ""

    def _not_needed(self, record: GateRecord, progress: Progress | None) -> str:
        """Return why a recovery need not commit; empty if it must.

        It would begin by fencing an instance that is healthy again, or that was silent because somebody deleted the gate. Or it would fence
        one that drives late.
        """
        if progress is not None and not record.active and record.epoch == progress.open_at:
            return f"somebody deleted the gate, and {progress.failed[0].name} could not reach the robot then"
        if _admits_late(record, progress):
            return f"{record.active} drives by now, and was not fenced yet"
        if progress is not None and progress.healthy_again and self._fences_first(record, progress):
            return f"{record.active} has been healthy again since the API server could not be reached"
        return ""

    def would_fence(self, progress: Progress) -> bool:
        """Whether the next commit of a recovery would begin it by fencing the instance that failed."""
        record = self.record
        return record is not None and self._fences_first(record, progress)

    def _fences_first(self, record: GateRecord, progress: Progress) -> bool:
        """Whether a commit would begin a recovery by fencing the instance that failed."""
        if not progress.failed or record.active_uid != progress.failed[0].uid:
            return False
        begun = beside(record.recovery)
        return begun is None or begun.id != progress.id

    async def admit(self, standby: Instance | None) -> bool:
        """Let a standby through beside the active pod, or no standby (None). Returns whether the gate was written.

        A failed write is not repeated: a commit matters more and may be waiting, and the caller soon decides again.
        """
        record = self.record
        if record is None or not record.active:
            return False
        name, uid = (standby.name, standby.uid) if standby else ("", "")
        try:
            if standby is not None:
                await self._fleet.label(standby)
            let_through = self._pinned(record, self._fleet.find(record.active_uid), standby)
            patch = self._kind.admission(
                self._view.workload, over=record, admitted=name, admitted_uid=uid, let_through=let_through
            )
            await self._write_once(patch)
        except FAILURES as error:
            _logger.warning("could not admit %s at the gate: %r", name or "no standby", error)
            return False
        return True

    async def restore_routing(self) -> bool:
        """Let those through again whom the record names, if somebody edited the gate. Returns whether the gate was written.

        Control does not change, so the epoch stays. A failed write is repeated by a later call: once the gate has changed, or after
        WRITE_AGAIN seconds.
        """
        revision = self._view.gates.revision
        if revision == self._routed:  # each evaluation asks
            return False
        if revision == self._refused[0] and time.monotonic() < self._refused[1]:
            return False
        record, gate = self.record, self._view.gate_object
        if record is None or gate is None:
            return False
        fields = self._kind.routing_repair(gate, self._view.workload, record.active, record.admitted)
        if not fields:
            self._routed = revision
            return False
        patch = {"metadata": {"resourceVersion": record.version}} | fields
        try:
            await self._write_once(patch)
        except FAILURES as error:
            _logger.warning("could not restore whom the gate lets through: %r", error)
            self._refused = (revision, time.monotonic() + WRITE_AGAIN)
            return False
        self._report_restored(
            f"the gate did not let through {record.active or 'nobody'}, as its record says: somebody had edited it"
        )
        return True

    async def restore_record(self, progress: Progress) -> bool:
        """Name a recovery under way beside the gate again, if somebody deleted the gate and the operator created another one.

        A monitor that succeeds this one would not know of it otherwise. Control does not change, so the epoch stays. Returns whether the
        gate was written. A failed write is repeated by a later call.
        """
        record, own = self.record, self._own
        if (
            record is None
            or record.recovery
            or record.active
            or (own.recovery, own.epoch) != (progress.id, record.epoch)
        ):
            return False
        if (committed := beside(own.sent)) is None or committed.epoch != own.epoch:
            return False  # its commit is under way
        recovery = progress.model_copy(update={"epoch": own.epoch}).record()
        waits_for = progress.waiting.pool if progress.waiting is not None else ""
        try:
            await self._write_once(self._kind.noting(over=record, recovery=recovery, waits_for=waits_for))
        except FAILURES as error:
            _logger.warning("could not name recovery %s beside the gate again: %r", own.recovery, error)
            return False
        self._own = replace(own, sent=recovery)
        self._report_restored(f"the gate no longer named recovery {own.recovery}: somebody had deleted it")
        return True

    def epoch_problem(self, known: int = 0) -> str:
        """Return why what the gate says is not carried out, and would be at a greater epoch; empty if that would not help.

        An older gate, which somebody deleted, may have come further: the mux at the robot, or an agent, which knows the epoch ``known``,
        refuses what is older. And somebody at the robot may have switched by itself to an instance that is gone, or of which nothing was
        let through: it returns to a replaced instance only by an order that knows the switch.
        """
        record = self.record
        if record is None:
            return ""
        if (
            (switch := self._probes.own_switch(record.active)) is not None
            and record.active
            and self._is_in_vain(switch)
        ):
            return f"{switch.to}, to which the mux at the robot had switched by itself, does not drive"
        if epoch := self._probes.carried_out(record.epoch):
            return f"epoch {epoch} had been carried out at the robot, and the gate was of epoch {record.epoch}: somebody had deleted it"
        if known > record.epoch:
            return f"an agent knows epoch {known}, and the gate was of epoch {record.epoch}: somebody had deleted it"
        return ""

    async def raise_epoch(self, known: int = 0) -> None:
        """Give the gate the next epoch if a greater one would help. Whom it names does not change.

        A later call repeats a failed write, and goes on if that epoch is not great enough: the admission policy lets a monitor increase it
        by one only. If the gate of the newest epoch still exists, and only the watch is late, the API server refuses the write.
        """
        if self._changing.locked():
            return  # the commit under way gives it the next epoch
        async with self._changing:
            record, problem = self.record, self.epoch_problem(known)
            if record is None or not problem:
                return
            self._probes.deciding()
            epoch = record.epoch + 1
            try:
                await self._write_once(self._kind.raising(over=record, epoch=epoch))
            except FAILURES as error:
                _logger.warning("could not raise the epoch of the gate: %r", error)
                return
        if self._own.epoch == record.epoch:
            self._own = replace(self._own, epoch=epoch)
        self._probes.committed(epoch)
        self._notices.set(gate=GateStatus(epoch=epoch, active=record.active))
        self._report_restored(problem)

    def _is_in_vain(self, switch: OwnSwitch) -> bool:
        """Whether the instance to which somebody at the gate has switched cannot be put in control, and the active one drives instead."""
        is_gone = not any(one.name == switch.to and one.usable for one in self._fleet.of_workload())
        return switch.active_sends and (switch.is_idle or is_gone)

    def _report_restored(self, words: str) -> None:
        _logger.warning("restored the gate: %s", words)
        self._notices.event("Warning", "GateRestored", words)

    def left_by(self, recovery: str) -> AbandonedRecovery | None:
        """Return the record that a recovery (given by its id) has left at the gate or may still leave there; None if there is none."""
        if self._own.recovery == recovery:
            return AbandonedRecovery(id=recovery, epoch=self._own.epoch, sent=self._own.sent)
        record = self.record
        found = beside(record.recovery) if record is not None else None
        if record is None or found is None or found.id != recovery:
            return None
        return AbandonedRecovery(id=recovery, epoch=record.epoch, sent=record.recovery)

    async def end_recovery(self, over: GateRecord) -> None:
        """Mark the recovery in this record as ended, if the gate still has this record.

        A failed write is not repeated, for the same reason as in :meth:`admit`.
        """
        found = beside(over.recovery)
        if found is None:
            return
        patch = self._kind.noting(over=over, recovery=ended(found).model_dump_json())
        try:
            await self._write_once(patch)
        except FAILURES as error:
            _logger.warning("could not mark recovery %s as abandoned at the gate: %r", found.id, error)
            return
        _logger.info("marked recovery %s as abandoned at the gate", found.id)

    async def overtake(self, over: GateRecord, abandoned: AbandonedRecovery) -> bool:
        """Prevent that a commit of an abandoned recovery is carried out later, if it was sent over this record.

        Returns whether the gate was written.

        A failed write is not repeated, for the same reason as in :meth:`admit`.
        """
        patch = self._kind.overtaking(over=over, recovery=abandoned.id)
        try:
            await self._write_once(patch)
        except FAILURES as error:
            _logger.warning("could not overtake the commit of recovery %s: %r", abandoned.id, error)
            return False
        return True

    async def _write_once(self, patch: Object) -> None:
        """Write to the gate, and note the gate that the API server answers with. Raises one of FAILURES."""
        try:
            async with asyncio.timeout(TRY_WITHIN):
                gate = await self._kind.write(self._client, self._view.namespace, self._view.workload, patch)
        except ApiError as error:
            if error.conflict:  # the watch may be half-open, so that the record stays the old one
                await self._read_again()
            raise
        self._view.gates.put(gate)

    async def _read_again(self) -> Object | None:
        """Read the gate, and note it. Returns None if it cannot be read."""
        try:
            async with asyncio.timeout(TRY_WITHIN):
                gate = await self._client.get(
                    self._kind.resource, self._view.namespace, names.gate(self._view.workload)
                )
        except FAILURES:
            return None
        self._view.gates.put(gate)
        return gate

    async def _reread(self, previous: GateRecord, uid: str, recovery: str, earlier: OwnCommit) -> GateRecord | None:
        """Read the gate after a refused or unanswered commit, which may have been carried out. Returns None if the gate cannot be read.

        Raises Superseded if another writer has changed it, and _EarlierCommitFound if only an earlier commit of the same recovery has,
        whose answer was lost.
        """
        if (gate := await self._read_again()) is None:
            return None
        record = GateRecord.of(gate)
        ours = record.epoch == previous.epoch + 1 and record.active_uid == uid and record.recovery == recovery
        if record.epoch != previous.epoch and not ours:
            if earlier.recovery == self._own.recovery and earlier.carried_out(record):
                self._own = earlier
                raise _EarlierCommitFound
            raise Superseded(
                f"another process changed the gate to epoch {record.epoch}; this monitor knew epoch {previous.epoch}"
            )
        return record

    async def lets_through(self, instance: Instance) -> bool:
        """Return whether the gate names an instance at this moment, as read from the API server. Raises what the
        request raises."""
        gate = await self._client.get(self._kind.resource, self._view.namespace, names.gate(self._view.workload))
        record = GateRecord.of(gate)
        return instance.uid in (record.active_uid, record.admitted_uid)

    async def enforced(self, target: Instance, *, since: float) -> float:
        """Wait until a packet of the instance passes the gate. Returns when the first one did."""
        return await self._probes.wait(target.uid, since)

    @property
    def unanswered_since(self) -> float | None:
        """Since when (by the event loop's clock) the API server has not answered; None while it answers."""
        return self._client.contact.unanswered_since

    @property
    def last_outage(self) -> tuple[float, float] | None:
        """When (by the event loop's clock) the last outage of the API server began and ended; None for a mux, which gets its orders from
        the monitor."""
        return None if self._kind.is_at_robot else self._client.contact.last_outage

    def last_packet(self, uid: str) -> float | None:
        """Return when a packet of a pod last passed the gate; None if none did."""
        last = self._probes.last(uid)
        return CLOCK.of_system(last) if last is not None else None


def _admits_late(record: GateRecord, progress: Progress | None) -> bool:
    """Whether a gate admits an instance that drives, although it did not within the time of its strategy."""
    late = progress.drives_late if progress is not None else None
    return late is not None and record.active_uid == late.uid


async def _judged_again(progress: Progress) -> None:
    """Wait until the failed instance was judged by what was received since now, if the decision is old enough to be judged again.

    One link may have been cut to the robot and to the API server, which answers again.
    """
    loop = asyncio.get_running_loop()
    answered = now = loop.time()
    while 0 < progress.judged_at < answered + HEARD_AGAIN and now < answered + JUDGED_WITHIN:
        await asyncio.sleep(JUDGED_WITHIN / 20)
        now = loop.time()


def _adopt_failures(progress: Progress, other: Progress | None, target_uid: str) -> None:
    """Add the pods that failed in a recovery that a commit ends, or in another monitor's part of the same recovery.

    No other record has them, and they are to be deleted.
    """
    if other is None or other.result != "Running":
        return
    if (other.id, other.monitor) != (progress.id, progress.monitor):
        for pod in other.failed:
            if pod.uid != target_uid:
                progress.fail(pod)

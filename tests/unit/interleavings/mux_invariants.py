"""What must hold of a robot with a mux, beside what always must (invariants.py):

- The robot receives the commands of instances in the order of their tokens: the token of a command is never less than that of one before,
  and the commands of one token are of one instance. That holds over all restarts of the mux.
- Only if the journal is lost, this order begins again, since the mux cannot know what it had carried out: the first order that it receives
  may be that of a monitor that lost the API server long ago. Until then it forwards nobody. And from then on the order holds among
  what follows.
- With a token of the gate, the mux forwards whom the gate named at this epoch. With a token of its own, it forwards a successor that
  sends, in place of an instance that was silent for the deadline, and none that it replaced before in this epoch.
- No command is forwarded that had arrived before its instance was put in control.
- The instance on board is forwarded only while the one in control is silent, or nobody is in control. It only stands in: each order of a
  newer epoch replaces it, except that one which names nobody leaves it in control.
- An order that names another instance than the one to which the mux has switched by itself is carried out only if the monitor that
  committed it knew the switch.
- Once an order has arrived, nobody is forwarded by an older one. If it names nobody, nobody is forwarded at all.
- A monitor that nothing hinders does not report Healthy for long while the mux forwards another instance than the gate names, nor
  GateEnforced while it does not forward that one.
- Where nothing hinders the monitor and the mux, they and the gate agree on the instance within seconds.

And in the end: gate, mux and monitor agree on one instance, which drives, GateEnforced is True, each switch that a monitor has committed is
recorded, unless a user's fence ended its recovery or its monitor was killed in the next one, and with a reflex a standby is admitted if one
works.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

from tests.unit.interleavings import gates
from tests.unit.interleavings.apiserver import EPOCH
from tests.unit.interleavings.drivers import NOTICED
from tests.unit.interleavings.invariants import Invariants
from tests.unit.interleavings.mux_processes import Mux, Sample
from tests.unit.interleavings.mux_robots import MuxRobots
from tests.unit.interleavings.mux_senses import MuxMonitor
from tests.unit.interleavings.pods import Running
from tests.unit.interleavings.scenes import ON_BOARD
from understudy.api.protocol.mux_messages import Token
from understudy.failover.progress import beside
from understudy.kube.client import Object
from understudy.kube.gates.base import GateRecord
from understudy.kube.gates.mux_reports import SILENT
from understudy.monitor.judge.failure_detection import UNREACHED
from understudy.monitor.report.status_writer import ANSWERED_WITHIN, UNDER_WAY
from understudy.mux.control import Control
from understudy.mux.forwarder import DISCOVERY

REPORTED = SILENT + 3.0
"""Seconds after which a monitor reports that its mux does not forward whom it should: it is judged once a second."""

STOOD_IN = UNREACHED + 6.0
"""Seconds after which a monitor does not report Healthy any more while the instance on board drives: it judges reports once a second."""

AGREED = 10.0
"""Seconds within which the mux forwards whom the gate names, if nothing hinders anybody."""

COMMITTED = 60.0
"""Seconds within which a switch of the mux's own is committed, if nothing hinders anybody and nobody pauses the robot."""

LISTED = UNDER_WAY + ANSWERED_WITHIN
"""Seconds after the first commit of a recovery within which the status lists the one before it."""

MOMENT = 1e-6


@dataclass
class Received:
    """What one robot has received, and its mux was ordered, since its journal was new."""

    token: Token = field(default_factory=Token)
    """Of the last command."""
    owners: dict[Token, str] = field(default_factory=dict)
    """The instance of each token."""
    begun: int = 0
    """The number of the last sample that had arrived when the present instance was put in control."""
    since: float = 0.0
    """When that was, or when the process began (virtual seconds)."""
    newest: tuple[int, str] = (-1, "")
    """Epoch and instance of the newest order that the present process has received."""
    may_stand_in: bool = False
    """Whether this order has an instance on board."""
    replaced: set[str] = field(default_factory=set)
    """Whom the mux has replaced in the present epoch."""


class MuxInvariants(Invariants):
    """What holds of muxes. Implements :class:`tests.unit.interleavings.mux_processes.Witness`."""

    def __init__(
        self, *arguments: Any, deadline: float, after: float, known: Callable[[str], Token], **more: Any
    ) -> None:
        """``deadline`` is that of the reflex, and ``after`` that of the instance on board, in seconds.

        ``known`` returns the newest token that a monitor has received.
        """
        super().__init__(*arguments, **more)
        self._deadline, self._after, self._known = deadline, after, known
        self._received: dict[str, Received] = defaultdict(Received)
        self._names: dict[str, dict[int, set[str]]] = defaultdict(lambda: defaultdict(set))
        """By workload and epoch, the instances that the gate named: several only if somebody deleted it."""
        self._knew: dict[str, dict[int, Token]] = defaultdict(dict)
        """By workload and epoch, the newest token that the monitor knew when it committed this."""
        self._writers: dict[str, dict[int, tuple[str, str]]] = defaultdict(dict)
        """By workload and epoch, who committed this and for which recovery. A gate is opened for the first time without one."""
        self._unrecorded: dict[str, dict[tuple[str, str], tuple[str, str]]] = defaultdict(dict)
        """By workload, the instances between which a mux has switched, and who committed that for which recovery."""
        self._ended_by_fence: dict[str, str] = {}
        """By workload, the recovery that was at the gate when a user last fenced the robot."""
        self._given_up: set[str] = set()
        """Monitors that were killed, and whose recoveries no other one continues."""
        self._killed: set[str] = set()
        """Monitors that were killed. What they had sent may be carried out later."""
        self._latest: dict[str, tuple[str, float]] = {}
        """By workload, the recovery at the gate, and when it was first there (virtual seconds)."""
        self._recorded: dict[str, set[str]] = defaultdict(set)
        """By workload, the instances that its recoveries name."""
        self._wrong_since: dict[tuple[str, str], float] = {}
        self.counts: Counter[str] = Counter()
        for workload, gate in gates.everyone(self._server):
            self._note(workload, GateRecord.of(gate))

    @property
    def mine(self) -> MuxRobots:
        """The robots."""
        return cast(MuxRobots, self._robots)

    # -- at every write ---------------------------------------------------------------------------------------------

    def see(self, plural: str, old: Object | None, new: Object | None, by: str) -> None:
        super().see(plural, old, new, by)
        if new is not None and gates.is_gate(plural, new):
            workload, record = new["metadata"]["name"].removesuffix("-gate"), GateRecord.of(new)
            before = GateRecord.of(old) if old is not None else None
            if before is None or (before.epoch, before.active_uid) != (record.epoch, record.active_uid):
                self._note(workload, record)
                self._knew[workload][record.epoch] = self._known(by)
                self._recovers(workload, record, by)
                if by == "somebody" and record.fenced:
                    self._ended_by_fence[workload] = _recovery(record)
                if record.recovery or (before is not None and before.active):
                    self._writers[workload][record.epoch] = by, _recovery(record)
        elif plural == "robotworkloads" and new is not None:
            for recovery in (new.get("status") or {}).get("recoveries") or []:
                pods = {recovery.get("toPod", ""), *(one.get("pod", "") for one in recovery.get("attempts") or [])}
                self._recorded[new["metadata"]["name"]] |= {*pods, f"from {recovery.get('fromPod', '')}"}

    def _recovers(self, workload: str, record: GateRecord, by: str) -> None:
        """A recovery that another monitor replaces by one of its own is given up, and not recorded.

        Nor is one that its own monitor replaces by the next one, if that monitor was killed after it had sent this.
        """
        recovery, switches = _recovery(record), self._unrecorded[workload]
        if recovery != self._latest.get(workload, ("", 0.0))[0]:
            self._latest[workload] = recovery, self._now
        self._unrecorded[workload] = {
            pods: (monitor, id_)
            for pods, (monitor, id_) in switches.items()
            if recovery in ("", id_) or (by == monitor and by not in self._killed)
        }

    def _note(self, workload: str, record: GateRecord) -> None:
        self._names[workload][record.epoch].add(record.active)

    def _heard_since(self, found: Running) -> float:
        is_unheard = bool(self._robots.network.apart) or found.uid in self.mine.unheard
        joined_at = self._robots.now if is_unheard else self.mine.joined_at
        return max(super()._heard_since(found), joined_at)

    # -- what muxes do ----------------------------------------------------------------------------------------------

    def loaded(self, mux: Mux, control: Control, *, is_journal_lost: bool) -> None:
        """A mux has started: it knows at least what it had forwarded, unless its journal was lost."""
        received = self._received[mux.workload]
        if is_journal_lost:
            self.counts["journals lost"] += 1
            received.token, received.owners = Token(), {}
            if control.source:
                self._broken(f"{mux.process} forwards {control.source}, and its journal is lost")
        elif control.token < received.token:
            self._broken(f"{mux.process} knows {_text(control.token)}, and had forwarded {_text(received.token)}")
        received.begun, received.since = mux.arrivals, self._now
        received.newest = (control.token.epoch, control.source)
        received.may_stand_in = control.standing.on_board is not None

    def received(self, mux: Mux, text: str) -> None:
        """An order was carried out or refused: whom a newer one than all before fences is not forwarded any more.

        What had arrived before it was forwarded first.
        """
        order, received, control = _order(text), self._received[mux.workload], mux.control
        if (epoch := int(order["token"][1])) > received.newest[0]:
            received.newest = (epoch, order["source"])
            received.may_stand_in = bool(order["standing"].get("onBoard"))
        epoch, source = received.newest
        self.counts["orders refused for a switch"] += "by itself" in mux.refuses
        stands_in = control is not None and control.on_board and received.may_stand_in
        if control is not None and not source and control.token.epoch <= epoch and control.source and not stands_in:
            self._broken(f"{mux.process} forwards {control.source}, and epoch {epoch} names nobody")

    def decided(self, mux: Mux, before: Control, after: Control) -> None:
        """The control of a mux has changed."""
        received = self._received[mux.workload]
        if after.token < before.token:
            self._broken(f"{mux.process} goes from {_text(before.token)} back to {_text(after.token)}")
        if replace(after.token, count=0) != replace(before.token, count=0):
            received.replaced = set()
            self._ordered(mux, before, after)
        elif after.token != before.token:
            self._switched(mux, before, after)
        if before.source != after.source:
            received.begun, received.since = mux.arrivals, self._now
            self._robots.noted(f"{mux.process} forwards {after.source or 'nobody'} ({_text(after.token)})")

    def _ordered(self, mux: Mux, before: Control, after: Control) -> None:
        workload, epoch = mux.workload, after.token.epoch
        self.counts["ordered"] += 1
        if before.on_board and after.on_board and "" in self._names[workload][epoch]:
            return
        if after.source not in self._names[workload][epoch]:
            self._broken(f"{mux.process} forwards {after.source} by epoch {epoch}, in which the gate did not name it")
        if not before.token.count or before.on_board:
            return
        if after.source not in ("", before.source) and self._knew[workload].get(epoch, Token()) < before.token:
            self._broken(
                f"{mux.process} forwards {after.source} by epoch {epoch}, which undoes the switch to {before.source} "
                f"({_text(before.token)}): its monitor knew {_text(self._knew[workload].get(epoch, Token()))}"
            )
        if after.source and after.source == before.source:  # a mux that could not keep an order forwards nobody, too
            self.counts["switches committed"] += 1
            if (commit := self._writers[workload].get(epoch)) is not None and commit[0] not in self._given_up:
                self._unrecorded[workload][before.ordered, after.source] = commit

    def _switched(self, mux: Mux, before: Control, after: Control) -> None:
        received, now = self._received[mux.workload], self._now
        if before.on_board and after.source == before.ordered:
            self.counts["returned"] += 1
            received.replaced = set()  # control returned by an order
            return
        self.counts["stood in" if after.on_board else "switched"] += 1
        deadline = self._after if after.on_board else self._deadline
        # An instance may stop before it was discovered. That takes longer than a reflex, and less than the silence for one on board. One
        # that was silent for as long as discovery may take may send again before it is discovered, and one with a new process at any time.
        is_undiscovered = before.source in mux.last_known or now - mux.began >= DISCOVERY
        last = mux.last_known if after.on_board or is_undiscovered else mux.last
        silent = now - max(last.get(before.source, received.since), received.since)
        heard = now - max(mux.last.get(after.source, 0.0), mux.taken.get(after.source, 0.0))
        if silent < deadline - MOMENT:
            self._broken(f"{mux.process} replaces {before.source}, which it has heard {silent:.3f} s ago")
        if heard > deadline + MOMENT:
            self._broken(f"{mux.process} switches to {after.source}, which it has not heard for {heard:.3f} s")
        received.replaced.add(before.source)
        if after.source in received.replaced and not after.on_board:
            self._broken(f"{mux.process} switches back to {after.source} without an order")

    def forwarded(self, mux: Mux, token: Token, sample: Sample) -> None:
        """A robot receives a command."""
        received, workload = self._received[mux.workload], mux.workload
        name = self._sender(sample.uid)
        self.counts["forwarded"] += 1
        if token < received.token:
            self._broken(f"{workload} receives {name} of {_text(token)} after one of {_text(received.token)}")
        if received.owners.setdefault(token, sample.uid) != sample.uid:
            other = self._sender(received.owners[token])
            self._broken(f"{workload} receives {name} and {other}, both of {_text(token)}")
        if sample.number <= received.begun:
            self._broken(f"{workload} receives what {name} had sent before it was in control")
        if not token.count and name not in self._names[workload][token.epoch]:
            self._broken(f"{workload} receives {name} of epoch {token.epoch}, in which the gate did not name it")
        epoch, source = received.newest
        # One that stands in stays if its mux could not keep an order that names nobody.
        stands_in = name == ON_BOARD and not source and received.may_stand_in
        if token.epoch < epoch and not (token.count and source) and not stands_in:
            self._broken(f"{workload} receives {name} of {_text(token)}, and its mux was ordered epoch {epoch}")
        received.token = token

    def _sender(self, uid: str) -> str:
        return ON_BOARD if uid == ON_BOARD else self._robots.running[uid].name

    @property
    def _now(self) -> float:
        return self._robots.loop.time()

    # -- now and then -----------------------------------------------------------------------------------------------

    def look(self, workload: str, monitors: Sequence[MuxMonitor], *, is_unhindered: bool) -> None:
        """Compare mux, gate, and what monitors report."""
        mux, record = self.mine.muxes[workload], gates.record(self._server, workload)
        source = mux.control.source if mux.control is not None and mux.runs() else ""
        if workload in self._ended_by_fence:  # a monitor may learn of the fence only after the user has resumed
            self._excuse_fenced(workload, monitors)
        for monitor in monitors:
            known, who = monitor.gate_record, str(monitor.process)
            active = known.active if known is not None else ""
            says = monitor.says()
            is_healthy = says is not None and says.health == "Healthy"
            self._lasts(
                (who, "Healthy"),
                is_healthy and source not in ("", active),
                STOOD_IN if source == ON_BOARD else NOTICED,
                monitor.hindered_at,
                f"{who} says that {workload} is Healthy with {active}, and the mux forwards {source}",
            )
            self._lasts(
                (who, "GateEnforced"),
                known is not None and monitor.condition("GateEnforced")[0] == "True" and source != active,
                REPORTED,
                monitor.absent_at,
                f"{who} says that the gate of {workload} is enforced for {active}, and the mux forwards {source or 'nobody'}",
            )
        named = record.active if record is not None else ""
        differs = is_unhindered and record is not None and source != named
        is_own = mux.control is not None and mux.control.token.count > 0
        words = (
            f"nothing hinders {workload}, its gate names {named or 'nobody'}, and the mux forwards {source or 'nobody'}"
        )
        self._lasts((workload, "own"), differs and is_own, COMMITTED, 0.0, words)
        self._lasts((workload, "agreement"), differs and not is_own, AGREED, 0.0, words)

    def _excuse_fenced(self, workload: str, monitors: Sequence[MuxMonitor]) -> None:
        """A recovery that a user's fence ends is not recorded, if its monitor had not ended it and reports that it is superseded.

        Nor is it if its monitor was killed: the successor finds the fence before or while it continues the recovery.
        """
        superseded = {one.process.name for one in monitors if one.condition("Recovering")[1] == "Superseded"}
        superseded |= self._killed
        ended, switches = self._ended_by_fence.get(workload, ""), self._unrecorded[workload]
        self._unrecorded[workload] = {
            pods: (monitor, id_)
            for pods, (monitor, id_) in switches.items()
            if id_ != ended or monitor not in superseded
        }

    def _lasts(self, what: tuple[str, str], so: bool, within: float, excused_until: float, words: str) -> None:
        """Break if something has been so for longer than it may be. ``excused_until`` is in Unix seconds."""
        if not so:
            self._wrong_since.pop(what, None)
            return
        since = self._wrong_since.setdefault(what, self._now)
        lasts = self._now - max(since, excused_until - EPOCH)
        if lasts > within:
            self._broken(f"{words}, for {lasts:.1f} s")

    # -- once all is calm -------------------------------------------------------------------------------------------

    def unrest(self) -> list[str]:
        return [*super().unrest(), *self._disagreement(), *self._missing()]

    def _disagreement(self) -> Iterator[str]:
        for workload, mux in sorted(self.mine.muxes.items()):
            record, control = gates.record(self._server, workload), mux.control
            if record is None or control is None:
                continue
            has_switched = control.on_board or (control.token.count > 0 and not self._after)
            if has_switched or (control.token.epoch, control.source) != (record.epoch, record.active):
                yield (
                    f"the mux of {workload} forwards {control.source or 'nobody'} by {_text(control.token)}, and the gate names "
                    f"{record.active or 'nobody'} at epoch {record.epoch}"
                )

    def _missing(self) -> Iterator[str]:
        for workload, switches in sorted(self._unrecorded.items()):
            for former, pod in sorted(switches):
                if not {pod, f"from {former}"} & self._recorded[workload]:
                    yield f"the switch of the mux of {workload} to {pod} was committed, and no recovery is recorded"

    def killed(self, monitor: str, workload: str, continued: str) -> None:
        """A monitor was killed. Its successor continues the recovery ``continued``; empty if no other monitor continues any.

        None does if another monitor runs already, or the gate names no recovery that is under way, as after a fence: the journal may be
        lost too. The recovery before the one that is continued has ended, and only the status lists it, which may not be written yet.
        """
        self._killed.add(monitor)
        if not continued:
            self._given_up.add(monitor)
        is_listed = self._now - self._latest.get(workload, ("", 0.0))[1] >= LISTED
        self._unrecorded[workload] = {
            pods: (by, id_)
            for pods, (by, id_) in self._unrecorded[workload].items()
            if by != monitor or (continued and (id_ == continued or is_listed))
        }


def _order(text: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(text.partition(" ")[2])
    return found


def _recovery(record: GateRecord) -> str:
    """The id of the recovery in a record; empty if there is none."""
    found = beside(record.recovery)
    return found.id if found is not None else ""


def _text(token: Token) -> str:
    return f"epoch {token.epoch}" + (f", switch {token.count}" if token.count else "")

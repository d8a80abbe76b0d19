"""What the mux at the robot reports, as the evidence of whom the gate lets through.

The monitor passes on what the gate object says, as an order. The mux acknowledges it and reports whom it forwards, so nothing is inferred
from packets. A report counts if it repeats the nonce of a recent order: an old one that somebody records and sends again does not.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from understudy.api.protocol.mux_messages import Order, Report, Token
from understudy.clock import CLOCK
from understudy.kube.gates import base

SILENT = 3.0
"""Seconds without a report after which the mux counts as gone. It reports once a second."""

SWITCHED_BY_MUX = "SwitchedByMux"
"""Reason of the condition GateEnforced while the mux forwards another instance than the gate names, by its standing order."""

NO_MUX = "NoMux"
"""Reason of the condition GateEnforced while no mux reports."""

HEARD = 1.0
"""Seconds within which an instance that sends on all outputs was heard on each."""

ON_BOARD_NOTED = 2.0
"""Seconds for which it counts that the instance on board drove: control may return a moment after the mux is heard again."""

NONCES = 16
"""Orders whose nonces count: the mux may answer an earlier one while the next is under way."""


@dataclass(frozen=True)
class Received:
    """A report, and when it arrived."""

    report: Report
    at: float
    """By the process's clock (understudy.clock)."""

    @property
    def forwarding_since(self) -> float:
        """When the mux forwarded the first command of the present instance; infinite if it has not."""
        return self.at - self.report.since if math.isfinite(self.report.since) else math.inf


class MuxReports:
    """Implements :class:`understudy.kube.gates.base.Proof` for one workload."""

    leak_hint = block_hint = ""

    def __init__(self) -> None:
        self.latest: Received | None = None
        self.wanted = asyncio.Event()
        """Set when the gate object has changed, so that an order is due."""
        self._ordered: tuple[str, Order] | None = None
        self._decided_with = Token()
        self._known: tuple[int, Token] = (0, Token())
        """The epoch that this monitor committed last, and the newest token that it knew when it decided that."""
        self._nonces: OrderedDict[str, int] = OrderedDict()
        """Those of the recent orders, with the epoch of each."""
        self._acknowledged: dict[str, float] = {}
        self._rival: tuple[str, float] = ("", -math.inf)
        """Another mux that reports, and when it last did."""
        self._on_board_at = -math.inf
        """When the mux last reported that it forwards the instance on board."""
        self._idle_since: float | None = None
        """Since when the mux has forwarded nothing of the instance to which it had switched by itself, as far as it has reported that."""
        self._changed = asyncio.Event()
        self._began = time.monotonic()

    # -- What the monitor orders and receives ---------------------------------------------------------------------------

    def ordered(self, uid: str, order: Order, nonce: str) -> None:
        """Note an order that is about to be sent. ``uid`` is that of the instance that it names; empty for nobody."""
        self._ordered = (uid, order)
        self._nonces[nonce] = order.epoch
        if len(self._nonces) > NONCES:
            self._nonces.popitem(last=False)

    def add(self, report: Report) -> None:
        """Note a report that is authentic, if it answers a recent order."""
        if report.nonce not in self._nonces:
            return
        if self.mux and report.mux != self.mux and not self.is_silent:
            self._rival = report.mux, CLOCK.now()
            return
        if report.mux != self.mux:
            self.wanted.set()  # no mux carries out an order that does not name it
        self.latest = Received(report, CLOCK.now())
        if report.on_board:
            self._on_board_at = self.latest.at
        is_idle, at = bool(report.token.count) and not report.forwarded, self.latest.at
        # It may have been idle while the mux could not report.
        quiet = at - min(report.heard.get(report.source, {}).values(), default=0.0)
        self._idle_since = min(self._idle_since or at, quiet) if is_idle else None
        if (uid := self._driver()) is not None:
            self._acknowledged[uid] = self.latest.at
        self._changed.set()
        self._changed = asyncio.Event()

    def _driver(self) -> str | None:
        """Return the UID of the instance that is ordered and forwarded; None if the mux has not carried the order out."""
        if self.latest is None or self._ordered is None:
            return None
        (uid, order), report = self._ordered, self.latest.report
        is_carried_out = report.token >= order.token and report.source == order.source
        return uid if is_carried_out and uid else None

    @property
    def mux(self) -> str:
        """The identity of the mux that reports; empty if none has. Another one replaces it when it is silent."""
        return self.latest.report.mux if self.latest is not None else ""

    @property
    def is_silent(self) -> bool:
        """Whether no report has arrived of late."""
        return self.latest is None or CLOCK.now() - self.latest.at > SILENT

    @property
    def strangers(self) -> Sequence[str]:
        """The writers that reach the robot beside the mux, each with its output."""
        return () if self.latest is None or self.is_silent else self.latest.report.strangers

    def forwarded(self, source: str) -> Received | None:
        """Return the latest report if the mux forwards commands of an instance by it; None if it does not."""
        found = self.latest
        if found is None or found.report.source != source or not found.report.forwarded:
            return None
        return found

    def heard(self) -> Mapping[str, float]:
        """Return when the instance that is forwarded was last heard, by output and the process's clock."""
        found = self.latest
        if found is None or not found.report.source:
            return {}
        return {output: found.at - age for output, age in found.report.heard.get(found.report.source, {}).items()}

    def last_heard(self, source: str, output: str) -> float:
        """Return when the mux last heard an output of an instance, by its latest report and the process's clock; -inf if it has not."""
        found = self.latest
        age = found.report.heard.get(source, {}).get(output) if found is not None else None
        return found.at - age if found is not None and age is not None else -math.inf

    def hears(self, source: str, outputs: Iterable[str]) -> bool:
        """Return whether the mux hears each of these outputs of an instance, whether it forwards the instance or not."""
        ages = self.latest.report.heard.get(source, {}) if self.latest is not None else {}
        return all(ages.get(output, math.inf) < HEARD for output in outputs)

    @property
    def is_away(self) -> bool:
        """Whether no mux reports, although it has reported to this monitor, or had the time to find it."""
        had_time = self.latest is not None or time.monotonic() - self._began >= 2 * SILENT
        return self.is_silent and had_time

    # -- Proof ------------------------------------------------------------------------------------------------------------

    def trust(self, uid: str, key: bytes) -> None:
        """Nothing: the mux recognizes instances by their partitions."""

    def trust_unsigned(self, uid: str) -> None:
        """Nothing, as in :meth:`trust`."""

    def recognizes(self, uid: str) -> bool:
        """Return True: the mux reports whom it forwards, and nobody else reaches the robot."""
        return True

    def last(self, uid: str) -> float | None:
        """Return when the mux last reported that it forwards an instance, in Unix seconds."""
        at = self._acknowledged.get(uid)
        return CLOCK.to_system(at) if at is not None else None

    def heard_since(self, time: float) -> Sequence[str]:
        """Return the UID of the instance that was forwarded since a time (Unix seconds)."""
        return [uid for uid, at in self._acknowledged.items() if CLOCK.to_system(at) >= time]

    async def wait(self, uid: str, after: float) -> float:
        """Wait until the mux reports that it forwards an instance as ordered, and return when it did."""
        while True:
            changed = self._changed
            if self._driver() == uid and self.latest is not None and self.latest.at >= after:
                return self.latest.at
            await changed.wait()

    def deciding(self) -> None:
        """Note what this monitor knows of the mux's own switches when it decides."""
        self._decided_with = self.latest.report.token if self.latest is not None else Token()

    def committed(self, epoch: int) -> None:
        """Let an order be sent at once."""
        self._known = (epoch, self._decided_with)
        self.wanted.set()

    def known(self, epoch: int) -> Token:
        """Return the newest token that was known when the commit of an epoch was decided: none if another monitor made it."""
        return self._known[1] if self._known[0] == epoch else Token()

    @property
    def drove_on_board(self) -> bool:
        """Whether the mux forwards the instance on board, or did a moment ago."""
        return CLOCK.now() - self._on_board_at < ON_BOARD_NOTED

    def driven_on_board(self, epoch: int) -> Report | None:
        """Return the latest report if the mux forwards the instance on board by it, in this epoch of the gate; None if it does not."""
        if self.latest is None or self.is_silent:
            return None
        report = self.latest.report
        return report if report.on_board and report.token.epoch == epoch else None

    def carried_out(self, epoch: int) -> int:
        """Return the epoch that the mux has carried out, if it refuses the present one for that; 0 if it does not."""
        found = self.latest
        if found is None or self.is_silent or self._ordered is None or self._nonces.get(found.report.nonce) != epoch:
            return 0
        (_, order), report = self._ordered, found.report
        was_used = report.token.epoch == epoch and report.ordered != order.source
        is_newer = report.token.epoch > epoch and report.token.workload_created == order.workload_created
        return report.token.epoch if report.refused and order.epoch == epoch and (was_used or is_newer) else 0

    def own_switch(self, active: str) -> base.OwnSwitch | None:
        """Return the switch of the mux's own to another instance than the active one; None if there is none.

        The instance on board only stands in, and control returns from it without a commit.
        """
        found = self.latest
        if found is None or self.is_silent or self._ordered is None:
            return None
        report = found.report
        is_answer = report.token.epoch == self._ordered[1].epoch or bool(report.refused)
        if not report.token.count or report.source == active or report.on_board or not is_answer:
            return None
        is_idle = self._idle_since is not None and found.at - self._idle_since >= SILENT
        ages = report.heard.get(active, {}).values()
        return base.OwnSwitch(report.source, is_idle, active_sends=bool(ages) and max(ages) < HEARD)

    def switched_from(self, name: str, uid: str) -> str:
        """Return to which other instance the mux has switched by itself from the one that it was ordered to forward; empty if to none.

        A report counts if it answers the present order.
        """
        if self.latest is None or self._ordered is None or self._ordered[0] != uid:
            return ""
        is_answer = self._nonces.get(self.latest.report.nonce) == self._ordered[1].epoch
        switch = self.own_switch(name) if is_answer else None
        return switch.to if switch is not None else ""

    def is_back(self, active: str) -> bool:
        """Return whether the mux forwards the active instance again, after a switch of its own to another one."""
        found = self.latest
        if found is None or self.is_silent or self._ordered is None:
            return False
        report = found.report
        has_switched = report.token.count > 0 and report.token.epoch == self._ordered[1].epoch
        return has_switched and report.source == active and report.forwarded > 0

    def switched(self, active: str) -> tuple[str, float, float] | None:
        """Return whom the mux forwards by its standing order, when it last heard the active instance, and when it first forwarded the
        other one."""
        found = self.latest
        if found is None or self.own_switch(active) is None or not found.report.forwarded:
            return None
        report = found.report
        ages, first = report.heard.get(active, {}).values(), found.forwarding_since
        last = found.at - min(ages, default=found.at - first)
        return report.source, CLOCK.to_system(last), CLOCK.to_system(first)

    def _has_switched_for_long(self, found: Received) -> bool:
        """Return whether the mux has switched by itself, and the monitor had the time to commit that."""
        token = found.report.token
        is_of_this_epoch = self._ordered is not None and token.epoch == self._ordered[1].epoch
        return token.count > 0 and is_of_this_epoch and CLOCK.now() - found.forwarding_since > SILENT

    def reported(self, active: str) -> base.Report:
        """Return status, reason and message of the condition GateEnforced."""
        if self.is_silent or self.latest is None:
            if not self.is_away:
                return "Unknown", "Settling", "No report of the mux has arrived yet."
            return (
                "False",
                NO_MUX,
                "No mux reports at the robot, so nothing that the instances send reaches it. Run understudy-mux beside the robot's drivers "
                "(docs/mux.md), and check whether it and this monitor are in the same ROS domain: understudy doctor NAME.",
            )
        report = self.latest.report
        if report.on_board:
            return (
                "False",
                "OnBoard",
                f"{report.source} at the robot drives it, because the mux heard {active or 'nobody'} no more. Control returns when the mux "
                "hears the active instance again, or when another one takes over.",
            )
        if report.refused:
            return "False", "OrderRefused", f"The mux at the robot refuses the order of this monitor: {report.refused}."
        if report.source != active and self._has_switched_for_long(self.latest):
            return (
                "Unknown",
                SWITCHED_BY_MUX,
                f"The mux at the robot has switched to {report.source} by itself (spec.gate.reflex), while the gate still names "
                f"{active or 'nobody'}. The monitor commits that to the gate, but not while the workload is paused.",
            )
        rival, at = self._rival
        if CLOCK.now() - at <= SILENT:
            return (
                "False",
                "TwoMuxes",
                f"Two muxes of this workload report: {report.mux} carries out the orders, and {rival} forwards nobody. Stop one of them: "
                "each robot has one mux.",
            )
        if report.source != active:
            return "Unknown", "Settling", "The gate has just changed, and the mux has not reported it yet."
        if report.strangers:
            return (
                "False",
                "BesideTheMux",
                f"These writers reach the robot beside the mux: {'; '.join(report.strangers)}. A process of an instance without the DDS "
                "profile of its pod does that, and so does a tool. Name a node that may do it, such as one for teleoperation, in "
                "spec.gate.mux.allowedNodes.",
            )
        who = f"forwards {active} and nobody else" if active else "forwards nobody"
        return "True", "ReportedByMux", f"The mux at the robot reports that it {who}."

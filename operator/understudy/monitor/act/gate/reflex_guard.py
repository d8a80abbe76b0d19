"""The monitor's part of the reflex: which standby the gate lets through beside the active pod.

A standby that is let through drives the robot as soon as the active pod is silent; no other decision is needed. So the
gate lets it through only while its own outputs are healthy, its writers are weaker than those of the active pod, and
probes have shown that the gate blocked it before.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Coroutine, Sequence
from functools import partial
from typing import Any

from understudy.failover.interfaces import Instance
from understudy.failover.reflex import longest_gap, measured
from understudy.kube.client import FAILURES
from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.judge.gate_enforcement import SETTLE, SILENT
from understudy.monitor.judge.reflex_takeover import ReflexTakeover
from understudy.monitor.notices import ConditionReport, Notices
from understudy.monitor.observe.senses import Senses

WRITE_AGAIN = 1.0
"""Seconds before a failed write is tried again."""

TOO_STRONG_FOR = 5.0
"""Seconds that a standby may be as strong as the active pod before it is replaced by a new, weaker one."""

REPLACE_AGAIN = 60.0
"""Minimum seconds between two such replacements: if the clocks of nodes differ, a replacement may not help."""

PAUSED: ConditionReport = (
    "False",
    "Paused",
    "No standby can take over by the reflex: while the workload is paused (spec.pause), the gate admits only the active pod.",
)


class ReflexGuard:
    """The reflex of one workload; does nothing if the workload has none."""

    def __init__(self, cluster: Cluster, senses: Senses, takeover: ReflexTakeover, notices: Notices) -> None:
        self._fleet, self._gate, self._takeover = cluster.pods, cluster.gate, takeover
        self._agents, self._observer, self._probes = senses.agents, senses.observer, senses.probes
        self._notices = notices
        self._writing: asyncio.Task[None] | None = None
        self._write_after = 0.0
        self._admitted: tuple[str, float] = ("", 0.0)
        self._ready_since: dict[str, float] = {}
        self._too_strong_since: float | None = None
        self._replace_after = 0.0

    def guard(self) -> None:
        """Block the admitted standby once it is not ready: it could take over the robot."""
        state = self._gate.state
        if not state.admitted:
            return
        standby = self._fleet.find(state.admitted_uid)
        if standby is None or not standby.usable or not self._agents.is_ready(standby)[0]:
            self._write(None)

    # -- choose the standby -----------------------------------------------------------------------------------------

    def keep(self, now: float, *, enforced: ConditionReport, paused: bool = False) -> None:
        """Let the best standby through, and report the state of the reflex.

        ``enforced`` is the condition GateEnforced: a standby is let through only if it is True. ``paused``: no standby may take over the
        robot, whatever happens to the active pod.
        """
        state = self._gate.state
        if state.admitted_uid != self._admitted[0]:
            self._admitted = (state.admitted_uid, now)
        if self._takeover.reflex is None:
            if state.admitted:
                self._write(None)
            return
        chosen, report = self._choose(now, enforced) if not paused else (None, PAUSED)
        if (chosen.uid if chosen else "") != state.admitted_uid:
            self._write(chosen)
            if chosen is not None:
                report = ("Unknown", "Arming", f"{chosen.name} is about to be admitted by the gate.")
        if self._notices.condition("Reflex", *report):
            kind = "Warning" if report[0] == "False" and report[1] != "NoStandby" else "Normal"
            if report[1] in ("Armed", "DeadlineTooShort", "StandbyTooStrong", "Blocked", "Ambiguous"):
                self._notices.event(kind, f"Reflex{report[1]}", report[2])

    def _choose(self, now: float, enforced: ConditionReport) -> tuple[Instance | None, ConditionReport]:
        state = self._gate.state
        active = self._fleet.find(state.active_uid)
        if state.closed or active is None:
            return None, ("False", "NoneInControl", "No pod is active.")
        # A claimed pod that is not active was left behind by a recovery, or another monitor prepares it. It will not stay a standby.
        others = [
            i
            for i in self._fleet.of_workload()
            if i.usable and i.has_agent and not i.held and not i.claim and i.uid != active.uid
        ]
        current = next((i for i in others if i.uid == state.admitted_uid), None)
        ready = [i for i in others if self._agents.is_ready(i)[0]]
        # ``min``: the clock may have been set back.
        self._ready_since = {i.uid: min(now, self._ready_since.get(i.uid, now)) for i in ready}
        if not ready:
            why = "; ".join(f"{i.name}: {self._agents.is_ready(i)[1]}" for i in others) or "none exists"
            return None, ("False", "NoStandby", f"No standby is ready to take over: {why}.")
        weaker = ready
        if not self._takeover.is_at_robot:
            strongest = self._strength(active)
            if strongest is None:
                return current, (
                    "Unknown",
                    "StrengthUnknown",
                    f"The agent of {active.name} has not reported the ownership strength of its writers.",
                )
            weaker = [i for i in ready if (found := self._strength(i)) is not None and found[1] < strongest[0]]
            if not weaker:
                return None, self._too_strong(active, ready, now)
            self._too_strong_since = None
        if slow := self._too_slow(active):
            return None, ("False", "DeadlineTooShort", slow)
        if pods := [i.name for i in (active, *weaker) if self._observer.ambiguous(i.name)]:
            return None, (
                "False",
                "Ambiguous",
                f"{', '.join(pods)} cannot be distinguished from other pods (see the condition Monitored).",
            )
        if current in weaker:
            return current, self._armed(active, current, now)
        if not all(measured(self._observer.arrivals(topic, active.name), now) for topic in self._takeover.topics):
            topics = ", ".join(self._takeover.topics)
            return None, ("Unknown", "Measuring", f"Measuring how regularly {active.name} publishes {topics}.")
        best = max(weaker, key=lambda i: self._strength(i) or (0, 0))
        if enforced[0] == "False":
            return None, (
                "False",
                "GateNotProven",
                f"No standby is let through while GateEnforced is False: {enforced[2]}",
            )
        if enforced[0] != "True" or now - self._ready_since[best.uid] < SETTLE:
            why = f"Waiting for evidence that the gate blocks {best.name}."
            return None, ("Unknown", "GateNotProven", why)
        return best, self._armed(active, best, now)

    def _strength(self, instance: Instance) -> tuple[int, int] | None:
        status = self._agents.status(instance)
        return status.strength if status is not None else None

    def _armed(self, active: Instance, standby: Instance, now: float) -> ConditionReport:
        if self._takeover.is_at_robot:
            silent = f"{active.name} is silent for {self._takeover.deadline * 1000:g} ms"
            return "True", "Armed", f"The mux switches to {standby.name} by itself if {silent}."
        since = self._admitted[1]
        if now - since > SILENT and now - max(self._probes.last(standby.uid) or 0.0, since) > SILENT:
            return (
                "False",
                "Blocked",
                f"The gate admits {standby.name}, but packets of that pod do not pass it. {self._probes.block_hint}",
            )
        status = self._agents.status(active)
        unfenced = (
            f" If {active.name} loses its network, its agent cannot freeze it: {status.unfenced}."
            if status and status.unfenced
            else ""
        )
        return (
            "True",
            "Armed",
            f"The robot's readers switch to {standby.name} if {active.name} is silent for {self._takeover.deadline * 1000:g} ms.{unfenced}",
        )

    def _too_slow(self, active: Instance) -> str:
        for topic in self._takeover.topics:
            if gap := longest_gap(self._observer.arrivals(topic, active.name), self._takeover.deadline):
                return (
                    f"{topic} of {active.name} repeatedly has gaps of up to {gap * 1000:.0f} ms; "
                    f"spec.gate.reflex.deadline is {self._takeover.deadline * 1000:g} ms, so {self._takeover.switcher} would switch to a "
                    "standby although nothing failed. Set a deadline of at least twice the period at which the topic is published."
                )
        return ""

    def _too_strong(self, active: Instance, ready: Sequence[Instance], now: float) -> ConditionReport:
        if self._too_strong_since is None or self._too_strong_since > now:
            self._too_strong_since = now
        self._replace_after = min(self._replace_after, now + REPLACE_AGAIN)
        names = ", ".join(i.name for i in ready)
        known = [i for i in ready if self._strength(i) is not None]
        if known and now - self._too_strong_since > TOO_STRONG_FOR and now > self._replace_after:
            self._replace_after = now + REPLACE_AGAIN
            self._notices.event(
                "Normal",
                "StandbyReplaced",
                f"deleting standby {known[0].name}, because its DDS ownership strength is not lower than that of the active pod "
                f"{active.name}",
            )
            self._start(partial(self._retire, known[0]))
        return (
            "False",
            "StandbyTooStrong",
            f"The robot's readers would prefer standby {names} to the active pod {active.name}: the standby started earlier or at the "
            "same time, or the clocks of their nodes differ. The monitor deletes the standby, and a new one replaces it.",
        )

    # -- write the gate ---------------------------------------------------------------------------------------------

    def _write(self, standby: Instance | None) -> None:
        """Write the gate in the background: a slow API server must not delay a detection."""
        if time.monotonic() >= self._write_after:
            self._start(partial(self._admit, standby))

    async def _admit(self, standby: Instance | None) -> None:
        if not await self._gate.admit(standby):
            self._write_after = time.monotonic() + WRITE_AGAIN

    async def _retire(self, instance: Instance) -> None:
        with contextlib.suppress(*FAILURES):
            await self._fleet.retire(instance)

    def _start(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        if self._writing is None or self._writing.done():
            self._writing = asyncio.create_task(work())

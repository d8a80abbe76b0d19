"""Judges whether the gate is enforced: by the cluster's network, from the probes that pass the gate (api.names.PROBE_PORT), at
the robot's readers (robot_readers.py), and on every network interface of the instances (pod_interfaces.py).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Protocol

from understudy.clock import CLOCK
from understudy.failover.interfaces import Gate, Instance
from understudy.kube.gates.base import Proof
from understudy.monitor.notices import ConditionReport, Notices
from understudy.monitor.observe.pod_interfaces import FURTHER
from understudy.monitor.observe.robot.reader_ports import UNGATED

SETTLE = 3.0
"""Seconds after a commit (or the start of an instance) before probes are judged; agents probe once a second."""

SILENT = 5.0
"""Seconds without a probe of the active instance after which its path to the robot counts as blocked."""

KEPT = 5.0
"""Seconds for which the last judgement stands while the gate cannot be tested. A commit needs SETTLE, and is judged once a second."""

LEAK_LASTS = 60.0
"""Seconds for which a packet of a pod that the gate does not admit counts. A node may apply the labels of a new pod late, so that one
packet passes the gate and no other."""

CONDITION = "GateEnforced"


def judge(
    instances: Sequence[Instance],
    active_uid: str,
    last: dict[str, float],
    *,
    now: float,
    since: float,
    admitted_uid: str = "",
    passing: Sequence[str] = (),
    leak_hint: str = "",
    block_hint: str = "",
) -> ConditionReport:
    """Return status, reason and message of the condition GateEnforced.

    ``last`` has the time of the last probe of each pod, by UID; ``since`` is when the gate last changed, in Unix seconds;
    ``admitted_uid`` is the UID of a standby that the gate lets through too; ``passing`` names the pods whose packets pass a gate that no
    longer admits them (sole_driver.py); the hints are those of the gate's proof. Reason Admitted: no other standby is left to test the gate
    with, so the result from before that standby was admitted still counts.
    """
    # A pod that is being deleted still sends, but its silence does not show that the gate blocks it.
    running = [i for i in instances if i.has_agent and i.running and not i.held]
    probing = [i for i in running if not i.terminating]
    is_settling = now - since < SETTLE
    if is_settling and not passing:
        return "Unknown", "Settling", "The gate has just changed, and its effect has not been tested yet."
    leaking = {*passing} | {
        i.name
        for i in running
        # A probe after ``now`` was received before the clock was set back.
        if i.uid not in (active_uid, admitted_uid)
        and max(since + SETTLE, now - LEAK_LASTS) < last.get(i.uid, 0.0) <= now
    }
    if leaking:
        return (
            "False",
            "NotEnforced",
            f"The gate does not admit {', '.join(sorted(leaking))}, but packets of that pod pass it. Two instances could command the robot "
            "at the same time. "
            f"{leak_hint}".rstrip(),
        )
    if not active_uid:
        return "Unknown", "Closed", "The gate admits nobody. No packet has passed it since it was closed."
    active = next((i for i in probing if i.uid == active_uid), None)
    if active is None:
        return "Unknown", "NoProbe", "The active pod has no agent, so the gate cannot be tested."
    if now - max(last.get(active.uid, 0.0), since) > SILENT:
        return (
            "False",
            "Blocked",
            f"The gate admits {active.name}, but packets of that pod do not pass it. {block_hint}".rstrip(),
        )
    if admitted_uid and all(i.uid in (active_uid, admitted_uid) for i in probing):
        return (
            "Unknown",
            "Admitted",
            "The gate also admits the only standby (spec.gate.reflex), so no pod is left that it should block.",
        )
    if len(probing) == 1:
        return (
            "Unknown",
            "NoStandby",
            "Packets of the active pod pass the gate. Without a standby, it is unknown whether the gate blocks others.",
        )
    return (
        "True",
        "SeenFromPackets",
        "Packets of the active pod pass the gate, and those of every standby do not.",
    )


class Readers(Protocol):
    """The robot's readers, as far as a gate depends on them."""

    @property
    def ungated(self) -> str:
        """The readers of the robot that the gate does not control, as a sentence; empty if there are none."""


class Interfaces(Protocol):
    """The network interfaces of the instances, as far as a gate depends on them."""

    def further(self) -> str:
        """Return the interfaces that the gate does not control, as sentences; empty if there are none."""


class GateEnforcement:
    """Judges and reports whether the gate of one workload is enforced. Times are Unix seconds."""

    def __init__(self, gate: Gate, probes: Proof, notices: Notices, readers: Readers, interfaces: Interfaces) -> None:
        self._gate, self._probes, self._notices = gate, probes, notices
        self._readers, self._interfaces = readers, interfaces
        self._changed = CLOCK.now()
        """When the gate last let other pods through than before, by the process's clock."""
        self._let_through = ("", "")
        self._settling_since: float | None = None
        """Since when the gate cannot be tested, by the process's clock."""

    def update(self, now: float) -> None:
        """Note whether the gate now lets other pods through than before."""
        state = self._gate.state
        if (state.active_uid, state.admitted_uid) != self._let_through:
            self._let_through = (state.active_uid, state.admitted_uid)
            self._changed = CLOCK.of_system(now)

    @property
    def robot_is_away(self) -> bool:
        """Whether the robot cannot be reached, as far as somebody at the gate shows it."""
        return self._probes.is_away

    def judge(self, instances: Sequence[Instance], passing: Sequence[str] = ()) -> ConditionReport:
        """Judge the gate by the probes of these instances, by the robot's readers, and by the interfaces of all instances.

        ``passing`` is that of :meth:`SoleDriver.passing`.
        """
        self.update(time.time())
        state = self._gate.state
        if (reported := self._probes.reported(state.active)) is not None:
            return reported
        last = {i.uid: found for i in instances if (found := self._probes.last(i.uid)) is not None}
        judged = judge(
            instances,
            state.active_uid,
            last,
            now=time.time(),
            since=CLOCK.to_system(self._changed),
            admitted_uid=state.admitted_uid,
            passing=passing,
            leak_hint=self._probes.leak_hint,
            block_hint=self._probes.block_hint,
        )
        further = self._interfaces.further()
        if judged[0] == "False" or judged[1] == "Settling":
            return judged
        if ungated := self._readers.ungated:
            return "False", UNGATED, ungated
        return ("False", FURTHER, further) if further else judged

    def report(self, judged: ConditionReport) -> None:
        """Report the judgement, unless the gate cannot be tested for a moment."""
        now = CLOCK.now()
        self._settling_since = None if judged[1] != "Settling" else self._settling_since or now
        is_kept = judged[1] == "Admitted" or (self._settling_since is not None and now - self._settling_since < KEPT)
        if not is_kept and self._notices.condition(CONDITION, *judged) and judged[0] == "False":
            self._notices.event("Warning", f"Gate{judged[1]}", judged[2])
            self._notices.request_write()  # also during a recovery: somebody may have to stop the robot

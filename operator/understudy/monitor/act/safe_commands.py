"""Sends the policy's safe commands to the robot while no instance is verified to be in control (docs/safety.md).

With a mux, they are in its standing order, and it sends them. Otherwise the monitor does: it is not an instance, so the gate lets it
through. Its commands begin after the failed instance was fenced, or the gate was closed for a leak, and end with the first output of the
next one. After the gate opens for an instance, the commands wait for ``safety.after`` again, so that the monitor and the instance do not
command the robot at the same time.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from typing import Protocol

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import Safety
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.protocol.mux_messages import SafeCommand
from understudy.clock import CLOCK
from understudy.failover import pinned
from understudy.failover.progress import Progress, beside
from understudy.kube.gates.base import GateRecord
from understudy.monitor.decide.pause_state import PauseState
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.outcome import Outcome
from understudy.ros.actions.repeated_publisher import Commander
from understudy.ros.runtime.graph_node import Graph
from understudy.ros.runtime.interface_types import TypeNotInstalled, message_class
from understudy.ros.runtime.message_values import MessageError, to_message

_logger = logging.getLogger(__name__)

CLOSED, OPENED, DRIVEN = "fenced", "committed", ("first_output", "verified")
"""The moments of a recovery that begin a time in which no instance drives, and those that end it. Those of the gate are of
acknowledged commits."""

HEARD_FOR = 0.25
"""Minimum seconds after a sample of anybody else for which no safe command is sent, whatever the moments say.

The gate may have opened before the API server's answer arrives, an instance may get through that should not, or another monitor may have
replaced this one and put an instance in control that this one does not know.
"""

HEARD_FOR_MOST = 2.0
"""The maximum of these seconds.

They are twice the usual time between two samples of somebody who sends less often, because the network may still let it through after the
fence. The maximum counts if that time is not known.
"""


class Unattended:
    """Records since when no instance has driven the robot, according to recoveries, their outcomes and the gate."""

    def __init__(self, view: ClusterView, pauses: PauseState, current: CurrentRecovery) -> None:
        self._view, self._pauses, self._current = view, pauses, current
        self._since: float | None = None
        self._epoch = -1
        """The gate's epoch, as last seen."""

    @property
    def since(self) -> float | None:
        """Since when (by the process's clock) no instance has driven the robot. None while one drives, if the workload is
        retired, and during a pause, unless a recovery continues in it."""
        progress, held = self._current.progress, self._current.held
        if self._view.retired or (self._pauses.on is not None and (held or progress is None)):
            return None
        record = self._view.gate_record
        is_new = record is not None and record.epoch != self._epoch
        self._epoch = record.epoch if record is not None else self._epoch
        if progress is not None:
            return self._recovering(progress)
        if record is not None and record.active:
            if is_new and self._since is not None:
                self._since = CLOCK.now()  # whom it was opened for has its time
        elif record is not None and self._since is None and _was_closed(record):
            self._since = CLOCK.now()
        return self._since

    def _recovering(self, progress: Progress) -> float | None:
        moments = progress.moments
        if any(moment in moments for moment in DRIVEN) or progress.taken_over is not None:
            self._since = None
            return None
        changes = [moments[moment] for moment in (CLOSED, OPENED) if moment in moments]
        if changes:
            self._since = max(changes)
        elif self._since is None and self._has_committed(progress):  # in an earlier attempt, by an earlier monitor
            self._since = moments.get("detected")
        return self._since

    def _has_committed(self, progress: Progress) -> bool:
        record = self._view.gate_record
        found = beside(record.recovery) if record is not None else None
        return found is not None and found.id == progress.id

    def conclude(self, outcome: Outcome) -> None:
        """Note the outcome of a recovery or a switchover."""
        if outcome.driven:
            self._since = None
        else:
            self._recovering(outcome.progress)

    def driven(self) -> None:
        """Note that an instance is active and healthy."""
        self._since = None


def _was_closed(record: GateRecord) -> bool:
    """Whether the gate let somebody through before, and no recovery is under way, whose monitor sends the safe commands itself."""
    found = beside(record.recovery)
    return bool(pinned.read(record.let_through)) and (found is None or found.result != "Running")


class Outputs(Protocol):
    """What the robot receives on the outputs."""

    def heard(self) -> Sequence[tuple[float, float]]:
        """Return when a sample last arrived from each sender but this pod, by the process's clock, and its :attr:`interval
        <understudy.monitor.observe.robot.known_senders.OutputSender.interval>`."""


class SafeCommands:
    """The publishers of a policy's safe commands."""

    def __init__(self, graph: Graph, unattended: Unattended, outputs: Outputs) -> None:
        self._graph, self._unattended, self._outputs = graph, unattended, outputs
        self._followed: tuple[Safety | None, list[tuple[str, str]], bool] = (None, [], False)
        self._commanders: list[Commander] = []
        self._tasks: list[asyncio.Task[None]] = []
        self.after = 0.0
        """Seconds for which nobody has controlled the robot before commands are sent."""
        self.of_mux: tuple[SafeCommand, ...] = ()
        """Those that the mux at the robot sends. With a mux, this process sends none."""
        self.problems: list[str] = []
        """Why commands cannot be sent, and how to correct that: one text per command."""
        self.sent = 0
        """Number of messages published."""

    def follow(self, safety: Safety | None, spec: RobotWorkloadSpec) -> None:
        """Prepare to publish the safe commands of this policy, or to have the mux do so. Without ``safety``, nothing is published."""
        outputs = [(output.topic, output.type) for output in spec.outputs if output.topic]
        wanted = (safety, outputs, spec.gate.readers_choose)
        if wanted == self._followed:
            return
        self._followed = wanted
        self.close()
        self.problems, self.of_mux = [], ()
        if safety is None:
            return
        self.after = seconds(safety.after)
        for index, command in enumerate(safety.commands):
            try:
                type_name = _type(command.topic, outputs, reflex=spec.gate.readers_choose)
                if spec.gate.is_at_robot:
                    to_message(message_class(type_name), command.message)
                    sent = SafeCommand(command.topic, command.message, seconds(command.every))
                    self.of_mux = (*self.of_mux, sent)
                    continue
                commander = Commander(self._graph, command.topic, type_name, command.message)
            # rclpy raises RuntimeError if this process already uses the topic with another type, such as in the tree.
            except (TypeNotInstalled, MessageError, _Unusable, RuntimeError) as error:
                _logger.error("the safe command on %s cannot be published: %s", command.topic, error)
                self.problems.append(f"FailurePolicy: spec.safety.commands[{index}]: {error}.")
                continue
            self._commanders.append(commander)
            self._tasks.append(asyncio.create_task(self._repeat(commander, seconds(command.every))))

    async def _repeat(self, commander: Commander, period: float) -> None:
        """Publish at the policy's period while no instance drives."""
        loop = asyncio.get_running_loop()
        known: float | None = None
        begins, failing = 0.0, False
        while True:
            since = self._unattended.since
            if since is not None and since != known:
                # ``since`` can lie in the future if it comes from another node's clock.
                begins = loop.time() + min(since + self.after - CLOCK.now(), self.after)
            known, wait = since, period
            if since is not None:
                started_at = loop.time()
                wait = begins - started_at
                if wait <= 0:
                    if not self._is_driven():
                        failing = self._publish(commander, failing)
                    wait = max(0.0, started_at + period - loop.time())
            await asyncio.sleep(min(wait, period) if wait > 0 else 0)

    def _is_driven(self) -> bool:
        """Whether somebody else was heard so recently that it may go on."""
        now = CLOCK.now()
        return any(
            now - last < max(HEARD_FOR, min(HEARD_FOR_MOST, 2 * interval)) for last, interval in self._outputs.heard()
        )

    def _publish(self, commander: Commander, failing: bool) -> bool:
        """Publish once. Returns whether that failed. An error is not raised, because nobody else commands the robot and
        the next message may get through."""
        try:
            commander.publish()
        except Exception:  # whatever rclpy raises
            if not failing:
                _logger.exception("could not publish a safe command; it is published again after its period")
            return True
        self.sent += 1
        return False

    def close(self) -> None:
        """Stop publishing, and close all publishers."""
        for task in self._tasks:
            task.cancel()
        for commander in self._commanders:
            commander.close()
        self._tasks, self._commanders = [], []


class _Unusable(Exception):
    """A command that the robot would not receive."""


def _type(topic: str, outputs: Sequence[tuple[str, str]], *, reflex: bool) -> str:
    """Return the type of the output on a command's topic. Raises _Unusable."""
    known = dict(outputs)
    if topic not in known:
        there = ", ".join(known) or "none"
        raise _Unusable(f"{topic} is not a topic of the workload's outputs ({there})")
    if reflex:
        raise _Unusable(
            f"spec.gate.reflex of the workload makes the robot read {topic} with exclusive ownership, so it would not receive the safe "
            "command; remove spec.gate.reflex, or this command"
        )
    return known[topic]

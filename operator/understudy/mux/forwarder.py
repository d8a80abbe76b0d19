"""Forwards one workload: takes what arrived, forwards what the control says, and carries out orders and standing orders.

Everything happens in one thread and in this order: samples that arrived before a decision are judged by the control before it. So a sample
that an instance sent before it was put in control is never forwarded, and silence is judged only after everything was heard.
"""

from __future__ import annotations

import logging
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, Protocol

from understudy.api.protocol.agent_messages import ProtocolError
from understudy.api.protocol.mux_messages import MuxKeys, Report, SafeCommand, Token, read_order, report_text
from understudy.mux.control import Control, Heard, Refused, aside, due_at, ordered, switched, undriven_at

_logger = logging.getLogger(__name__)

REMEMBERED = 60.0
"""Seconds for which an instance that is silent stays in the reports."""

DISCOVERY = 2.0
"""Seconds after the start of the process in which it may have discovered the writers of a successor, and not yet those of the present
instance."""


class Route(Protocol):
    """One topic or service (ros/actions/forwarded_outputs.py)."""

    @property
    def output(self) -> str:
        """The name of the output that it belongs to."""

    def drain(self, forwards: Callable[[bytes], bool | None]) -> int:
        """Take what has arrived, and forward what a function accepts by the GID of its writer. Returns the number of commands."""

    def forget(self) -> None:
        """Drop what is held: another instance is in control from now on."""

    def command(self, values: Mapping[str, Any]) -> None:
        """Send a safe command, given by the values of its fields. Raises MessageError."""


class Journal(Protocol):
    """Keeps the control. :class:`understudy.mux.control_journal.ControlJournal` implements it."""

    def load(self) -> Control:
        """Return the control that was kept."""

    def save(self, control: Control) -> None:
        """Keep a control. Raises OSError."""


class Forwarder:
    """The mux of one workload. Times are of a monotonic clock."""

    def __init__(
        self,
        routes: Iterable[Route],
        keys: MuxKeys,
        journal: Journal,
        identity: str = "",
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``identity`` is what orders call this mux."""
        self._routes, self._keys, self._journal, self._clock = tuple(routes), keys, journal, clock
        self._identity = identity
        self.control = journal.load()
        self.instances: Mapping[bytes, str] = {}
        """The instance of each writer that discovery has reported; empty for a writer of no instance."""
        self.strangers: tuple[str, ...] = ()
        """As in the reports."""
        self._last: dict[str, dict[str, float]] = defaultdict(dict)
        self._begun_at = self._since = clock()
        self._first = math.nan
        self._forwarded = 0
        self._begun: set[str] = set()
        """The outputs of the present instance that were forwarded."""
        self._looked = clock()
        """When :meth:`drain` was called last."""
        self._look_at = -math.inf
        """Before this time, no standing order can be due."""
        self._commanded: dict[str, float] = {}
        """When the last safe command was sent, by topic."""
        self._safe_sent = 0
        self._unsendable: set[str] = set()
        """Topics on which a safe command could not be sent."""
        self._nonce = self._refused = ""
        self._not_kept = Token()
        """The token of the newest order that could not be kept: it ends all older ones nevertheless."""
        self.changed = True
        """Whether a report is due because something changed."""

    def drain(self) -> None:
        """Take what arrived, and carry out a standing order that is due. Call it when something arrives, and at :attr:`due_at`."""
        now = self._looked = self._clock()
        for route in self._routes:
            if forwarded := route.drain(self._judging(route.output, now)):
                self._forwarded += forwarded
                if route.output not in self._begun:
                    self._begun.add(route.output)
                    self.changed = True
        if self._forwarded and math.isnan(self._first):
            self._first = now
        if now >= self._look_at:  # each sample makes it later
            self._switch(now)
            self._command(now)
            self._look_at = min(self._dues)

    def _switch(self, now: float) -> None:
        if (found := switched(self.control, self._heard, now)) is None:
            return
        former = self.control.source or "nobody"
        try:
            self._decide(found, now)
        except OSError as error:
            _logger.error(
                "%s is silent, and %s is not forwarded, because that cannot be kept: %s", former, found.source, error
            )
            return
        _logger.warning("%s is silent: %s is forwarded from now on, without an order", former, found.source)

    def _command(self, now: float) -> None:
        """Send the safe commands that are due."""
        if now < undriven_at(self.control, self._heard):
            return
        for safe in self.control.standing.safe:
            if now < self._commanded.get(safe.topic, -math.inf) + safe.every:
                continue
            self._commanded[safe.topic] = now
            for route in self._routes:
                if route.output == safe.topic:
                    self._send_safe(route, safe)

    def _send_safe(self, route: Route, safe: SafeCommand) -> None:
        """Send one. An error is not raised, because nobody else commands the robot and the next message may get through."""
        try:
            route.command(safe.message)
        except Exception:  # whatever rclpy raises
            if safe.topic not in self._unsendable:
                _logger.exception("could not send a safe command on %s; it is sent again after its period", safe.topic)
            self._unsendable.add(safe.topic)
        else:
            self._unsendable.discard(safe.topic)
            self._safe_sent += 1

    @property
    def due_at(self) -> float:
        """When :meth:`drain` must be called at the latest, although nothing arrives."""
        if self._look_at > self._looked:
            return self._look_at
        switches, *commands = self._dues
        # It was judged: nobody else was heard, and only an arrival changes that.
        return min([switches if switches > self._looked else math.inf, *commands])

    @property
    def _dues(self) -> list[float]:
        """When the present instance has been silent for too long, and when each safe command is due, if nobody is heard until then."""
        begins = undriven_at(self.control, self._heard)
        commands = (
            max(begins, self._commanded.get(safe.topic, -math.inf) + safe.every) for safe in self.control.standing.safe
        )
        return [due_at(self.control, self._heard), *commands]

    def order(self, text: str) -> None:
        """Carry out an order, unless it is refused. A text that is no authentic order is ignored.

        If the order cannot be kept, nobody is forwarded instead of the instance that it fences, and nobody switches any more by what it
        replaces.
        """
        try:
            found, nonce = read_order(text, self._keys)
        except ProtocolError as error:
            _logger.warning("an order is ignored: %s", error)
            return
        self.drain()
        self._nonce, self._refused, self.changed = nonce, "", True
        if self._identity and not found.mux:
            return  # the monitor learns by the report that this mux is there
        try:
            if found.token < self._not_kept:
                raise Refused(f"the order is older than one of epoch {self._not_kept.epoch}, which the mux cannot keep")
            control = ordered(self.control, found) if found.mux == self._identity else aside(self.control, found)
        except Refused as error:
            self._refused = str(error)
            _logger.info("an order is refused: %s", error)
            return
        if control is not self.control:
            try:
                self._decide(control, self._clock())
            except OSError as error:
                self._refused = f"the mux cannot keep it: {error}"
                _logger.error("an order is refused: %s", self._refused)
                self._not_kept = found.token
                # It fences nevertheless: nobody needs to be remembered for that. And after ``understudy fence`` nobody may stand in.
                source = self.control.source if control.source == self.control.source else ""
                self._apply(replace(self.control, source=source, standing=control.standing), self._clock())

    def report(self) -> str:
        """Return the text of the present report."""
        now, self.changed = self._clock(), False
        heard = {
            name: {topic: now - at for topic, at in last.items() if now - at < REMEMBERED}
            for name, last in self._last.items()
        }
        since = math.inf if math.isnan(self._first) else now - self._first
        control = self.control
        return report_text(
            Report(
                control.token,
                control.source,
                self._nonce,
                self._refused,
                self._forwarded,
                since,
                {name: outputs for name, outputs in heard.items() if outputs},
                self.strangers,
                control.standing.digest,
                control.revision,
                control.on_board,
                self._safe_sent,
                self._identity,
                control.ordered,
            ),
            self._keys,
        )

    @property
    def _heard(self) -> Heard:
        return Heard(self._since, self._last, self._begun_at + DISCOVERY)

    def _decide(self, control: Control, now: float) -> None:
        """Keep a control before it has any effect. Raises OSError."""
        self._journal.save(control)
        self._apply(control, now)

    def _apply(self, control: Control, now: float) -> None:
        if control.source != self.control.source:
            self._since, self._first, self._forwarded, self._begun = now, math.nan, 0, set()
            for route in self._routes:
                route.forget()
        self.control, self.changed, self._look_at = control, True, -math.inf

    def _judging(self, output: str, now: float) -> Callable[[bytes], bool | None]:
        """Return a function that notes a sample of an output by its writer, and returns whether it is forwarded.

        It returns None for a writer that discovery has not reported yet.
        """
        instances: Mapping[bytes, str] = self.instances
        source, last = self.control.source, self._last

        def forwards(writer: bytes) -> bool | None:
            name = instances.get(writer)
            if not name:
                return None if name is None else False
            if output not in last[name]:
                self.changed = True  # a switch may wait until this instance is heard
            last[name][output] = now
            return name == source

        return forwards

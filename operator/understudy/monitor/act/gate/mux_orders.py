"""Passes on what the gate object says to the mux at the robot, and receives its reports.

The gate object is the commit point. An order only repeats it, so a monitor that was cut off orders what it last knew, and the mux refuses
that if another monitor has committed since.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
import math
import secrets
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Protocol

from understudy.api import moments, names
from understudy.api.base import seconds
from understudy.api.protocol.agent_messages import ProtocolError
from understudy.api.protocol.mux_messages import (
    MuxKeys,
    OnBoard,
    Order,
    StandingOrder,
    Token,
    derive,
    order_text,
    read_report,
)
from understudy.failover import pinned
from understudy.failover.interfaces import Agents, Instances
from understudy.kube.client import FAILURES, SECRETS, Client
from understudy.kube.gates.base import GateRecord
from understudy.kube.gates.mux_reports import MuxReports
from understudy.kube.repeated_requests import answered
from understudy.monitor.act.safe_commands import SafeCommands
from understudy.monitor.observe.objects.cluster_view import ClusterView

_logger = logging.getLogger(__name__)

PERIOD = 1.0
"""Seconds between two orders if nothing changes: each report answers a recent one, and a mux that was away learns the newest."""

AGAIN = 0.1
"""Seconds until an order is sent again that the mux has not answered, and between two looks at the gate object."""

SECRET_AGAIN = 1.0
"""Seconds between two requests for the token, which the operator may not have written yet."""


class Exchange(Protocol):
    """Carries texts to the mux and back (ros/actions/text_exchange.py)."""

    def publish(self, text: str) -> None:
        """Send a text to the mux."""

    def receiving(self, receive: Callable[[str], None]) -> AbstractContextManager[None]:
        """Call a function with each text of the mux as it arrives, until the context ends."""


class MuxOrders:
    """The orders to the mux of one workload."""

    def __init__(
        self,
        client: Client,
        view: ClusterView,
        exchange: Exchange,
        reports: MuxReports,
        ready: Callable[[], Sequence[str]],
        never_silent: Callable[[], Sequence[str]],
        safety: SafeCommands,
    ) -> None:
        """``ready`` returns the names of the instances that could drive now, the best one first.

        ``never_silent`` returns the topics that the instance in control must publish now: a robot without a goal may stand still.
        """
        self._client, self._view, self._exchange, self._reports, self._ready = client, view, exchange, reports, ready
        self._never_silent, self._safety = never_silent, safety
        self._answered = ""
        """The nonce of the last order that the mux has answered."""
        self._sent: tuple[int, str, float, Token] = (-1, "", 0.0, Token())
        """The revision of the gate object, the nonce and the time of the last order, and what it took into account."""

    async def run(self) -> None:
        """Send orders and receive reports until cancelled."""
        keys, loop = derive(await self._token(), self._view.namespace, self._view.workload), asyncio.get_running_loop()
        with self._exchange.receiving(lambda text: self._receive(text, keys)):
            while True:
                self._reports.wanted.clear()
                self._send(keys, loop.time())
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(AGAIN):
                        await self._reports.wanted.wait()

    async def _token(self) -> bytes:
        name = names.mux(self._view.workload)
        while True:
            try:
                secret = await answered(lambda: self._client.get(SECRETS, self._view.namespace, name))
                return base64.b64decode(secret["data"][names.TOKEN])
            except (*FAILURES, KeyError) as error:
                _logger.warning("the token of the mux cannot be read from Secret %s, trying again: %r", name, error)
            await asyncio.sleep(SECRET_AGAIN)

    def _receive(self, text: str, keys: MuxKeys) -> None:
        try:
            report = read_report(text, keys)
        except ProtocolError as error:
            _logger.warning("a report of a mux is ignored: %s", error)
            return
        self._answered = report.nonce
        self._reports.add(report)

    def _standing(self, record: GateRecord) -> StandingOrder:
        """Return what the mux does without another order.

        Once a topic that the active instance must publish was silent for the deadline of the reflex, it switches to the admitted standby.
        If there is one, other ready standbys follow, since the API server may be away for longer. The instance on board and safe commands
        come last, and neither while a user has fenced the robot or paused the workload, or before an instance has driven.
        """
        spec = self._view.spec
        if spec is None:
            return StandingOrder()
        topics = self._never_silent()
        found = StandingOrder()
        if spec.gate.reflex is not None and record.admitted:
            others = (name for name in self._ready() if name not in (record.active, record.admitted))
            silences = dict.fromkeys(topics, seconds(spec.gate.reflex.deadline))
            found = StandingOrder((record.admitted, *others), silences)
        is_driven = bool(record.active or pinned.read(record.let_through))
        if not is_driven or record.fenced or spec.pause is not None or self._view.retired:
            return found
        if (on_board := spec.gate.on_board) is not None:
            found = replace(found, on_board=OnBoard(on_board.name, dict.fromkeys(topics, seconds(on_board.after))))
        return replace(found, safe=self._safety.of_mux, safe_after=self._safety.after)

    def _knows(self, record: GateRecord) -> Token:
        """Return the newest switch of the mux's own that the order takes into account.

        The one to the instance on board is, as soon as the mux hears the active instance again and its agent reports it as ready.
        """
        report, spec = self._reports.driven_on_board(record.epoch), self._view.spec
        if report is not None and spec is not None and spec.gate.on_board is not None:
            ages, most = report.heard.get(record.active, {}), seconds(spec.gate.on_board.after)
            if record.active in self._ready() and all(
                ages.get(topic, math.inf) < most for topic in self._never_silent()
            ):
                return report.token
        return self._reports.known(record.epoch)

    def _follows(self, order: Order) -> bool:
        """Whether the mux follows the standing order of an order, as far as it has reported that."""
        latest = self._reports.latest
        if latest is None or latest.report.token.epoch != order.epoch:
            return True  # it takes the one of the first order of an epoch, whatever its revision
        return latest.report.standing == order.standing.digest

    def _send(self, keys: MuxKeys, now: float) -> None:
        """Send an order if the gate object has changed, if the last one was not answered, or if it was a while ago."""
        record, changes = self._view.gate_record, self._view.gates.revision
        created = moments.unix(((self._view.object or {}).get("metadata") or {}).get("creationTimestamp"))
        if record is None or created is None:
            return
        of, nonce, at, knew = self._sent
        knows, latest = self._knows(record), self._reports.latest
        revision = latest.report.revision + 1 if latest is not None else 0
        order = Order(created, record.epoch, record.active, knows, self._standing(record), revision, self._reports.mux)
        is_done = nonce == self._answered and self._follows(order)
        if of == changes and knows == knew and now - at < (PERIOD if is_done else AGAIN):
            return
        nonce = secrets.token_hex(8)
        self._reports.ordered(record.active_uid, order, nonce)
        self._exchange.publish(order_text(order, nonce, keys))
        self._sent = (changes, nonce, now, knows)


def ready_names(pods: Instances, agents: Agents, active_uid: str) -> list[str]:
    """Return the names of the instances that could drive now. Those that are ready by Kubernetes come first, then the oldest.

    A claimed one that is not active was left behind by a recovery, or another monitor prepares it.
    """
    running = [one for one in pods.of_workload() if one.usable and one.has_agent and not one.held]
    ready = [one for one in running if (not one.claim or one.uid == active_uid) and agents.is_ready(one)[0]]
    return [one.name for one in sorted(ready, key=lambda one: (not one.ready, one.created, one.name))]

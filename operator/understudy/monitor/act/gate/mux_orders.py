"""Passes on what the gate object says to the mux at the robot, and receives its reports.

The gate object is the commit point. An order only repeats it, so a monitor that was cut off orders what it last knew, and the mux refuses
that if another monitor has committed since.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
import secrets

from understudy.api import moments, names
from understudy.api.base import seconds
from understudy.api.protocol.mux_messages import (
    MuxKeys,
    Order,
    StandingOrder,
    Token,
    derive,
    order_text,
    read_report,
    topics,
)
from understudy.api.protocol.session_keys import NotAuthentic
from understudy.kube.client import FAILURES, SECRETS, Client
from understudy.kube.gates.base import GateRecord
from understudy.kube.gates.mux_reports import MuxReports
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.ros.actions.text_exchange import TextExchange
from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
from understudy.ros.runtime.graph_node import Graph

_logger = logging.getLogger(__name__)

PERIOD = 1.0
"""Seconds between two orders if nothing changes: each report answers a recent one, and a mux that was away learns the newest."""

AGAIN = 0.1
"""Seconds until an order is sent again that the mux has not answered, and between two looks at the gate object."""

SECRET_AGAIN = 1.0
"""Seconds between two requests for the token, which the operator may not have written yet."""


class MuxOrders:
    """The orders to the mux of one workload."""

    def __init__(self, client: Client, view: ClusterView, graph: Graph, reports: MuxReports) -> None:
        self._client, self._view, self._graph, self._reports = client, view, graph, reports
        self._answered = ""
        """The nonce of the last order that the mux has answered."""
        self._sent: tuple[int, str, float] = (-1, "", 0.0)
        """The revision of the gate object, the nonce and the time of the last order."""

    async def run(self) -> None:
        """Send orders and receive reports until cancelled."""
        keys = derive(await self._token(), self._view.namespace, self._view.workload)
        wakeups, loop = ArrivalWakeups(), asyncio.get_running_loop()
        orders, reports = topics(self._view.namespace, self._view.workload)
        exchange = TextExchange(self._graph, wakeups, reads=reports, writes=orders)

        def arrived() -> None:
            wakeups.clear()
            for text in exchange.received():
                self._receive(text, keys)

        loop.add_reader(wakeups.descriptor, arrived)
        try:
            while True:
                self._reports.wanted.clear()
                self._send(exchange, keys, loop.time())
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(AGAIN):
                        await self._reports.wanted.wait()
        finally:
            loop.remove_reader(wakeups.descriptor)

    async def _token(self) -> bytes:
        name = names.mux(self._view.workload)
        while True:
            try:
                secret = await self._client.get(SECRETS, self._view.namespace, name)
                return base64.b64decode(secret["data"][names.TOKEN])
            except (*FAILURES, KeyError) as error:
                _logger.warning("the token of the mux cannot be read from Secret %s, trying again: %r", name, error)
            await asyncio.sleep(SECRET_AGAIN)

    def _receive(self, text: str, keys: MuxKeys) -> None:
        try:
            report = read_report(text, keys)
        except NotAuthentic as error:
            _logger.warning("a report of a mux is ignored: %s", error)
            return
        self._answered = report.nonce
        self._reports.add(report)

    def _standing(self, record: GateRecord) -> StandingOrder:
        """Return to whom the mux switches by itself: to the admitted standby, once a topic of the active instance was silent for the
        deadline of the reflex."""
        spec = self._view.spec
        if spec is None or spec.gate.reflex is None or not record.admitted:
            return StandingOrder()
        deadline = seconds(spec.gate.reflex.deadline)
        return StandingOrder((record.admitted,), {o.topic: deadline for o in spec.outputs if o.topic})

    def _send(self, exchange: TextExchange, keys: MuxKeys, now: float) -> None:
        """Send an order if the gate object has changed, if the last one was not answered, or if it was a while ago."""
        record, revision = self._view.gate_record, self._view.gates.revision
        created = moments.unix(((self._view.object or {}).get("metadata") or {}).get("creationTimestamp"))
        if record is None or created is None:
            return
        of, nonce, at = self._sent
        if of == revision and now - at < (PERIOD if nonce == self._answered else AGAIN):
            return
        latest = self._reports.latest
        knows = latest.report.token if latest is not None else Token()
        standing, changes = self._standing(record), int(record.version) if record.version.isdigit() else 0
        order = Order(created, record.epoch, record.active, knows, standing, changes)
        nonce = secrets.token_hex(8)
        self._reports.ordered(record.active_uid, order, nonce)
        exchange.publish(order_text(order, nonce, keys))
        self._sent = (revision, nonce, now)

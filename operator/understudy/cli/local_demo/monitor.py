"""The monitor of ``understudy try``: judges the active instance by a health tree, and orders the mux to forward its standby.

The watched topics, the tree, its deadlines and the orders are those of a monitor in a cluster. What is missing is the API server: there,
a monitor writes the gate object first, and its order only repeats it. Run as
``python -m understudy.cli.local_demo.monitor JOURNAL TOKEN_FILE GAP INSTANCE...``, with the gap in seconds.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from understudy.api import names
from understudy.api.kinds.failure_policy import Monitoring
from understudy.api.protocol.agent_messages import ProtocolError
from understudy.api.protocol.mux_messages import Order, derive, order_text, read_report, topics
from understudy.cli.local_demo.journals import JournalWriter
from understudy.cli.local_demo.robot import COMMANDS, NAMESPACE, TYPE, WORKLOAD
from understudy.monitor.observe.wakeups import TICK, WAKE_LATE, EvaluationSchedule, Wakeups
from understudy.process import cpu_scheduling
from understudy.trees.languages.notations import load_monitoring

if TYPE_CHECKING:
    from understudy.ros.actions.text_exchange import TextExchange
    from understudy.ros.observe.topic_watch import TopicWatch

AGAIN = 0.1
"""Seconds until an order is sent again that the mux has not answered."""

STATE_PERIOD = 0.2
"""Seconds between two states in the journal."""

RATED = 1.0
"""Seconds over which the commands of an instance are counted."""


def monitoring(gap: float) -> Monitoring:
    """Return the health tree as in a FailurePolicy: commands are at most ``gap`` seconds apart."""
    return Monitoring.model_validate(
        {"yaml": {"topic": {"name": COMMANDS, "type": TYPE, "gap": f"{gap * 1000:.0f}ms"}}}
    )


class LocalMonitor:
    """Watches the instances and puts one in control."""

    def __init__(
        self,
        watching: TopicWatch,
        exchange: TextExchange,
        journal: JournalWriter,
        token: bytes,
        gap: float,
        instances: Sequence[str],
    ) -> None:
        self._watching, self._exchange, self._journal, self._gap = watching, exchange, journal, gap
        self._instances, self._keys = instances, derive(token, NAMESPACE, WORKLOAD)
        self._tree = load_monitoring(monitoring(gap))
        watching.follow(self._tree.topics)
        self._created = time.time()
        self._epoch, self._active, self._since = 0, "", time.time()
        self._mux = self._nonce = ""
        self._answered = asyncio.Event()
        self._health, self._reason = "Starting", ""
        self._put_in_control("")

    async def run(self) -> None:
        """Watch until cancelled."""
        with self._exchange.receiving(self._receive):
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._order())
                tasks.create_task(self._record())
                await self._evaluate()

    async def _evaluate(self) -> None:
        schedule = EvaluationSchedule(Wakeups(), None)
        self._tree.begin(time.time())
        while True:
            schedule.begin()
            self._watching.drain()
            now = time.time()
            due = now + TICK
            if not self._active:
                if self._mux and self._sending(now) == list(self._instances):
                    self._put_in_control(self._instances[0])
            elif now < schedule.trusted_from:
                due = min(due, schedule.trusted_from)
            else:
                verdict = self._tree.evaluate(self._watching, now=now, since=self._since)
                self._health, self._reason = verdict.state, verdict.reason
                others = [name for name in self._sending(now) if name != self._active]
                if verdict.state == "Failed" and others:
                    self._journal.write(detected=self._active, reason=verdict.reason)
                    self._put_in_control(others[0])
                elif (change := self._tree.deadline(self._watching, now=now, since=self._since)) is not None:
                    due = min(due, change + WAKE_LATE)
            await schedule.until(due)

    def _sending(self, now: float) -> list[str]:
        """Return the instances that send, whether they are in control or not."""
        last = {name: self._watching.last_from(COMMANDS, name) for name in self._instances}
        return [name for name, moment in last.items() if moment is not None and now - moment < self._gap]

    def _put_in_control(self, name: str) -> None:
        """Decide whom the mux forwards from now on. In a cluster, this is the write to the gate object."""
        # Samples are attributed by the DDS partitions of their writers, since all processes have one address.
        self._watching.attribute(dict.fromkeys(self._instances, ""), name)
        if not name:
            return
        self._epoch, self._active, self._since = self._epoch + 1, name, time.time()
        self._health, self._reason = "Starting", ""
        self._journal.write(control=name)
        self._send()

    def _send(self) -> None:
        self._nonce = secrets.token_hex(8)
        self._answered.clear()
        order = Order(self._created, self._epoch, self._active, mux=self._mux)
        self._exchange.publish(order_text(order, self._nonce, self._keys))

    async def _order(self) -> None:
        """Send the order again until the mux has answered it."""
        while True:
            if self._active and not self._answered.is_set():
                self._send()
            await asyncio.sleep(AGAIN)

    def _receive(self, text: str) -> None:
        """Take a report of the mux."""
        try:
            report = read_report(text, self._keys)
        except ProtocolError as error:
            self._journal.write(problem=f"a report of the mux is ignored: {error}")
            return
        self._mux = report.mux
        if self._nonce and report.nonce == self._nonce and not self._answered.is_set():
            self._answered.set()
            if report.refused:
                self._journal.write(problem=f"the mux refuses an order: {report.refused}")

    async def _record(self) -> None:
        """Record the state for the view."""
        sent, newest = dict.fromkeys(self._instances, 0), dict.fromkeys(self._instances, 0.0)
        while True:
            since, sends = time.time() - RATED, dict[str, float]()
            for name in self._instances:
                arrivals = self._watching.arrivals(COMMANDS, name)
                sends[name] = sum(moment > since for moment in arrivals) / RATED
                sent[name] += sum(moment > newest[name] for moment in arrivals)
                newest[name] = max(arrivals, default=newest[name])
            self._journal.write(health=self._health, reason=self._reason, active=self._active, sends=sends, sent=sent)
            await asyncio.sleep(STATE_PERIOD)


async def _run(journal: JournalWriter, token: bytes, gap: float, instances: Sequence[str]) -> None:
    from understudy.ros.actions.text_exchange import TextExchange
    from understudy.ros.observe.topic_watch import TopicWatch
    from understudy.ros.observe.writer_instances import WriterInstances
    from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
    from understudy.ros.runtime.graph_node import Graph

    graph = Graph("understudy_monitor")
    orders, reports = topics(NAMESPACE, WORKLOAD)
    exchange = TextExchange(graph, ArrivalWakeups(), reads=reports, writes=orders)
    watching, writers = TopicWatch(graph), WriterInstances(os.environ[names.ADDRESS_VARIABLE])
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(
            writers.follow(
                lambda: graph.publisher_count(COMMANDS),
                lambda: {end.gid for end in graph.publishers(COMMANDS)},
                lambda: watching.attribute_writers(writers.names),
            )
        )
        await LocalMonitor(watching, exchange, journal, token, gap, instances).run()


def main(arguments: list[str]) -> None:
    """Run until the process is ended."""
    journal, token, gap, *instances = arguments
    cpu_scheduling.ask_for_short_slices()
    asyncio.run(_run(JournalWriter(Path(journal)), Path(token).read_bytes(), float(gap), instances))


if __name__ == "__main__":
    main(sys.argv[1:])

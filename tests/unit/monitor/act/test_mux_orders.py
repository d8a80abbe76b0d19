"""A monitor passes on what the gate object says, over real DDS to a real forwarder, and counts only what that reports."""

from __future__ import annotations

import asyncio
import base64
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy")

from tests.unit.dds import isolate_discovery
from tests.unit.kube.memory import MemoryClient
from tests.unit.monitor.cluster_objects import workload_spec
from understudy.api import moments, names
from understudy.api.protocol.mux_messages import OnBoard, SafeCommand, StandingOrder, Token, derive, topics
from understudy.clock import CLOCK
from understudy.kube.client import LEASES, SECRETS, WORKLOADS, Object
from understudy.kube.gates.base import GateRecord, Reach
from understudy.kube.gates.mux_reports import MuxReports
from understudy.kube.gates.registry import KINDS
from understudy.monitor.act.gate.mux_orders import MuxOrders
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups
from understudy.mux.control_journal import ControlJournal
from understudy.mux.forwarder import Forwarder
from understudy.ros.actions.text_exchange import TextExchange
from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
from understudy.ros.runtime.graph_node import Graph

pytestmark = pytest.mark.ros

TOKEN = b"token"
KIND = KINDS["Mux"]
CREATED = moments.unix("2026-11-28T05:00:00Z") or 0.0


class HeardTopic:
    """A topic on which one instance sends."""

    output = "/cmd_vel"
    heard = ""

    def drain(self, forwards: Callable[[bytes], bool | None]) -> int:
        return int(bool(forwards(self.heard.encode()))) if self.heard else 0

    def forget(self) -> None:
        """Nothing is held."""

    def command(self, values: Mapping[str, Any]) -> None:
        """Nothing is sent."""


class Stand:
    """A monitor's part, a mux's, and the gate object."""

    def __init__(self, folder: Path, *, token: bytes = TOKEN, **gate: object) -> None:
        self._gate = {"kind": "Mux", **gate}
        self.ready: list[str] = []
        self.never_silent = ["/cmd_vel"]
        self.safety: Any = SimpleNamespace(of_mux=(), after=0.0)
        self.client, self.reports = MemoryClient(), MuxReports()
        self.view = ClusterView(self.client, "fleet", "w", Wakeups(), KIND)
        self._monitor, self._robot = Graph("understudy_monitor"), Graph("understudy_mux_w")
        orders, reports = topics("fleet", "w")
        self._monitors = TextExchange(self._monitor, ArrivalWakeups(), reads=reports, writes=orders)
        self._wakeups = ArrivalWakeups()
        self._exchange = TextExchange(self._robot, self._wakeups, reads=orders, writes=reports)
        self.route = HeardTopic()
        self.mux = Forwarder([self.route], derive(token, "fleet", "w"), ControlJournal(folder / "control.json"))

    async def begin(self) -> None:
        created = {"name": "w", "namespace": "fleet", "creationTimestamp": "2026-11-28T05:00:00Z"}
        workload: Object = {"kind": "RobotWorkload", "metadata": created, "spec": workload_spec(gate=self._gate)}
        self.view.workloads.put(await self.client.create(WORKLOADS, "fleet", workload))
        secret: Object = {"metadata": {"name": names.mux("w")}, "data": {names.TOKEN: base64.b64encode(TOKEN).decode()}}
        await self.client.create(SECRETS, "fleet", secret)
        self.view.gates.put(await self.client.create(LEASES, "fleet", KIND.closed("w", Reach(), epoch=4)))

    async def commit(self, name: str, *, noticed: bool = True) -> None:
        """Open the gate, as this monitor does, or another one of which the watch reports later."""
        record = self.view.gate_record or GateRecord()
        patch = KIND.commitment("w", over=record, active=name, active_uid=f"uid of {name}")
        self.view.gates.put(await KIND.write(self.client, "fleet", "w", patch))
        if noticed:
            self.reports.deciding()
            self.reports.committed(record.epoch + 1)

    async def serve(self) -> None:
        """Do what the process of a mux does."""
        while True:
            for text in self._exchange.received():
                self.mux.order(text)
            self.mux.drain()
            if self.mux.changed:
                self._exchange.publish(self.mux.report())
            await asyncio.sleep(0.01)

    async def until(self, source: str) -> None:
        async with asyncio.timeout(20):
            while self.reports.latest is None or self.reports.latest.report.source != source:
                await asyncio.sleep(0.01)

    async def cut_off(self) -> None:
        """Let the mux forward the instance on board, and wait until the monitor knows that."""
        control = replace(self.mux.control, source="home", on_board=True, token=Token(CREATED, 5, 1))
        self.mux.control, self.mux.changed = control, True
        await self.until("home")

    def hear(self, source: str) -> None:
        """Let samples of an instance arrive at the mux from now on."""
        self.route.heard = source
        self.mux.instances = {source.encode(): source}

    def close(self) -> None:
        self._monitor.close()
        self._robot.close()

    async def monitor(self) -> None:
        given = lambda: self.ready, lambda: self.never_silent, self.safety
        await MuxOrders(self.client, self.view, self._monitors, self.reports, *given).run()


@asynccontextmanager
async def running(stand: Stand) -> AsyncIterator[None]:
    await stand.begin()
    tasks = [asyncio.create_task(stand.monitor()), asyncio.create_task(stand.serve())]
    try:
        yield
        for task in tasks:
            assert not task.done(), task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        stand.close()


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    isolate_discovery(monkeypatch)


async def test_the_mux_forwards_whom_the_gate_names_and_who_waits_learns_it(tmp_path: Path) -> None:
    stand = Stand(tmp_path)
    async with running(stand):
        await stand.until("")
        await stand.commit("w-1")
        began = CLOCK.now()
        async with asyncio.timeout(20):
            assert await stand.reports.wait("uid of w-1", began) >= began
        assert stand.mux.control.source == "w-1"
        await stand.commit("w-2", noticed=False)
        await stand.until("w-2")
        assert stand.reports.reported("w-2")[:2] == ("True", "ReportedByMux")


async def test_the_admitted_standby_is_the_standing_order(tmp_path: Path) -> None:
    stand = Stand(tmp_path, reflex={"deadline": "100ms"})
    async with running(stand):
        await stand.commit("w-1")
        await stand.until("w-1")
        assert stand.mux.control.standing == StandingOrder()
        record = stand.view.gate_record
        assert record is not None
        patch = KIND.admission("w", over=record, admitted="w-2", admitted_uid="uid of w-2")
        stand.view.gates.put(await KIND.write(stand.client, "fleet", "w", patch))
        async with asyncio.timeout(20):
            while stand.mux.control.standing != StandingOrder(("w-2",), {"/cmd_vel": 0.1}):
                await asyncio.sleep(0.01)
        stand.ready = ["w-1", "w-3", "w-2"]
        async with asyncio.timeout(20):
            while stand.mux.control.standing.successors != ("w-2", "w-3"):
                await asyncio.sleep(0.01)
        await stand.commit("w-2")
        await stand.until("w-2")
        assert stand.mux.control.standing == StandingOrder(), "nobody is admitted any more"


async def test_the_standing_order_ends_with_the_instance_on_board_and_safe_commands_but_not_during_a_fence(
    tmp_path: Path,
) -> None:
    stand = Stand(tmp_path, mux={"onBoard": {"name": "home", "after": "2s"}})
    stand.safety = SimpleNamespace(of_mux=(SafeCommand("/cmd_vel", {}, 0.1),), after=0.2)
    async with running(stand):
        await stand.commit("w-1")
        await stand.until("w-1")
        expected = StandingOrder(
            on_board=OnBoard("home", {"/cmd_vel": 2.0}), safe=stand.safety.of_mux, safe_after=stand.safety.after
        )
        assert stand.mux.control.standing == expected
        record = stand.view.gate_record
        assert record is not None
        patch = KIND.commitment("w", over=record, fenced=3)
        stand.view.gates.put(await KIND.write(stand.client, "fleet", "w", patch))
        await stand.until("")
        assert stand.mux.control.standing == StandingOrder()


async def test_a_silence_counts_only_on_topics_that_must_be_published_now(tmp_path: Path) -> None:
    stand = Stand(tmp_path, mux={"onBoard": {"name": "home", "after": "2s"}})
    stand.never_silent = []
    async with running(stand):
        await stand.commit("w-1")
        await stand.until("w-1")
        assert stand.mux.control.standing == StandingOrder(on_board=OnBoard("home", {})), "it has no goal"
        stand.never_silent = ["/cmd_vel"]
        async with asyncio.timeout(20):
            while stand.mux.control.standing != StandingOrder(on_board=OnBoard("home", {"/cmd_vel": 2.0})):
                await asyncio.sleep(0.01)


async def test_control_returns_from_on_board_to_an_instance_that_has_nothing_to_send(tmp_path: Path) -> None:
    stand = Stand(tmp_path, mux={"onBoard": {"name": "home", "after": "2s"}})
    async with running(stand):
        await stand.commit("w-1")
        await stand.until("w-1")
        await stand.cut_off()
        stand.ready, stand.never_silent = ["w-1"], []
        await stand.until("w-1")


async def test_control_returns_from_on_board_when_the_mux_hears_the_active_instance_and_it_is_ready(
    tmp_path: Path,
) -> None:
    stand = Stand(tmp_path, mux={"onBoard": {"name": "home", "after": "2s"}})
    async with running(stand):
        await stand.commit("w-1")
        await stand.until("w-1")
        await stand.cut_off()
        assert stand.reports.reported("w-1")[:2] == ("False", "OnBoard")
        stand.hear("w-1")
        await asyncio.sleep(1.5)
        assert stand.mux.control.source == "home", "its agent has not reported that it is ready"
        stand.ready = ["w-1"]
        await stand.until("w-1")
        assert stand.mux.control.token == Token(CREATED, 5, 2)
        assert stand.reports.reported("w-1")[:2] == ("True", "ReportedByMux")


async def test_a_mux_with_another_token_is_not_heard_and_carries_nothing_out(tmp_path: Path) -> None:
    stand = Stand(tmp_path, token=b"of somebody else")
    async with running(stand):
        await stand.commit("w-1")
        await asyncio.sleep(1.0)
        assert stand.mux.control.source == ""
        assert stand.reports.latest is None


async def test_a_lost_request_for_the_token_of_the_mux_is_soon_sent_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until then nobody orders the mux anything (seed 3312370)."""
    stand = Stand(tmp_path)
    read = stand.client.get

    async def hang(*_: object) -> Object:
        monkeypatch.setattr(stand.client, "get", read)
        await asyncio.Event().wait()
        raise AssertionError

    monkeypatch.setattr(stand.client, "get", hang)
    async with running(stand):
        await stand.commit("w-1")
        await stand.until("w-1")

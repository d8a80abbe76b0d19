"""Safe commands while nobody drives the robot: when they begin and end, and that they arrive over real DDS."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("rclpy")

from tests.support.clock import set_clock
from tests.unit.dds import isolate_discovery
from tests.unit.monitor.cluster_objects import TWIST, ClusterObjects, parsed_spec
from tests.unit.monitor.senses import GivenGraph, NoOutputs
from understudy.api.kinds.failure_policy import Safety
from understudy.api.kinds.robot_workload import Attempt, RobotWorkloadSpec
from understudy.failover.interfaces import GateState
from understudy.failover.pinned import PinnedPod
from understudy.failover.progress import PodIdentity, Progress
from understudy.monitor.act import safe_commands
from understudy.monitor.act.safe_commands import SafeCommands, Unattended
from understudy.monitor.decide.pause_state import PauseState
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.outcome import Kind, Outcome
from understudy.ros.actions.repeated_publisher import Commander


def progress(**moments: float) -> Progress:
    found = Progress.begin("silent", last_healthy=99.0, detected=100.0)
    found.moments.update(moments)
    return found


DROVE = (PinnedPod(name="w-2", uid="u-2", ip="10.0.0.2"),)


class Waits:
    """Since when a robot waits, by the recovery in progress."""

    def __init__(self) -> None:
        self.objects = ClusterObjects()
        self.objects.put_workload()
        self.current = CurrentRecovery()
        pauses = PauseState(self.objects.view, self.objects.notices)
        self.unattended = Unattended(self.objects.view, pauses, self.current)

    def during(self, progress: Progress) -> float | None:
        with self.current.during(progress):
            return self.unattended.since

    def conclude(self, kind: Kind) -> None:
        self.unattended.conclude(Outcome(kind, progress()))

    @property
    def after(self) -> float | None:
        return self.unattended.since


class TestUnattended:
    def test_no_safe_command_is_sent_before_the_failed_instance_is_fenced(self) -> None:
        assert Waits().during(progress(decided=100.0)) is None

    def test_safe_commands_begin_when_the_gate_closes_and_again_when_it_opens(self) -> None:
        found = Waits()
        assert found.during(progress(fenced=101.0)) == 101.0
        assert found.during(progress(fenced=101.0, committed=105.0)) == 105.0, "whom it names has its time too"

    def test_a_commit_that_the_api_server_has_not_acknowledged_begins_no_safe_commands(self) -> None:
        assert Waits().during(progress(committing=105.0)) is None

    def test_the_first_output_ends_safe_commands(self) -> None:
        found = Waits()
        found.during(progress(fenced=101.0))
        assert found.during(progress(fenced=101.0, committed=105.0, first_output=105.1)) is None
        assert found.after is None

    def test_the_next_attempt_continues_the_safe_commands(self) -> None:
        found, under_way = Waits(), progress(fenced=101.0, committed=105.0)
        found.during(under_way)
        under_way.attempts.append(Attempt(strategy="Fallback/Executing", result="NotVerified"))
        under_way.forget_attempt()
        assert found.during(under_way) == 105.0
        successor = Waits()
        successor.objects.put_gate(GateState(2, recovery=under_way))
        assert successor.during(under_way) == 100.0, "a new monitor goes by the failure"

    def test_an_attempt_without_a_commit_begins_no_safe_commands(self) -> None:
        under_way = progress(committing=105.0)
        under_way.attempts.append(Attempt(strategy="Fallback/Executing", result="NotAvailable"))
        assert Waits().during(under_way) is None

    def test_a_robot_that_already_follows_the_standby_receives_no_safe_command(self) -> None:
        under_way = progress(fenced=101.0)
        under_way.taken_over = PodIdentity(name="p", uid="u")
        assert Waits().during(under_way) is None

    @pytest.mark.parametrize("kind", ["Recovered", "Superseded", "SwitchedOver", "NotSwitchedOver"])
    def test_safe_commands_continue_after_a_failed_recovery_until_an_instance_drives(self, kind: Kind) -> None:
        found = Waits()
        found.during(progress(fenced=101.0))
        found.conclude("NothingVerified")
        assert found.after == 101.0
        found.conclude("Stopped")
        assert found.after == 101.0
        found.conclude(kind)
        assert found.after is None

    def test_a_failed_recovery_that_fenced_nobody_begins_no_safe_commands(self) -> None:
        found = Waits()
        found.conclude("NothingVerified")
        assert found.after is None, "the failed instance is still let through"

    def test_a_fence_that_no_poll_saw_begins_safe_commands(self) -> None:
        found = Waits()
        found.unattended.conclude(Outcome("NothingVerified", progress(fenced=101.0)))
        assert found.after == 101.0

    def test_an_instance_that_drives_beside_another_receives_no_safe_commands(self) -> None:
        found = Waits()
        found.unattended.conclude(
            Outcome("NothingVerified", progress(fenced=101.0, committed=102.0, first_output=103.0))
        )
        assert found.after is None

    def test_safe_commands_begin_when_the_gate_closes_outside_of_a_recovery_and_again_when_it_opens(self) -> None:
        found, began = Waits(), time.time()
        found.objects.put_gate(GateState(2, active="w-2", active_uid="u-2", pinned=DROVE))
        assert found.after is None
        found.objects.put_gate(GateState(3, pinned=DROVE))
        closed = found.after
        assert closed is not None
        assert began <= closed == found.after
        found.objects.put_gate(GateState(4, active="w-2", active_uid="u-2", pinned=DROVE))
        opened = found.after
        assert opened is not None
        assert closed < opened == found.after, "whom it names has its time too"
        found.unattended.driven()
        assert found.after is None

    def test_a_new_monitor_that_finds_a_closed_gate_sends_safe_commands(self) -> None:
        found, left = Waits(), progress()
        left.result = "Failed"
        found.objects.put_gate(GateState(2, recovery=left, pinned=DROVE))
        assert found.after is not None

    @pytest.mark.parametrize(
        "state", [GateState(2), GateState(2, recovery=progress(), pinned=DROVE)], ids=["never opened", "other monitor"]
    )
    def test_a_gate_that_never_opened_or_that_another_monitor_closed_begins_no_safe_commands(
        self, state: GateState
    ) -> None:
        found = Waits()
        found.objects.put_gate(state)
        assert found.after is None

    @given(
        st.lists(
            st.sampled_from(["fenced", "committed", "first_output", "verified", "fail", "forget", "driven"]),
            max_size=12,
        )
    )
    def test_a_driven_robot_never_receives_safe_commands(self, steps: list[str]) -> None:
        found, under_way = Waits(), progress()
        for number, step in enumerate(steps):
            if step == "driven":
                found.unattended.driven()
                assert found.after is None
                under_way = progress()
            elif step == "fail":
                under_way.attempts.append(Attempt(strategy="Restart", result="NotVerified"))
            elif step == "forget":
                under_way.forget_attempt()
            else:
                under_way.moments[step] = 100.0 + number
            since = found.during(under_way)
            if "first_output" in under_way.moments or "verified" in under_way.moments:
                assert since is None


@pytest.fixture
def graphs(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Any, Any]]:
    from understudy.ros.runtime.graph_node import Graph

    isolate_discovery(monkeypatch)
    made = Graph("monitor"), Graph("robot")
    yield made
    for graph in made:
        graph.close()


class Waiting(Unattended):
    """A robot that has waited since a time, or does not wait."""

    def __init__(self, since: float | None) -> None:
        self.waiting_since = since

    @property
    def since(self) -> float | None:
        return self.waiting_since


def spec(*, reflex: bool = False) -> RobotWorkloadSpec:
    outputs = [
        {"topic": "/cmd_vel", "type": TWIST},
        {"topic": "/arm", "type": "my_msgs/msg/Arm"},
        {"service": "/snap", "type": "std_srvs/srv/Trigger"},
    ]
    return parsed_spec(outputs=outputs, gate={"reflex": {"deadline": "100ms"}} if reflex else {})


def safety(*commands: dict[str, Any], after: str = "0s") -> Safety:
    return Safety.model_validate({"commands": list(commands), "after": after})


def received(subscription: Any) -> list[Any]:
    found = []
    with subscription.handle:
        while (taken := subscription.handle.take_message(subscription.msg_type, False)) is not None:
            found.append(taken[0])
    return found


async def test_the_robot_receives_safe_commands_at_their_period_until_an_instance_drives(
    graphs: tuple[Any, Any],
) -> None:
    monitor, robot = graphs
    subscription = robot.subscribe("/cmd_vel", TWIST, depth=100)
    waited = Waiting(None)
    safe = SafeCommands(monitor, waited, NoOutputs())
    command = {"topic": "/cmd_vel", "every": "20ms", "message": {"linear": {"x": -0.1}}}
    safe.follow(safety(command, after="200ms"), spec())
    assert safe.problems == []
    while not robot.publishers("/cmd_vel") or not monitor.subscribers("/cmd_vel"):
        await asyncio.sleep(0.02)
    await asyncio.sleep(0.3)
    assert safe.sent == 0, "somebody drives"
    waited.waiting_since = started_at = time.time()
    commands: list[Any] = []
    while len(commands) < 5:
        assert time.time() < started_at + 20
        await asyncio.sleep(0.02)
        commands += received(subscription)
        assert not safe.sent or time.time() >= started_at + 0.2, "not before its time"
    assert {message.linear.x for message in commands} == {-0.1}
    waited.waiting_since = None
    await asyncio.sleep(0.1)
    sent = safe.sent
    await asyncio.sleep(0.3)
    assert safe.sent == sent
    safe.follow(None, spec())
    assert not monitor.publishers("/cmd_vel")


@pytest.mark.parametrize(
    ("command", "reflex", "words"),
    [
        ({"topic": "/cmd_vle"}, False, "/cmd_vle is not a topic of the workload's outputs (/cmd_vel, /arm)"),
        ({"topic": "/cmd_vel", "message": {"liner": {}}}, False, "liner: Twist has no field liner; did you mean linear?"),
        ({"topic": "/arm"}, False, "my_msgs"),
        ({"topic": "/cmd_vel"}, True, "spec.gate.reflex"),
    ],
)  # fmt: skip
async def test_a_safe_command_that_cannot_be_sent_is_reported(
    graphs: tuple[Any, Any], command: dict[str, Any], reflex: bool, words: str
) -> None:
    safe = SafeCommands(graphs[0], Waiting(1.0), NoOutputs())
    safe.follow(safety(command), spec(reflex=reflex))
    (problem,) = safe.problems
    assert problem.startswith("FailurePolicy: spec.safety.commands[0]: ")
    assert words in problem
    await asyncio.sleep(0.05)
    assert safe.sent == 0


async def test_a_topic_that_is_watched_with_another_type_is_reported(
    graphs: tuple[Any, Any],
) -> None:
    watched = graphs[0].subscribe("/cmd_vel", "geometry_msgs/msg/TwistStamped", depth=1)
    safe = SafeCommands(graphs[0], Waiting(1.0), NoOutputs())
    safe.follow(safety({"topic": "/cmd_vel"}), spec())
    (problem,) = safe.problems
    assert problem.startswith("FailurePolicy: spec.safety.commands[0]: ")
    graphs[0].unsubscribe(watched)


class Publisher(Commander):
    """In place of one of DDS."""

    def __init__(self) -> None:
        self.sent, self.failures = 0, 0

    def publish(self) -> None:
        if self.failures:
            self.failures -= 1
            raise RuntimeError("the middleware refused")
        self.sent += 1

    def close(self) -> None:
        return


@contextlib.asynccontextmanager
async def repeated(since: float, outputs: NoOutputs | None = None) -> AsyncIterator[Publisher]:
    """A command of every 10 ms from 50 ms on, for as long as nobody drives."""
    publisher = Publisher()
    safe = SafeCommands(GivenGraph(), Waiting(since), outputs or NoOutputs())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(safe_commands, "Commander", lambda *_: publisher)
        safe.follow(safety({"topic": "/cmd_vel", "every": "10ms"}, after="50ms"), spec())
    yield publisher
    safe.close()


async def test_a_failed_safe_command_is_followed_by_the_next() -> None:
    async with repeated(time.time() - 1) as publisher, asyncio.timeout(20):
        publisher.failures = 3
        while publisher.sent < 3:
            await asyncio.sleep(0.01)


async def test_a_clock_that_is_set_back_does_not_stop_safe_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    async with repeated(time.time()) as publisher, asyncio.timeout(20):
        while not publisher.sent:
            await asyncio.sleep(0.01)
        set_clock(monkeypatch, -3600)
        before = publisher.sent
        while publisher.sent < before + 3:
            await asyncio.sleep(0.01)


async def test_a_clock_of_another_node_that_is_ahead_does_not_delay_safe_commands() -> None:
    async with repeated(time.time() + 3600) as publisher, asyncio.timeout(20):
        started_at = time.monotonic()
        while not publisher.sent:
            await asyncio.sleep(0.005)
        assert time.monotonic() - started_at >= 0.045


class Heard(NoOutputs):
    """Somebody was heard at a time."""

    def __init__(self, at: float, interval: float = 0.05) -> None:
        self.at, self.interval = at, interval

    def heard(self) -> Sequence[tuple[float, float]]:
        return [(self.at, self.interval)]


async def test_no_safe_command_is_sent_while_a_slow_driver_is_heard() -> None:
    """Its next sample may be on its way."""
    for interval in (0.5, math.inf):
        outputs = Heard(time.time(), interval)
        async with repeated(time.time() - 1, outputs) as publisher, asyncio.timeout(20):
            for _ in range(3):
                await asyncio.sleep(0.5)
                outputs.at = time.time()
            assert publisher.sent == 0
            silent_since = time.monotonic()
            while not publisher.sent:
                await asyncio.sleep(0.005)
            expected = min(2 * interval, safe_commands.HEARD_FOR_MOST)
            assert expected - 0.02 <= time.monotonic() - silent_since


async def test_no_safe_command_is_sent_while_somebody_else_is_heard() -> None:
    outputs = Heard(time.time() + 20)
    async with repeated(time.time() - 1, outputs) as publisher, asyncio.timeout(20):
        await asyncio.sleep(0.3)
        assert publisher.sent == 0
        outputs.at, silent_since = time.time(), time.monotonic()
        while not publisher.sent:
            await asyncio.sleep(0.005)
        assert time.monotonic() - silent_since >= safe_commands.HEARD_FOR - 0.02

"""The process of a mux over real DDS: orders by a topic, two instances in partitions, and a robot without a profile."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("rclpy")


from tests.unit.ros.processes import Processes
from tests.unit.ros.test_forwarded_topic import CHAT, HEAR, TALK, TYPE
from understudy.api import names
from understudy.api.kinds.robot_workload import Output
from understudy.api.protocol.mux_messages import (
    OnBoard,
    Order,
    Report,
    SafeCommand,
    StandingOrder,
    Token,
    derive,
    order_text,
    read_report,
    topics,
)
from understudy.mux.process import _remembered
from understudy.process.restarts import STEADY
from understudy.ros.dds.profiles import muxed_profiles_xml

pytestmark = pytest.mark.ros

TOKEN = b"token"
ORDER = Order(1000.0, 5, "w-1")

MONITOR = """
import sys, threading
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import String

rclpy.init()
node = Node("monitor")
publisher = node.create_publisher(String, sys.argv[1], QoSProfile(depth=10))
node.create_subscription(String, sys.argv[2], lambda message: print(message.data, flush=True), QoSProfile(depth=10))
threading.Thread(target=lambda: rclpy.spin(node), daemon=True).start()
print("ready", flush=True)
for line in sys.stdin:
    publisher.publish(String(data=line.rstrip("\\n")))
"""


class Stand:
    """A robot, a monitor's topics, instances, and the process of a mux, of one workload."""

    def __init__(self, processes: Processes, folder: Path, workload: str = "w", topic: str = CHAT) -> None:
        self.outputs, self._keys = [Output(topic=topic, type=TYPE)], derive(TOKEN, "fleet", workload)
        self._remapped = ["--ros-args", "-r", f"{CHAT}:={topic}"]
        self.settings = {
            names.NAMESPACE_VARIABLE: "fleet",
            names.WORKLOAD_VARIABLE: workload,
            names.OUTPUTS_VARIABLE: json.dumps([{"topic": topic, "type": TYPE}]),
        }
        for name, text in (("talk", TALK), ("hear", HEAR), ("monitor", MONITOR)):
            (folder / f"{name}.py").write_text(text)
        (folder / "instance.xml").write_text(muxed_profiles_xml(self.outputs))
        (folder / "token").write_bytes(TOKEN)
        self._processes, self._folder = processes, folder
        self.robot = processes.node(*self._remapped, script=str(folder / "hear.py"))
        self.monitor = processes.node(*topics("fleet", workload), script=str(folder / "monitor.py"))

    def start(self, **environment: str) -> None:
        self.mux = self._processes.start(
            [sys.executable, "-m", "understudy.main", "mux"],
            **self.settings,
            UNDERSTUDY_TOKEN_FILE=str(self._folder / "token"),
            UNDERSTUDY_STATE=str(self._folder / "state"),
            UNDERSTUDY_ADDRESS="127.0.0.1",
            **environment,
        )

    def instance(self, pod: str, *, muxed: bool = True) -> subprocess.Popen[str]:
        profile = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(self._folder / "instance.xml")} if muxed else {}
        node: subprocess.Popen[str] = self._processes.node(
            pod,
            *self._remapped,
            script=str(self._folder / "talk.py"),
            **{names.POD_VARIABLE: pod, **profile},
        )
        return node

    def order(self, order: Order) -> Report:
        """Send an order until the mux has received it. It names the mux."""
        nonce = os.urandom(4).hex()
        order = replace(order, mux=self.report().mux)
        end = time.monotonic() + 30
        while time.monotonic() < end:
            print(order_text(order, nonce, self._keys), file=self.monitor.stdin, flush=True)
            report = self.report()
            if report.nonce == nonce:
                return report
        pytest.fail("the mux has not received the order")

    def report(self) -> Report:
        """Return the next report."""
        return read_report(self._processes.line(self.monitor, 30), self._keys)

    def until(self, source: str) -> Report:
        """Wait until samples of an instance are forwarded."""
        end = time.monotonic() + 30
        while (report := self.report()).source != source or not report.forwarded:
            assert time.monotonic() < end, f"{source} is not forwarded: {report}"
        return report

    def hears(self, last: str) -> list[str]:
        """Wait until the robot has received from a pod, and return the pods as ``heard`` does. A forwarded sample is still on its way."""
        end, found = time.monotonic() + 30, self.heard()
        while last not in found:
            assert time.monotonic() < end, f"nothing of {last} was received"
            found = list(dict.fromkeys([*found, *self.heard()]))
        return found

    def heard(self) -> list[str]:
        """Return the pods from which the robot received since it was asked last, each once, in order."""
        print(file=self.robot.stdin, flush=True)
        pods = self._processes.line(self.robot, 30).split()[::2]
        return [pod for index, pod in enumerate(pods) if not index or pods[index - 1] != pod]


@pytest.fixture
def stand(processes: Processes, discovery_server: Callable[[], object], tmp_path: Path) -> Stand:
    discovery_server()
    found = Stand(processes, tmp_path)
    found.start()
    return found


def test_the_robot_receives_whom_the_newest_order_names_also_after_a_restart_of_the_mux(stand: Stand) -> None:
    stand.instance("w-1")
    stand.instance("w-2")
    assert stand.heard() == []
    stand.order(ORDER)
    stand.until("w-1")
    stand.order(replace(ORDER, epoch=6, source="w-2"))
    stand.until("w-2")
    assert stand.hears("w-2") == ["w-1", "w-2"]
    stand.mux.kill()
    stand.start()
    stand.until("w-2")
    assert "of epoch 5" in stand.order(ORDER).refused
    assert stand.heard() == ["w-2"]


def test_a_mux_that_crashes_goes_on_by_itself(stand: Stand) -> None:
    stand.instance("w-1")
    stand.order(ORDER)
    mux = stand.until("w-1").mux
    time.sleep(STEADY)
    children = Path(f"/proc/{stand.mux.pid}/task/{stand.mux.pid}/children")
    crashed = children.read_text()
    os.kill(int(crashed), signal.SIGKILL)
    while children.read_text() in ("", crashed):
        assert stand.mux.poll() is None
    stand.heard()
    end = time.monotonic() + 10
    while stand.heard() != ["w-1"]:
        assert time.monotonic() < end
    assert stand.until("w-1").mux == mux


def test_a_mux_that_cannot_remember_its_writers_forwards_nevertheless(stand: Stand, tmp_path: Path) -> None:
    (tmp_path / "state" / "writers.json.new").mkdir(parents=True)
    stand.instance("w-1")
    stand.order(ORDER)
    stand.until("w-1")
    assert not (tmp_path / "state" / "writers.json").exists()
    assert stand.heard() == ["w-1"]


def test_a_mux_knows_the_writers_that_its_former_process_knew(tmp_path: Path) -> None:
    memory = tmp_path / "writers.json"
    assert _remembered(memory) == {}
    memory.write_text('{"0102": "w-1"}')
    assert _remembered(memory) == {b"\1\2": "w-1"}
    for damaged in ("{", '{"no": "w-1"}', "[]"):
        memory.write_text(damaged)
        assert _remembered(memory) == {}


def test_a_silent_instance_is_replaced_while_nobody_gives_orders(stand: Stand) -> None:
    first = stand.instance("w-1")
    stand.instance("w-2")
    while not {"w-1", "w-2"} <= stand.report().heard.keys():
        pass  # otherwise the mux may replace an instance that it has not discovered yet
    stand.order(replace(ORDER, standing=StandingOrder(("w-2",), {CHAT: 0.5})))
    stand.until("w-1")
    first.kill()
    assert stand.until("w-2").token == Token(1000.0, 5, 1)
    assert stand.heard() == ["w-1", "w-2"]


def test_the_instance_on_board_drives_while_the_others_are_cut_off_and_a_restart_of_the_mux_changes_nothing(
    stand: Stand,
) -> None:
    first = stand.instance("w-1")
    stand.instance("home")
    order = replace(ORDER, standing=StandingOrder(on_board=OnBoard("home", {CHAT: 0.5})))
    while not {"w-1", "home"} <= stand.report().heard.keys():
        pass
    stand.order(order)
    stand.until("w-1")
    first.kill()
    report = stand.until("home")
    assert (report.token, report.on_board) == (Token(1000.0, 5, 1), True)
    stand.mux.kill()
    stand.start()
    stand.until("home")
    stand.instance("w-1")
    while "w-1" not in (report := stand.report()).heard:
        assert report.source == "home"
    stand.order(replace(order, knows=report.token))
    assert stand.until("w-1").token == Token(1000.0, 5, 2)
    assert stand.heard() == ["w-1", "home", "w-1"]


def test_the_robot_receives_safe_commands_from_nobody_in_control_and_none_beside_an_instance(stand: Stand) -> None:
    stand.instance("w-1")
    safe = StandingOrder(safe=(SafeCommand(CHAT, {"data": "safe 0"}, 0.02),), safe_after=0.1)
    stand.order(replace(ORDER, source="", standing=safe))
    end = time.monotonic() + 30
    while stand.heard() != ["safe"]:
        assert time.monotonic() < end
    stand.order(replace(ORDER, epoch=6, standing=safe))
    stand.until("w-1")
    assert stand.heard() in (["safe", "w-1"], ["w-1"]), "no safe command after the first one of the instance"
    assert stand.report().safe_sent


def test_a_writer_beside_the_mux_is_reported_unless_its_node_is_allowed(stand: Stand) -> None:
    stand.instance("w-1", muxed=False)
    stand.order(ORDER)
    end = time.monotonic() + 30
    while stand.report().strangers != (f"{CHAT} by /talker",):
        assert time.monotonic() < end, stand.report()
    stand.mux.kill()
    stand.start(**{names.ALLOWED_NODES_VARIABLE: '["/talker"]'})
    stand.order(replace(ORDER, epoch=6))
    stand.instance("w-1")
    # Discovery has reported the writer of the instance, and so the one beside it, and that of the mux that was killed.
    assert stand.until("w-1").strangers == ()


def test_one_process_forwards_the_workloads_of_a_robot_each_by_its_own_orders(
    processes: Processes, discovery_server: Callable[[], object], tmp_path: Path
) -> None:
    discovery_server()
    stands = {"w": CHAT, "v": "/other"}
    for workload in (*stands, "broken"):
        (tmp_path / workload).mkdir()
    w, v = (Stand(processes, tmp_path / workload, workload, topic) for workload, topic in stands.items())
    broken = w.settings | {
        names.WORKLOAD_VARIABLE: "x",
        names.OUTPUTS_VARIABLE: '[{"topic": "/x", "type": "no_such/msg/Type"}]',
    }
    for workload, settings in (("w", w.settings), ("v", v.settings), ("broken", broken)):
        folder = tmp_path / "served" / workload
        folder.mkdir(parents=True)
        for name, text in (settings | {names.TOKEN: TOKEN.decode()}).items():
            (folder / name).write_text(text)

    def start() -> subprocess.Popen[str]:
        return processes.start(
            [sys.executable, "-m", "understudy.main", "mux"],
            UNDERSTUDY_MUX_FOLDER=str(tmp_path / "served"),
            UNDERSTUDY_STATE=str(tmp_path / "state"),
            UNDERSTUDY_ADDRESS="127.0.0.1",
        )

    mux = start()
    for stand, pods in ((w, ("w-1", "w-2")), (v, ("v-1",))):
        for pod in pods:
            stand.instance(pod)
    w.order(ORDER)
    w.until("w-1")
    assert v.heard() == [], "nobody has ordered anything for it"
    v.order(replace(ORDER, epoch=9, source="v-1"))
    v.until("v-1")
    w.order(replace(ORDER, epoch=6, source="w-2"))
    w.until("w-2")
    assert (w.heard(), v.heard()) == (["w-1", "w-2"], ["v-1"])
    mux.kill()
    start()
    assert w.until("w-2").mux == v.until("v-1").mux
    assert "of epoch 5" in w.order(ORDER).refused
    assert (w.heard(), v.heard()) == (["w-2"], ["v-1"])

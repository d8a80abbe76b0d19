"""Measures what a mux costs between the instances and the robot, and how soon it switches.

    scripts/bench mux [--minutes 10] [--switches 50] [--silences 20] [--crashes 10]

Two instances publish 100 messages/s each, in partitions of their own, and a robot without a profile receives what the
real process of a mux forwards. The instances publish each message once more on a topic that no mux forwards. The added
latency of a message is how much later the robot receives it by the mux than directly. Then orders switch between the
instances, and standing orders replace one that is frozen (SIGSTOP). At last the process that forwards is killed
(SIGKILL). All processes run on this machine, over UDP, with a discovery server.

The processor time has a floor, which is measured first: a relay in place of the mux takes each sample, and publishes
those of the first writer, without any judgement. Nearly all that it needs, the middleware and the kernel need: the
threads in which the middleware receives and acknowledges are counted apart, since no line of this project runs there.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bench.results import Report, quantile
from bench.roles import Role, answering, cpu_seconds, end_with_parent, environment, running, tell
from understudy.process.restarts import STEADY

MUXED, DIRECT, TYPE = "/cmd_vel", "/cmd_vel_direct", "geometry_msgs/msg/TwistStamped"
INSTANCES = ("instance-1", "instance-2")
RELAY = "relay"
PERIOD = 0.01
"""Seconds between two messages of an instance."""

MIDDLEWARE_THREADS = "dds."
"""What the names of the threads of Fast DDS begin with."""

SILENCE = 0.1
"""Seconds of silence after which the mux switches by itself."""

RESTARTS_WITHIN = 10.0
"""Seconds within which a mux that crashed must forward again."""

SERVER = "BENCH_DISCOVERY_SERVER"
"""Environment variable with the address of the discovery server, for the processes of the run."""

REPOSITORY = Path(__file__).resolve().parent.parent

TOKEN = b"bench"
OUTPUT = {"topic": MUXED, "type": TYPE}
DIRECTLY = f"""
    <data_writer profile_name="{DIRECT}">
      <propertiesPolicy><properties><property><name>partitions</name><value>;direct</value></property></properties></propertiesPolicy>
    </data_writer>
"""
"""The writers of the other topic are in the default partition too, which an empty name stands for: the robot reads there."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--switches", type=int, default=50)
    parser.add_argument("--silences", type=int, default=20)
    parser.add_argument("--crashes", type=int, default=10)
    parser.add_argument("--role", help=argparse.SUPPRESS)
    options = parser.parse_args()
    environment()
    if server := os.environ.get(SERVER):
        os.environ["ROS_DISCOVERY_SERVER"] = server
    if options.role:
        end_with_parent()
        {"robot": _robot, RELAY: _relay}.get(options.role, lambda: _instance(options.role))()
        return 0
    report = Report("mux")
    with tempfile.TemporaryDirectory() as folder, _discovery(Path(folder)):
        _floor(report, Path(folder), min(60.0, options.minutes * 60))
        with _stand(Path(folder)) as stand:
            stand.until_driven(INSTANCES[0])
            _steady(report, stand, options.minutes * 60)
            _orders(report, stand, options.switches)
            _silences(report, stand, options.silences)
            _crashes(report, stand, options.crashes)
    report.note("load", f"two instances, each with {1 / PERIOD:g} messages/s of {TYPE}; one is forwarded")
    print(report.table())
    print(report.write())
    return 0 if report.held else 1


class _Stand:
    """The processes, and the monitor's side of the orders."""

    def __init__(self, roles: dict[str, Role], mux: subprocess.Popen[bytes]) -> None:
        from understudy.api.protocol.mux_messages import derive, topics
        from understudy.ros.actions.text_exchange import TextExchange
        from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
        from understudy.ros.runtime.graph_node import Graph

        self.roles, self._mux, self._keys = roles, mux, derive(TOKEN, "bench", "w")
        orders, reports = topics("bench", "w")
        self._exchange = TextExchange(Graph("bench"), ArrivalWakeups(), reads=reports, writes=orders)
        self._epochs, self._nonces = itertools.count(1), itertools.count(1)
        self._name = ""
        """What the mux is called in orders, by its reports."""

    def order(self, source: str, *, standing: bool = False) -> float:
        """Order whom the mux forwards from now on. Returns when, in monotonic seconds."""
        from understudy.api.protocol.mux_messages import Order, StandingOrder, Token, order_text, read_report

        for report in self._exchange.received():
            self._name = read_report(report, self._keys).mux
        successor = next(one for one in INSTANCES if one != source)
        planned = StandingOrder((successor,), {MUXED: SILENCE}) if standing else StandingOrder()
        # The greatest token: this monitor knows every switch of the mux.
        order = Order(1.0, next(self._epochs), source, Token(2.0), planned, mux=self._name)
        text = order_text(order, str(next(self._nonces)), self._keys)
        at = time.monotonic()
        self._exchange.publish(text)
        return at

    def received(self) -> list[tuple[float, float, str, int, str]]:
        """Return what the robot received since it was asked last: when, when it was sent, by whom, its number, and the topic."""
        return [tuple(one) for one in self.roles["robot"].ask("received")["received"]]

    def until_driven(self, pod: str) -> None:
        """Order an instance until the robot receives it."""
        end = time.monotonic() + 60
        while not any(topic == MUXED and by == pod for _, _, by, _, topic in self.received()):
            if time.monotonic() > end:
                raise SystemExit(f"the robot does not receive {pod}; is multicast possible here?")
            self.order(pod)
            time.sleep(0.5)

    def cpu(self) -> float:
        """Return the CPU seconds of the mux so far."""
        return cpu_seconds(self._mux.pid) + cpu_seconds(self.forwarder())

    def forwarder(self) -> int:
        """Return the process that forwards: another one starts it again when it crashes."""
        return int(Path(f"/proc/{self._mux.pid}/task/{self._mux.pid}/children").read_text())


@contextmanager
def _discovery(folder: Path) -> Iterator[None]:
    """Run a discovery server, which all processes use from now on: a robot has one unless its user wants none."""
    with contextlib.ExitStack() as sockets:
        free = [sockets.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)]
        for one in free:
            one.bind(("127.0.0.1", 0))
        port, asked = (str(one.getsockname()[1]) for one in free)
    settings = {"UNDERSTUDY_ENVIRONMENT": sys.prefix, "HOME": str(folder), "UNDERSTUDY_DISCOVERY_ASKED": asked}
    program = REPOSITORY / "docker" / "understudy-discovery-server"
    server = subprocess.Popen([program, "127.0.0.1", port], env={**os.environ, **settings}, start_new_session=True)
    os.environ[SERVER] = os.environ["ROS_DISCOVERY_SERVER"] = f"127.0.0.1:{port}"
    try:
        yield
    finally:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait()


def _instances(folder: Path) -> dict[str, dict[str, str]]:
    """Return the environment of each instance."""
    from understudy.api import names
    from understudy.api.kinds.robot_workload import Output
    from understudy.ros.dds.profiles import muxed_profiles_xml

    profile, of_instances = folder / "instance.xml", muxed_profiles_xml([Output.model_validate(OUTPUT)])
    profile.write_text(of_instances.replace("</profiles>", f"{DIRECTLY}</profiles>"))
    return {pod: {names.POD_VARIABLE: pod, "FASTRTPS_DEFAULT_PROFILES_FILE": str(profile)} for pod in INSTANCES}


@contextmanager
def _stand(folder: Path) -> Iterator[_Stand]:
    from understudy.api import names

    token = folder / "token"
    token.write_bytes(TOKEN)
    with running("bench.mux", {"robot": {}, **_instances(folder)}) as roles:
        settings = {
            names.NAMESPACE_VARIABLE: "bench",
            names.WORKLOAD_VARIABLE: "w",
            names.OUTPUTS_VARIABLE: json.dumps([OUTPUT]),
            "UNDERSTUDY_TOKEN_FILE": str(token),
            "UNDERSTUDY_STATE": str(folder / "state"),
            "UNDERSTUDY_LOG_LEVEL": "ERROR",
        }
        mux = subprocess.Popen([sys.executable, "-m", "understudy.main", "mux"], env={**os.environ, **settings})
        try:
            yield _Stand(roles, mux)
        finally:
            mux.terminate()
            mux.wait(10)


def _floor(report: Report, folder: Path, seconds: float) -> None:
    """Measure what a relay costs that judges nothing."""
    from understudy.api.kinds.robot_workload import Output
    from understudy.ros.rmw import MIDDLEWARE

    settings = folder / "relay.xml"
    settings.write_text(MIDDLEWARE.mux_settings([Output.model_validate(OUTPUT)]))
    relay = {MIDDLEWARE.settings_variable: str(settings)}
    with running("bench.mux", {"robot": {}, **_instances(folder), RELAY: relay}) as roles:
        time.sleep(5.0)
        roles["robot"].ask("received")
        print(f"a relay in place of the mux, for {seconds:.0f} s", flush=True)
        kinds = ("", MIDDLEWARE_THREADS)
        begun, before = time.monotonic(), [roles[RELAY].cpu(kind) for kind in kinds]
        time.sleep(seconds)
        passed, after = time.monotonic() - begun, [roles[RELAY].cpu(kind) for kind in kinds]
        whole, middleware = ((end - start) / passed * 1000 for start, end in zip(before, after, strict=True))
        if not any(one[4] == MUXED for one in roles["robot"].ask("received")["received"]):
            raise SystemExit("the robot receives nothing by the relay")
    report.baseline(
        "processor time of a relay", [whole], unit="milli-CPU", of="takes and publishes, and judges nothing"
    )
    report.baseline(
        "its middleware's own threads", [middleware], unit="milli-CPU", of="receive and acknowledge, and run no Python"
    )


def _steady(report: Report, stand: _Stand, seconds: float) -> None:
    """Measure latency, cost and losses while one instance is forwarded."""
    time.sleep(3.0)
    stand.received()
    begun, before = time.monotonic(), stand.cpu()
    found: list[tuple[float, float, str, int, str]] = []
    while time.monotonic() - begun < seconds:
        time.sleep(min(5.0, seconds))
        found += stand.received()
        print(f"{time.monotonic() - begun:.0f} of {seconds:.0f} s: {len(found)} messages", flush=True)
    used, passed = stand.cpu() - before, time.monotonic() - begun
    mine = [one for one in found if one[2] == INSTANCES[0]]
    direct = {number: at for at, _, _, number, topic in mine if topic == DIRECT}
    muxed = [(at, number) for at, _, _, number, topic in mine if topic == MUXED]
    added = [(at - direct[number]) * 1000 for at, number in muxed if number in direct]
    numbers = [number for _, number in muxed]
    lost = numbers[-1] - numbers[0] + 1 - len(set(numbers))
    disordered = sum(later <= earlier for earlier, later in itertools.pairwise(numbers))
    report.figure("added latency", _thinned(added), unit="ms", must={"p50": 1.0})
    report.figure("added latency, p99", [quantile(added, 0.99)], unit="ms", must={"max": 3.0})
    latencies = [(at - sent) * 1000 for at, sent, _, _, topic in mine if topic == DIRECT]
    report.baseline("latency without a mux", _thinned(latencies), unit="ms", of="the same message on another topic")
    report.figure("processor time of the mux", [used / passed * 1000], unit="milli-CPU", must={"max": 10.0})
    report.figure("messages lost", [float(lost)], unit="messages", must={"max": 0.0})
    report.figure("messages out of order", [float(disordered)], unit="messages", must={"max": 0.0})
    report.note("steady", f"{len(muxed)} messages in {passed:.0f} s")


def _thinned(values: list[float]) -> list[float]:
    """Return at most a thousand of the values, evenly: the file of results has each of them."""
    return [round(value, 4) for value in values[:: max(1, len(values) // 1000)]]


def _orders(report: Report, stand: _Stand, switches: int) -> None:
    """Measure how long after an order the robot receives the first message of the other instance."""
    took: list[float] = []
    for number in range(1, switches + 1):
        pod = INSTANCES[number % 2]
        stand.received()
        at = stand.order(pod)
        time.sleep(0.3)
        first = min(when for when, _, by, _, topic in stand.received() if (by, topic) == (pod, MUXED))
        took.append((first - at) * 1000)
    limit = 10.0 + PERIOD * 1000
    report.figure("order to the first message", took, unit="ms", must={"p95": limit}, limit="10 ms and a period")


def _silences(report: Report, stand: _Stand, silences: int) -> None:
    """Measure how long the robot receives nothing if the instance that is forwarded is frozen and nobody gives an order."""
    gaps: list[float] = []
    for number in range(1, silences + 1):
        pod, other = INSTANCES[number % 2], INSTANCES[(number + 1) % 2]
        stand.order(pod, standing=True)
        time.sleep(0.7)
        stand.received()
        time.sleep(0.3)
        stand.roles[pod].signal(signal.SIGSTOP)
        time.sleep(0.5)
        found = [(when, by) for when, _, by, _, topic in stand.received() if topic == MUXED]
        stand.roles[pod].signal(signal.SIGCONT)
        last = max(when for when, by in found if by == pod)
        gaps.append((min(when for when, by in found if by == other) - last) * 1000)
        time.sleep(0.3)
    limit = (SILENCE + 0.015 + PERIOD) * 1000
    report.figure(
        "gap of a silent instance", gaps, unit="ms", must={"p95": limit}, limit="deadline, 15 ms and a period"
    )


def _crashes(report: Report, stand: _Stand, crashes: int) -> None:
    """Measure how long the robot receives nothing if the process that forwards crashes."""
    gaps: list[float] = []
    stand.until_driven(INSTANCES[0])
    for _ in range(crashes):
        time.sleep(STEADY + 1.0)
        stand.received()
        os.kill(stand.forwarder(), signal.SIGKILL)
        killed = time.monotonic()
        time.sleep(RESTARTS_WITHIN)
        found = [(when, by) for when, _, by, _, topic in stand.received() if topic == MUXED and when > killed + PERIOD]
        if not found:
            raise SystemExit(f"the robot receives nothing within {RESTARTS_WITHIN:g} s")
        gaps.append((found[0][0] - killed) * 1000)
        print(f"crash: {gaps[-1]:.0f} ms until {found[0][1]}", flush=True)
    report.figure("gap of a mux that crashed", gaps, unit="ms", must={"p95": 1000.0})


# -- roles ---------------------------------------------------------------------------------------------------------------


def _robot() -> None:
    """Receive both topics, and answer what arrived."""
    import rclpy
    from geometry_msgs.msg import TwistStamped
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node

    rclpy.init()
    node, lock = Node("robot"), threading.Lock()
    received: list[tuple[float, float, str, int, str]] = []

    def heard(topic: str, message: Any) -> None:
        twist = message.twist
        with lock:
            received.append((time.monotonic(), twist.linear.y, message.header.frame_id, int(twist.linear.x), topic))

    def taken() -> list[tuple[float, float, str, int, str]]:
        with lock:
            found = list(received)
            received.clear()
        return found

    for topic in (MUXED, DIRECT):
        node.create_subscription(TwistStamped, topic, lambda message, topic=topic: heard(topic, message), 10)
    answering({"received": lambda asked: {"received": taken()}})
    tell("ready")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.spin()


def _instance(pod: str) -> None:
    """Publish on both topics."""
    import rclpy
    from geometry_msgs.msg import TwistStamped
    from rclpy.node import Node

    rclpy.init()
    node = Node(pod.replace("-", "_"))
    publishers = [node.create_publisher(TwistStamped, topic, 10) for topic in (MUXED, DIRECT)]
    answering({})
    tell("ready")
    message, due = TwistStamped(), time.monotonic()
    message.header.frame_id = pod
    for number in itertools.count(1):
        message.twist.linear.x, message.twist.linear.y = float(number), time.monotonic()
        for publisher in publishers:
            publisher.publish(message)
        due = max(due + PERIOD, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))


def _relay() -> None:
    """Forward the first writer that is heard."""
    from understudy.ros.actions.forwarded_topic import ForwardedTopic
    from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
    from understudy.ros.runtime.graph_node import Graph
    from understudy.ros.runtime.sample_taking import SampleTaker

    wakeups, first = ArrivalWakeups(), list[bytes]()
    topic = ForwardedTopic(Graph(RELAY), MUXED, TYPE, SampleTaker(), wakeups)
    os.set_blocking(wakeups.descriptor, True)
    answering({})
    tell("ready")

    def forwards(writer: bytes) -> bool:
        if not first:
            first.append(writer)
        return writer == first[0]

    while True:
        os.eventfd_read(wakeups.descriptor)
        topic.drain(forwards)


if __name__ == "__main__":
    sys.exit(main())

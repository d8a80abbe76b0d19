"""What the monitor costs, and how late it notices: beside a plain rclpy callback monitor in the same run.

    scripts/bench monitor [--seconds 20] [--rounds 3] [--failures 50]

One process publishes 5 topics at 50 Hz. Others watch them at the same time, with the same health tree: no topic
silent for 500 ms, none below 10 Hz over 2 s.

- ours: the monitor's own view of the robot (understudy.monitor.sight) in the monitor's process with all that it
  imports, woken at its ticks and deadlines; two of the topics are gated, so they have ports of their own.
- keeping: the same, which also keeps the state of two of the topics, persists it and tells of it
  (understudy.monitor.keeping, without an API server).
- callbacks: an rclpy node with a callback per message and a timer of 50 ms that looks at the times, as one writes it.

Cost is CPU time over all threads by the kernel's account, and resident memory. Lateness is how long after the
configured timeout, counted from the receipt of the last message, a frozen publisher (SIGSTOP) is noticed.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import random
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

from results import Report

TOPICS = [f"/bench/t{i}" for i in range(5)]
GATED = TOPICS[:2]
KEPT = TOPICS[3:]
TYPE = "std_msgs/msg/String"
HERTZ = 50.0
SIZE = 200
GAP = 0.5
LEAST_RATE, WINDOW = 10.0, 2.0  # low enough that a frozen publisher is noticed by the gap first
DOMAIN = "97"

PROCESSES: dict[str, dict[str, str]] = {"publishers": {}, "ours": {}, "keeping": {}, "callbacks": {}}
"""The processes of a run, with what each has in its environment beside what all share."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a round")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--failures", type=int, default=50)
    parser.add_argument("--role", choices=list(ROLES), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role:
        ROLES[options.role]()
        return
    report = Report("monitor")
    with tempfile.TemporaryDirectory() as folder:
        _prepare(Path(folder))
        _cost(report, options.rounds, options.seconds)
        _lateness(report, options.failures)
    report.note("load", f"{len(TOPICS)} topics x {HERTZ:g} Hz, {SIZE} bytes, {len(GATED)} of them gated, UDPv4 only")
    report.note("state", f"{len(KEPT)} of the topics kept, at most every 200 ms, persisted every second")
    report.note("tree", f"gap {GAP * 1000:g} ms and rate > {LEAST_RATE:g} Hz over {WINDOW:g} s on each topic")
    print(report.table())
    print(report.write())
    sys.exit(0 if report.held else 1)


# -- measuring ---------------------------------------------------------------------------------------------------------


def _prepare(folder: Path) -> None:
    """Set the environment that all processes share, and write the profiles that ours has on top."""
    from understudy.api.workloads import Output  # here, so that it isn't in the baseline's memory
    from understudy.ros.profiles import profiles_xml

    profiles = folder / "profiles.xml"
    profiles.write_text(profiles_xml(Output(topic=topic, type=TYPE) for topic in GATED))
    PROCESSES["ours"]["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profiles)
    for name in ("ROS_DISCOVERY_SERVER", "ROS_STATIC_PEERS", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        os.environ.pop(name, None)
    os.environ["RMW_IMPLEMENTATION"] = "rmw_fastrtps_cpp"
    os.environ["ROS_DOMAIN_ID"] = DOMAIN
    os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"  # as between pods, which share no memory


class Role:
    """One process of the run."""

    def __init__(self, name: str, **environment: str) -> None:
        self.name = name
        self._process = subprocess.Popen(
            [sys.executable, "-m", "bench.monitor", "--role", name],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **environment},
        )
        self.line(60)

    @property
    def pid(self) -> int:
        return self._process.pid

    def line(self, timeout: float) -> str:
        """The next line that it writes."""
        assert self._process.stdout is not None
        readable, _, _ = select.select([self._process.stdout], [], [], timeout)
        line = self._process.stdout.readline().strip() if readable else ""
        if not line:
            raise SystemExit(f"{self.name} said nothing for {timeout:g} s")
        return line

    def cpu(self) -> float:
        """CPU seconds so far of all threads that run (none ends while we measure)."""
        tasks = Path(f"/proc/{self.pid}/task")
        return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks.iterdir()) * 1e-9

    def rss(self) -> float:
        """Resident memory in MB."""
        status = Path(f"/proc/{self.pid}/status").read_text()
        return int(status.split("VmRSS:")[1].split()[0]) * 1024 / 1e6

    def received(self) -> int:
        """How many messages a watcher has received so far."""
        self.signal(signal.SIGUSR1)
        return int(json.loads(self.line(10))["received"])

    def signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def end(self) -> None:
        self._process.kill()
        self._process.wait()


@contextlib.contextmanager
def _watched() -> Iterator[tuple[Role, list[Role]]]:
    """The publishers, and both ways of watching once each receives all topics."""
    roles: list[Role] = []
    try:
        for name, environment in PROCESSES.items():
            roles.append(Role(name, **environment))
        publishers, *watchers = roles
        end = time.monotonic() + 30
        while True:
            before = [watcher.received() for watcher in watchers]
            time.sleep(1.0)
            if all(w.received() - n > 0.9 * len(TOPICS) * HERTZ for w, n in zip(watchers, before, strict=True)):
                break
            if time.monotonic() > end:
                raise SystemExit("the watchers don't receive all topics: is multicast possible here?")
        yield publishers, watchers
    finally:
        for role in roles:
            role.end()


def _cost(report: Report, rounds: int, length: float) -> None:
    found: dict[tuple[str, str], list[float]] = {}
    for number in range(rounds):
        with _watched() as (_, watchers):
            time.sleep(2.0)
            before = [(time.monotonic(), watcher.cpu(), watcher.received()) for watcher in watchers]
            time.sleep(length)
            for watcher, (begun, cpu, received) in zip(watchers, before, strict=True):
                passed = time.monotonic() - begun
                now = {
                    "CPU": 1000 * (watcher.cpu() - cpu) / passed,
                    "memory": watcher.rss(),
                    "received": (watcher.received() - received) / passed,
                }
                for name, value in now.items():
                    found.setdefault((name, watcher.name), []).append(value)
                shown = f"{now['CPU']:.1f} milli-CPU, {now['memory']:.1f} MB, {now['received']:.0f} messages/s"
                print(f"round {number + 1}/{rounds}: {watcher.name} {shown}", flush=True)
    bounds = {"CPU": {"max": 15.0}, "memory": {"max": 100.0}, "received": {}}
    units = {"CPU": "milli-CPU", "memory": "MB", "received": "messages/s"}
    for name, must in bounds.items():
        report.figure(name, found[name, "ours"], unit=units[name], must=must)
        report.figure(f"{name}, state kept", found[name, "keeping"], unit=units[name], must=must)
        report.baseline(name, found[name, "callbacks"], unit=units[name], of="rclpy callbacks, same run")


def _lateness(report: Report, failures: int) -> None:
    late: dict[str, list[float]] = {"ours": [], "keeping": [], "callbacks": []}
    chance = random.Random(1)
    with _watched() as (publishers, watchers):
        for number in range(failures):
            time.sleep(0.6 + 0.4 * chance.random())
            publishers.signal(signal.SIGSTOP)
            for watcher in watchers:
                seen = json.loads(watcher.line(10))
                late[watcher.name].append(1000 * (seen["detected"] - seen["last"] - GAP))
            publishers.signal(signal.SIGCONT)
            if (number + 1) % 10 == 0:
                print(f"failure {number + 1}/{failures}", flush=True)
    report.figure("noticed past the timeout", late["ours"], unit="ms", must={"p95": 15.0})
    report.figure("noticed past the timeout, state kept", late["keeping"], unit="ms", must={"p95": 15.0})
    report.baseline("noticed past the timeout", late["callbacks"], unit="ms", of="rclpy callbacks, same run")


# -- the processes of a run --------------------------------------------------------------------------------------------


def _publish() -> None:
    import rclpy
    from rclpy.node import Node
    from std_msgs.msg import String

    rclpy.init()
    node = Node("publishers")
    publishers = [node.create_publisher(String, topic, 10) for topic in TOPICS]
    message = String(data="x" * SIZE)
    print("ready", flush=True)
    due = time.monotonic()
    while True:
        for publisher in publishers:
            publisher.publish(message)
        due += 1 / HERTZ
        wait = due - time.monotonic()
        if wait < -0.1:  # after a stop it goes on from now, rather than catch up in a burst
            due, wait = due - wait, 0.0
        time.sleep(max(0.0, wait))


def _keeping() -> None:
    _ours(KEPT)


def _ours(kept: Sequence[str] = ()) -> None:
    import understudy.monitor.running  # noqa: F401  (what the monitor's process has in memory)
    from understudy.api.policies import FailurePolicySpec
    from understudy.api.workloads import RobotWorkloadSpec
    from understudy.mitigation.interfaces import Instance
    from understudy.mitigation.shelf import Shelf
    from understudy.monitor.keeping import StateKeeping
    from understudy.monitor.sight import Sight
    from understudy.monitor.supervising import SLOW, TICK, WAKE_LATE

    rate, window = f"> {LEAST_RATE:g} Hz", f"{WINDOW:g}s"
    leaves = [
        {"topic": {"name": topic, "type": TYPE, "gap": f"{GAP * 1000:g}ms", "rate": rate, "window": window}}
        for topic in TOPICS
    ]
    policy = FailurePolicySpec.model_validate(
        {
            "monitoring": {"yaml": {"parallel": leaves}},
            "strategies": [{"type": "Restart"}],
            "state": {"keep": [{"topic": topic} for topic in kept]},
        }
    )
    outputs = [{"topic": topic, "type": TYPE} for topic in GATED]
    spec = RobotWorkloadSpec.model_validate({"template": {}, "outputs": outputs, "failurePolicyRef": {"name": "bench"}})
    instances = [Instance("active", "1", ip="192.0.2.10"), Instance("standby", "2", ip="192.0.2.11")]
    sight = Sight()
    folder = tempfile.TemporaryDirectory()
    keeping = StateKeeping(sight.graph, Shelf(Path(folder.name)), _Nobody(), _Nobody())
    print("ready", flush=True)

    def count() -> None:
        records = [record for topic in TOPICS if (record := sight.observations.topic(topic))]
        print(json.dumps({"received": sum(record.count for record in records)}), flush=True)

    async def watch() -> None:
        asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, count)
        since, failed, slow = time.time(), False, 0.0
        while True:
            now = time.time()
            sight.follow(policy, spec)
            sight.drain(instances, "active")
            keeping.take(policy.state, sight.addresses, "active")
            verdict = sight.verdict(now=now, since=since)
            keeping.judge(verdict.state, now)
            if now >= slow:
                slow = now + SLOW
                keeping.housekeeping(instances[0], [])
            detected = time.time()
            if verdict.state == "Failed" and not failed:
                print(json.dumps({"detected": detected, "last": verdict.onset}), flush=True)
            failed = verdict.state == "Failed"
            due = sight.deadline(now=now, since=since)
            wake = now + TICK if due is None else min(now + TICK, due + WAKE_LATE)
            await asyncio.sleep(max(0.0, wake - time.time()))

    asyncio.run(watch())


class _Nobody:
    """Whom there is nothing to tell or to ask."""

    def condition(self, *said: str) -> bool:
        return False

    def keep(self, kept: object) -> None:
        pass


def _callbacks() -> None:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from std_msgs.msg import String

    rclpy.init()
    node = Node("callbacks")
    arrivals: dict[str, deque[float]] = {topic: deque() for topic in TOPICS}
    received, failed = 0, False

    def heard(topic: str) -> None:
        nonlocal received
        received += 1
        arrivals[topic].append(time.time())

    def look() -> None:
        nonlocal failed
        now = time.time()
        for times in arrivals.values():
            while times and len(times) > 1 and times[0] < now - WINDOW:
                times.popleft()
        silent = [times[-1] for times in arrivals.values() if times and now - times[-1] >= GAP]
        slow = [topic for topic, times in arrivals.items() if len(times) / WINDOW <= LEAST_RATE]
        if silent and not failed:
            print(json.dumps({"detected": time.time(), "last": min(silent), "slow": slow}), flush=True)
        failed = bool(silent)

    for topic in TOPICS:
        node.create_subscription(String, topic, lambda message, topic=topic: heard(topic), 10)
    node.create_timer(0.05, look)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    signal.signal(signal.SIGUSR1, lambda number, frame: print(json.dumps({"received": received}), flush=True))
    print("ready", flush=True)
    executor.spin()


ROLES = {"publishers": _publish, "ours": _ours, "keeping": _keeping, "callbacks": _callbacks}


if __name__ == "__main__":
    main()

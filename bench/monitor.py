"""Measures what the monitor costs and how late it notices failures, compared with a plain rclpy callback monitor in the
same run.

    scripts/bench monitor [--seconds 20] [--rounds 3] [--failures 50]

One process publishes 5 topics at 50 Hz. Three processes watch them at the same time, with the same health tree: no
topic silent for 500 ms, none below 10 Hz over 2 s.

- ours: the monitor's own view of the robot (understudy.monitor.observe.robot.health_observer) in the monitor's
  process with all that it imports, woken at its ticks and deadlines; two of the topics are gated, so they have ports
  of their own.
- keeping: the same, which also keeps the state of two of the topics, persists it and reports it
  (understudy.monitor.act.instances.state_manager, without an API server).
- callbacks: a usual rclpy node: one callback per message stores the time, and a timer of 50 ms checks the times.

Cost is CPU time over all threads by the kernel's account, and resident memory. Lateness is the time from the end of
the configured timeout, which starts when the last message is received, until a frozen publisher (SIGSTOP) is
noticed.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import signal
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from bench import cost
from bench.judge import judge
from bench.results import Report
from bench.roles import Role, await_messages, callbacks, end_with_parent, environment, gate_ports, running, tell

TOPICS = [f"/bench/t{i}" for i in range(5)]
GATED = TOPICS[:2]
KEPT = TOPICS[3:]
TYPE = "std_msgs/msg/String"
HERTZ = 50.0
SIZE = 200
GAP = 0.5
LEAST_RATE, WINDOW = 10.0, 2.0  # low enough that a frozen publisher is detected by the gap first
OUTPUTS = [{"topic": topic, "type": TYPE} for topic in GATED]

PROCESSES: dict[str, dict[str, str]] = {"publishers": {}, "ours": {}, "keeping": {}, "callbacks": {}}
"""The processes of a run, with their own environment variables in addition to the shared ones."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a round in seconds")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--failures", type=int, default=50)
    parser.add_argument("--role", choices=list(ROLES), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role:
        ROLES[options.role]()
        return
    report = Report("monitor")
    with tempfile.TemporaryDirectory() as folder:
        environment()
        PROCESSES["ours"] = gate_ports(Path(folder) / "profiles.xml", OUTPUTS)
        found = cost.measured(_watchers, options.rounds, options.seconds)
        cost.told(report, found, cpu=15.0, memory=100.0, baseline="rclpy callbacks, same run")
        _lateness(report, options.failures)
    report.note("load", f"{len(TOPICS)} topics x {HERTZ:g} Hz, {SIZE} bytes, {len(GATED)} of them gated, UDPv4 only")
    report.note("state", f"{len(KEPT)} of the topics kept, at most every 200 ms, persisted every second")
    report.note("tree", f"gap {GAP * 1000:g} ms and rate > {LEAST_RATE:g} Hz over {WINDOW:g} s on each topic")
    print(report.table())
    print(report.write())
    sys.exit(0 if report.held else 1)


# -- measuring ---------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _watched() -> Iterator[tuple[Role, list[Role]]]:
    """Yield the publisher and all watchers, once each watcher receives all topics."""
    with running("bench.monitor", PROCESSES) as roles:
        publishers, *watchers = roles.values()
        await_messages(watchers, len(TOPICS) * HERTZ)
        yield publishers, watchers


@contextlib.contextmanager
def _watchers() -> Iterator[Sequence[Role]]:
    with _watched() as (_, watchers):
        yield watchers


def _lateness(report: Report, failures: int) -> None:
    late: dict[str, list[float]] = {"ours": [], "keeping": [], "callbacks": []}
    chance = random.Random(1)
    with _watched() as (publishers, watchers):
        for number in range(failures):
            time.sleep(0.6 + 0.4 * chance.random())
            for watcher in watchers:
                watcher.told_so_far()
            publishers.signal(signal.SIGSTOP)
            for watcher in watchers:
                while (seen := watcher.told(10))["told"] != "failed":
                    pass
                late[watcher.name].append(1000 * (seen["detected"] - seen["onset"] - GAP))
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

    end_with_parent()
    rclpy.init()
    node = Node("publishers")
    publishers = [node.create_publisher(String, topic, 10) for topic in TOPICS]
    message = String(data="x" * SIZE)
    tell("ready")
    due = time.monotonic()
    while True:
        for publisher in publishers:
            publisher.publish(message)
        due += 1 / HERTZ
        wait = due - time.monotonic()
        if wait < -0.1:  # after a stop it continues from now, instead of sending a burst
            due, wait = due - wait, 0.0
        time.sleep(max(0.0, wait))


def _keeping() -> None:
    _ours(KEPT)


def _ours(kept: Sequence[str] = ()) -> None:
    rate, window = f"> {LEAST_RATE:g} Hz", f"{WINDOW:g}s"
    leaves = [
        {"topic": {"name": topic, "type": TYPE, "gap": f"{GAP * 1000:g}ms", "rate": rate, "window": window}}
        for topic in TOPICS
    ]
    judge({"yaml": {"parallel": leaves}}, TOPICS, outputs=OUTPUTS, kept=kept)


def _callbacks() -> None:
    end_with_parent()
    failed = False

    def look(arrivals: Mapping[str, deque[float]], now: float) -> None:
        nonlocal failed
        for times in arrivals.values():
            while times and len(times) > 1 and times[0] < now - WINDOW:
                times.popleft()
        silent = [times[-1] for times in arrivals.values() if times and now - times[-1] >= GAP]
        slow = [topic for topic, times in arrivals.items() if len(times) / WINDOW <= LEAST_RATE]
        if silent and not failed:
            tell("failed", detected=time.time(), onset=min(silent), slow=slow)
        failed = bool(silent)

    callbacks(dict.fromkeys(TOPICS, TYPE), look, every=0.05)


ROLES = {"publishers": _publish, "ours": _ours, "keeping": _keeping, "callbacks": _callbacks}


if __name__ == "__main__":
    main()

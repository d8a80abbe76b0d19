"""Starts, queries and ends the processes of a bench that publish and watch.

A process writes one line of JSON for each of its own reports (these have ``told``), and one for each answer to a line
of input.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

DOMAIN = "97"

Answers = Mapping[str, Callable[[dict[str, Any]], Mapping[str, Any]]]
"""Functions that answer questions, by the ``ask`` of a question."""


def environment() -> None:
    """Set what all processes share: their own domain, and no shared memory, as between pods."""
    for name in ("ROS_DISCOVERY_SERVER", "ROS_STATIC_PEERS", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        os.environ.pop(name, None)
    os.environ["RMW_IMPLEMENTATION"] = "rmw_fastrtps_cpp"
    os.environ["ROS_DOMAIN_ID"] = DOMAIN
    os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"


def gate_ports(file: Path, outputs: Iterable[Mapping[str, str]]) -> dict[str, str]:
    """Return the environment of a process whose readers of gated outputs have their own ports, as in the monitor."""
    from understudy.api.kinds.robot_workload import Output  # here, so that the module is not in the baseline's memory
    from understudy.ros.dds.profiles import profiles_xml

    file.write_text(profiles_xml(Output(topic=output["topic"], type=output["type"]) for output in outputs))
    return {"FASTRTPS_DEFAULT_PROFILES_FILE": str(file)}


def cpu_seconds(pid: int, threads: str = "") -> float:
    """Return the CPU seconds of the running threads of a process so far: of those whose name begins so. None ends during a measurement."""
    tasks = [task for task in Path(f"/proc/{pid}/task").iterdir() if (task / "comm").read_text().startswith(threads)]
    return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) * 1e-9


# -- from outside ------------------------------------------------------------------------------------------------------


class Role:
    """One process of the run."""

    def __init__(self, module: str, name: str, **environment: str) -> None:
        """Start the process: ``module`` is run with ``--role`` and the name."""
        self.name = name
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, "--role", name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **environment},
        )
        self._told: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self._answers: queue.Queue[dict[str, Any] | None] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    @property
    def pid(self) -> int:
        return self._process.pid

    def told(self, timeout: float) -> dict[str, Any]:
        """Return the next report of the process."""
        return self._next(self._told, timeout)

    def told_so_far(self) -> list[dict[str, Any]]:
        """Return the reports since the last call."""
        found = []
        with contextlib.suppress(queue.Empty):
            while (told := self._told.get_nowait()) is not None:
                found.append(told)
            raise SystemExit(f"{self.name} has ended")
        return found

    def ask(self, what: str, **more: Any) -> dict[str, Any]:
        """Ask a question, and return the answer."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"ask": what, **more}) + "\n")
        self._process.stdin.flush()
        return self._next(self._answers, 20)

    def cpu(self, threads: str = "") -> float:
        """Return its CPU seconds so far, of the threads whose name begins so."""
        return cpu_seconds(self.pid, threads)

    def rss(self) -> float:
        """Return the resident memory in MB."""
        status = Path(f"/proc/{self.pid}/status").read_text()
        return int(status.split("VmRSS:")[1].split()[0]) * 1024 / 1e6

    def signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def end(self) -> None:
        self._process.kill()
        self._process.wait()

    def _next(self, said: queue.Queue[dict[str, Any] | None], timeout: float) -> dict[str, Any]:
        try:
            found = said.get(timeout=timeout)
        except queue.Empty:
            raise SystemExit(f"{self.name} said nothing for {timeout:g} s") from None
        if found is None:
            raise SystemExit(f"{self.name} has ended")
        return found

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                found = json.loads(line)
                (self._told if "told" in found else self._answers).put(found)
            else:  # a line of the middleware itself
                print(f"{self.name}: {line}", end="", file=sys.stderr)
        self._told.put(None)
        self._answers.put(None)


@contextlib.contextmanager
def running(module: str, roles: Mapping[str, Mapping[str, str]]) -> Iterator[dict[str, Role]]:
    """Yield processes by name, once they are ready, each with its own variables in addition to the shared environment."""
    started: dict[str, Role] = {}
    try:
        for name, environment in roles.items():
            started[name] = Role(module, name, **environment)
        for role in started.values():
            while role.told(120)["told"] != "ready":
                pass
        yield started
    finally:
        for role in started.values():
            role.end()


def await_messages(watchers: Sequence[Role], rate: float) -> None:
    """Wait until each watcher receives nearly this many messages per second."""
    end = time.monotonic() + 60
    while True:
        before = [watcher.ask("received")["received"] for watcher in watchers]
        begun = time.monotonic()
        time.sleep(1.0)
        passed = time.monotonic() - begun
        now = [watcher.ask("received")["received"] for watcher in watchers]
        if all((n - b) / passed > 0.9 * rate for n, b in zip(now, before, strict=True)):
            return
        if time.monotonic() > end:
            found = ", ".join(
                f"{watcher.name} {(n - b) / passed:.0f}" for watcher, n, b in zip(watchers, now, before, strict=True)
            )
            raise SystemExit(
                f"the watchers don't receive all topics: of {rate:g} messages/s: {found}; is multicast possible here?"
            )


# -- from inside -------------------------------------------------------------------------------------------------------


def end_with_parent() -> None:
    """Let the kernel end this process when its parent ends for any reason (prctl(2))."""
    set_death_signal = 1
    ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)


def tell(what: str, **more: Any) -> None:
    """Write a report."""
    say({"told": what, **more})


def say(found: Mapping[str, Any]) -> None:
    """Write one line at once, from any thread."""
    sys.stdout.write(json.dumps(found) + "\n")
    sys.stdout.flush()


def answer(line: str, answers: Answers) -> None:
    """Answer one line. At the end of the input, exit, because the parent is gone."""
    if not line:
        os._exit(0)
    asked = json.loads(line)
    say(answers[asked["ask"]](asked))


def answering(answers: Answers) -> None:
    """Answer in a thread of its own until the input ends."""

    def run() -> None:
        while True:
            answer(sys.stdin.readline(), answers)

    threading.Thread(target=run, daemon=True).start()


def callbacks(
    types: Mapping[str, str],
    look: Callable[[Mapping[str, deque[float]], float], None],
    *,
    every: float,
    most: int | None = None,
    raw: bool = False,
) -> None:
    """Watch topics in the usual way: a callback for each message, and a timer that checks the times.

    ``look`` receives the last ``most`` times of receipt by topic, and the current time; it is called every ``every``
    seconds. With ``raw``, messages are not decoded, and the subscription is best effort, as for ``ros2 topic hz``.
    """
    # Nothing of the product is imported, because it keeps parts of ROS out of memory.
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data

    rclpy.init()
    node = Node("callbacks")
    times: dict[str, deque[float]] = {topic: deque(maxlen=most) for topic in types}
    received = 0

    def heard(topic: str) -> None:
        nonlocal received
        received += 1
        times[topic].append(time.time())

    for topic, type_ in types.items():
        package, _, name = type_.split("/")
        node.create_subscription(
            getattr(importlib.import_module(f"{package}.msg"), name),
            topic,
            lambda message, topic=topic: heard(topic),
            qos_profile_sensor_data if raw else 10,
            raw=raw,
        )
    node.create_timer(every, lambda: look(times, time.time()))
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    answering({"received": lambda asked: {"received": received}})
    tell("ready")
    executor.spin()

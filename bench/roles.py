"""The processes of a bench that publish and watch: started, asked and ended here.

A process writes a line of JSON for each thing that it tells by itself (these have ``told``), and one for each answer to
a line that it is asked by.
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
"""What answers a question, by its ``ask``."""


def environment() -> None:
    """Set what all processes share: a domain of their own, and no shared memory, as between pods."""
    for name in ("ROS_DISCOVERY_SERVER", "ROS_STATIC_PEERS", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        os.environ.pop(name, None)
    os.environ["RMW_IMPLEMENTATION"] = "rmw_fastrtps_cpp"
    os.environ["ROS_DOMAIN_ID"] = DOMAIN
    os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"


def gate_ports(file: Path, outputs: Iterable[Mapping[str, str]]) -> dict[str, str]:
    """The environment of a process whose readers of gated outputs have ports of their own, as in the monitor."""
    from understudy.api.kinds.robot_workload import Output  # here, so that it isn't in the baseline's memory
    from understudy.ros.dds.profiles import profiles_xml

    file.write_text(profiles_xml(Output(topic=output["topic"], type=output["type"]) for output in outputs))
    return {"FASTRTPS_DEFAULT_PROFILES_FILE": str(file)}


# -- from outside ------------------------------------------------------------------------------------------------------


class Role:
    """One process of the run."""

    def __init__(self, module: str, name: str, **environment: str) -> None:
        """Start it: ``module`` is run with ``--role`` and the name."""
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
        """The next thing that it tells by itself."""
        return self._next(self._told, timeout)

    def told_so_far(self) -> list[dict[str, Any]]:
        """What it has told by itself since it was listened to last."""
        found = []
        with contextlib.suppress(queue.Empty):
            while (told := self._told.get_nowait()) is not None:
                found.append(told)
            raise SystemExit(f"{self.name} has ended")
        return found

    def ask(self, what: str, **more: Any) -> dict[str, Any]:
        """Its answer."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"ask": what, **more}) + "\n")
        self._process.stdin.flush()
        return self._next(self._answers, 20)

    def cpu(self) -> float:
        """CPU seconds so far of all threads that run (none ends while we measure)."""
        tasks = Path(f"/proc/{self.pid}/task")
        return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks.iterdir()) * 1e-9

    def rss(self) -> float:
        """Resident memory in MB."""
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
            else:  # the middleware's own
                print(f"{self.name}: {line}", end="", file=sys.stderr)
        self._told.put(None)
        self._answers.put(None)


@contextlib.contextmanager
def running(module: str, roles: Mapping[str, Mapping[str, str]]) -> Iterator[dict[str, Role]]:
    """Processes by name, once they are ready, each with what it has in its environment beside what all share."""
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
    """Wait until each watcher receives so many messages a second, nearly."""
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
    """Have the kernel end this process when the one that started it does, however that ends (prctl(2))."""
    set_death_signal = 1
    ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)


def tell(what: str, **more: Any) -> None:
    """Tell by oneself."""
    say({"told": what, **more})


def say(found: Mapping[str, Any]) -> None:
    """Write one line, in one piece whichever thread does."""
    sys.stdout.write(json.dumps(found) + "\n")
    sys.stdout.flush()


def answer(line: str, answers: Answers) -> None:
    """Answer one line; without one, he who asks is gone."""
    if not line:
        os._exit(0)
    asked = json.loads(line)
    say(answers[asked["ask"]](asked))


def answering(answers: Answers) -> None:
    """Answer in a thread of its own, for as long as somebody asks."""

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
    """Watch topics as one writes it: a callback for each message, and a timer that looks at the times.

    ``look`` is given the times of receipt by topic, of which ``most`` are kept, and the present; it looks every ``every``
    seconds. With ``raw`` messages aren't decoded, and best effort is enough, as for ``ros2 topic hz``.
    """
    # Nothing of the product, which keeps some of ROS out of memory.
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

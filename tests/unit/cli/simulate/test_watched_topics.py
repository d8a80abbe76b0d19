"""The command beside a real ROS graph, in a process of its own: what it sees, prints and leaves alone."""

from __future__ import annotations

import os
import pty
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from tests.support.bag_recording import policy
from understudy.cli.simulate.watch import main

pytestmark = pytest.mark.ros

LONG = 30.0
"""Seconds that are waited for anything."""


class Publishing:
    """Publishes on a topic, 20 times a second, until it is stopped."""

    def __init__(self, graph: Any, topic: str) -> None:
        from std_msgs.msg import String

        self._publisher, self._message = graph.node.create_publisher(String, topic, 10), String(data="here")
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(0.05):
            self._publisher.publish(self._message)

    def end(self) -> None:
        self._ended.set()
        self._thread.join()


def environment() -> dict[str, str]:
    """For processes that find the same packages."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}


class Command:
    """``understudy watch`` in a process of its own."""

    def __init__(self, folder: Path, tree: str, *arguments: str, out: int = subprocess.PIPE, **of: str) -> None:
        (folder / "policy.yaml").write_text(policy(tree, **of))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "understudy", "watch", "policy.yaml", *arguments],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.PIPE,
            text=True,
            env=environment(),
        )
        self._lines: queue.Queue[str] = queue.Queue()
        self.printed: list[str] = []
        if self.process.stdout is not None:
            threading.Thread(target=self._read, args=(self.process.stdout,), daemon=True).start()

    def _read(self, pipe: Any) -> None:
        for line in pipe:
            self._lines.put(line.rstrip("\n"))

    def until(self, words: str) -> str:
        """The first line from now on that has these words in it."""
        end = time.monotonic() + LONG
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, end - time.monotonic()))
            except queue.Empty:
                raise AssertionError(f"{words!r} was not told within {LONG} s, but {self.printed}") from None
            self.printed.append(line)
            if words in line:
                return line

    def ended(self, sent: signal.Signals | None = None) -> tuple[int, str]:
        """Its exit status, and what it said of how it ended."""
        if sent is not None:
            self.process.send_signal(sent)
        assert self.process.stderr is not None
        errors = self.process.stderr.read()
        return self.process.wait(LONG), errors


@pytest.fixture
def publish(graph: Any) -> Iterator[Callable[[str], Publishing]]:
    made: list[Publishing] = []

    def start(topic: str) -> Publishing:
        made.append(Publishing(graph, topic))
        return made[-1]

    yield start
    for publishing in made:
        publishing.end()


@pytest.fixture
def watch(graph: Any, tmp_path: Path) -> Iterator[Callable[..., Command]]:
    commands: list[Command] = []

    def start(*arguments: Any, **options: Any) -> Command:
        commands.append(Command(tmp_path, *arguments, **options))
        return commands[-1]

    yield start
    for command in commands:
        command.process.kill()
        command.process.wait()


def test_the_start_and_end_of_a_silence_are_reported(
    publish: Callable[[str], Publishing], watch: Callable[..., Command]
) -> None:
    first = publish("/chat")
    command = watch("{topic: {name: /chat, gap: 3s}}")
    command.until("the tree is healthy")
    first.end()
    assert command.until("DETECTED").endswith(" DETECTED chat: no /chat for 3 s")
    publish("/chat")
    command.until("the tree is healthy")
    status, errors = command.ended(signal.SIGINT)
    assert status == 1
    assert re.fullmatch(r"understudy watch: failure: \S+Z chat: no /chat for 3 s\n", errors)
    assert all(re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z ", line) for line in command.printed)


def test_a_run_without_failures_ends_with_status_0(
    publish: Callable[[str], Publishing], watch: Callable[..., Command]
) -> None:
    publish("/chat")
    command = watch("{topic: {name: /chat, gap: 20s}}")
    command.until("chat is healthy")
    status, errors = command.ended(signal.SIGTERM)
    assert (status, errors) == (0, "understudy watch: no failure was detected\n")


def test_the_command_ends_after_its_time_and_reports_topics_that_never_arrived(watch: Callable[..., Command]) -> None:
    status, errors = watch("{topic: {name: /never, type: std_msgs/msg/String, gap: 1s}}", "--for", "300ms").ended()
    assert status == 0
    assert_golden("simulate", errors, "/never", "30 s")


def test_the_grace_option_replaces_the_grace_time_of_the_policy(watch: Callable[..., Command]) -> None:
    command = watch("{topic: {name: /never, type: std_msgs/msg/String, gap: 1s}}", "--grace", "200ms")
    command.until("DETECTED never: no /never within 200 ms of the start")
    assert command.ended(signal.SIGINT)[0] == 1


def test_unwatched_topics_are_reported_with_the_reason(watch: Callable[..., Command]) -> None:
    tree = "{parallel: [{topic: {name: /a, gap: 1s}}, {topic: {name: /b, type: acme_msgs/msg/Arm, gap: 1s}}]}"
    command = watch(tree)
    command.until("/b: acme_msgs/msg/Arm is not installed")
    command.until("the type of /a is not known, since nobody publishes it yet")
    assert command.ended(signal.SIGINT)[0] == 0


def test_leaves_that_need_the_cluster_are_left_out_and_reported(
    publish: Callable[[str], Publishing], watch: Callable[..., Command]
) -> None:
    publish("/chat")
    command = watch("{parallel: [{topic: {name: /chat, gap: 20s}}, {pod: {condition: Ready}}]}")
    command.until("pod.Ready needs the cluster, which this command does not use: not evaluated")
    command.until("the tree is healthy")
    assert command.ended(signal.SIGINT)[0] == 0


def test_a_tree_of_cluster_leaves_only_is_refused(watch: Callable[..., Command]) -> None:
    status, errors = watch("{pod: {restarts: 2, window: 10m}}").ended()
    assert status == 2
    assert_golden("simulate", errors, "pod.restarts")


def test_watching_only_subscribes_and_never_publishes(
    graph: Any, publish: Callable[[str], Publishing], watch: Callable[..., Command]
) -> None:
    publish("/chat")
    command = watch("{parallel: [{topic: {name: /chat, gap: 20s}}, {publisher: {topic: /chat, node: /application}}]}")
    command.until("the tree is healthy")
    name = f"understudy_watch_{command.process.pid}"
    received: list[Any] = []
    end = time.monotonic() + LONG
    while not received and time.monotonic() < end:
        received = [one for one in graph.subscribers("/chat") if one.node == f"/{name}"]
        time.sleep(0.02)
    assert len(received) == 1
    own = graph.node.get_publisher_names_and_types_by_node(name, "/")
    assert {topic for topic, _ in own} <= {"/parameter_events"}
    assert graph.node.get_service_names_and_types_by_node(name, "/") == []
    assert graph.node.get_client_names_and_types_by_node(name, "/") == []
    assert command.ended(signal.SIGINT)[0] == 0


def test_a_terminal_shows_the_whole_tree_and_is_restored_at_the_end(
    publish: Callable[[str], Publishing], watch: Callable[..., Command]
) -> None:
    publish("/chat")
    ours, theirs = pty.openpty()
    tree = "{name: all, parallel: [{topic: {name: /chat, gap: 20s}}, {topic: {name: /never, type: std_msgs/msg/String, gap: 1s}}]}"
    command = watch(tree, out=theirs)
    os.close(theirs)
    found, end = "", time.monotonic() + LONG
    while not re.search(r"all/chat +\S*healthy +\S* *[\d.]+ Hz", found):
        assert time.monotonic() < end, found
        found += os.read(ours, 65536).decode()
    assert "tried in ROS domain " in found
    assert re.search(r"all \(parallel\) +\S*starting", found)
    assert "waiting for the first /never" in found
    command.process.send_signal(signal.SIGINT)
    rest = ""
    try:
        while part := os.read(ours, 65536):
            rest += part.decode()
    except OSError:  # how Linux says that the other end is closed
        pass
    os.close(ours)
    assert command.ended()[0] == 0
    assert (found + rest).startswith("\x1b[?1049h\x1b[?25l")
    assert (found + rest).endswith("\x1b[?25h\x1b[?1049l")


def test_unusable_input_ends_with_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "none.yaml")]) == 2
    assert_golden("simulate", capsys.readouterr().err.replace(str(tmp_path), ""), "none.yaml", "FailurePolicy")
    with pytest.raises(SystemExit) as ended:
        main(["policy.yaml", "--for", "30"])
    assert ended.value.code == 2
    assert_golden("simulate", capsys.readouterr().err.splitlines()[-1], "'30'")


def test_without_ros_the_missing_extra_is_reported(tmp_path: Path) -> None:
    (tmp_path / "policy.yaml").write_text(policy("{topic: {name: /chat, gap: 1s}}"))
    program = (
        "import sys; sys.modules['rclpy'] = None; sys.argv = ['understudy', 'watch', 'policy.yaml'];"
        "from understudy.main import main; sys.exit(main())"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2, done.stderr
    assert "pip install '.[ros]'" in done.stderr

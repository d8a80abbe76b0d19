"""The processes of the demo on the loopback interface: a robot, two instances, a mux and a monitor, in a ROS domain of their own."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import random
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from understudy.api import names
from understudy.api.kinds.robot_workload import Gate, Output
from understudy.cli.common.errors import CommandError
from understudy.cli.local_demo.journals import JournalReader
from understudy.cli.local_demo.record import MonitorRecord, RobotRecord
from understudy.cli.local_demo.robot import COMMANDS, NAMESPACE, TYPE, WORKLOAD
from understudy.ros.rmw import MIDDLEWARE

INSTANCES = ("instance-1", "instance-2")

ADDRESS = "127.0.0.1"

DOMAINS = range(1, 101)
"""ROS domains whose ports are below those that Linux gives to other programs."""

ENDS_WITHIN = 3.0
"""Seconds that the processes have to end by themselves."""

_OF_GRAPH = ("ROS_", "RMW_", "FASTDDS_", "FASTRTPS_")
"""What the names of variables begin with that would change the ROS graph of the demo."""

_KEPT = ("ROS_DISTRO", "ROS_VERSION", "ROS_PYTHON_VERSION")

_PACKAGES = Path(__file__).parents[3]
"""Where Python finds this package, also from another folder."""

_GATE = Gate(kind="Mux")
_OUTPUTS = (Output(topic=COMMANDS, type=TYPE),)


class Stand:
    """The running processes, and what their journals say."""

    def __init__(self, folder: Path, processes: Mapping[str, subprocess.Popen[bytes]]) -> None:
        self.robot, self.monitor = RobotRecord(), MonitorRecord()
        self.frozen: set[str] = set()
        """The instances that were frozen and not woken up yet."""
        self._folder, self._processes = folder, processes
        self._of_robot, self._of_monitor = (JournalReader(folder / f"{name}.jsonl") for name in ("robot", "monitor"))

    def update(self) -> None:
        """Read the journals. Raises CommandError if a process has ended."""
        self.robot.add(self._of_robot.read())
        self.monitor.add(self._of_monitor.read())
        for name, process in self._processes.items():
            if (code := process.poll()) is not None:
                raise CommandError(f"the process {name} has ended with status {code}{self._said(name)}")

    def freeze(self, name: str) -> float:
        """Stop a process without ending it (SIGSTOP). Returns when, in seconds of the monotonic clock."""
        self._processes[name].send_signal(signal.SIGSTOP)
        self.frozen.add(name)
        return time.monotonic()

    def wake(self, name: str) -> float:
        """Let a frozen process continue (SIGCONT). Returns when, in seconds of the monotonic clock."""
        self._processes[name].send_signal(signal.SIGCONT)
        self.frozen.discard(name)
        return time.monotonic()

    def output(self) -> str:
        """Return the last lines that each process has printed, as text for users."""
        return "".join(self._said(name) for name in self._processes)

    def _said(self, name: str) -> str:
        lines = _log(self._folder, name).read_text(errors="replace").splitlines()[-8:]
        return "".join(f"\n{name}: {line}" for line in lines)


@contextlib.contextmanager
def running(gap: float) -> Iterator[Stand]:
    """Start all processes, and end them with the context. ``gap`` is the silence in seconds that counts as a failure."""
    with tempfile.TemporaryDirectory(prefix="understudy-try-") as place, contextlib.ExitStack() as stack:
        folder = Path(place)
        shared = _environment(folder)
        token, instance, monitor = folder / "token", folder / "instance.xml", folder / "monitor.xml"
        token.write_text(secrets.token_hex())
        instance.write_text(MIDDLEWARE.instance_settings((), _OUTPUTS, _GATE))
        monitor.write_text(MIDDLEWARE.monitor_settings(_OUTPUTS, _GATE))
        settings = MIDDLEWARE.settings_variable
        of_instances = {name: {names.POD_VARIABLE: name, settings: str(instance)} for name in INSTANCES}
        of_mux = {
            names.NAMESPACE_VARIABLE: NAMESPACE,
            names.WORKLOAD_VARIABLE: WORKLOAD,
            names.OUTPUTS_VARIABLE: json.dumps([output.model_dump(exclude_none=True) for output in _OUTPUTS]),
            names.MUX_TOKEN_VARIABLE: str(token),
            names.MUX_STATE_VARIABLE: str(folder / "mux"),
        }
        processes: dict[str, subprocess.Popen[bytes]] = {}
        stack.callback(_end, processes)

        def start(name: str, command: list[str], more: Mapping[str, str] | None = None) -> None:
            processes[name] = start_process(folder, name, command, {**shared, **(more or {})})

        start("robot", [f"{__package__}.robot", str(folder / "robot.jsonl")])
        start("mux", ["understudy.main", "mux"], of_mux)
        watched = [str(folder / "monitor.jsonl"), str(token), str(gap), *INSTANCES]
        start("monitor", [f"{__package__}.monitor", *watched], {settings: str(monitor)})
        for name, variables in of_instances.items():
            start(name, [f"{__package__}.application", name], variables)
        yield Stand(folder, processes)


def _environment(folder: Path) -> dict[str, str]:
    """Return what all processes share: their own ROS domain on the loopback interface, and no file in the user's home."""
    kept = {name: value for name, value in os.environ.items() if name in _KEPT or not name.startswith(_OF_GRAPH)}
    paths = [str(_PACKAGES), *(word for word in os.environ.get("PYTHONPATH", "").split(os.pathsep) if word)]
    return {
        **kept,
        **MIDDLEWARE.common,
        "PYTHONPATH": os.pathsep.join(map(os.path.abspath, paths)),
        "ROS_DOMAIN_ID": str(_free_domain()),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_HOME": str(folder),
        "ROS_LOG_DIR": str(folder / "log"),
        names.ADDRESS_VARIABLE: ADDRESS,
    }


def _free_domain() -> int:
    """Return a ROS domain in which no process of this machine is. Raises CommandError."""
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        first = 7400 + 250 * domain
        with contextlib.suppress(OSError), contextlib.ExitStack() as stack:
            for port in (first, first + 10):  # those of discovery, and of the first participant
                stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)).bind(("", port))
            return domain
    raise CommandError("no ROS domain from 1 to 100 is free on this machine: end ROS processes that you do not need")


def start_process(
    folder: Path, name: str, command: list[str], environment: Mapping[str, str]
) -> subprocess.Popen[bytes]:
    """Start a module of Python. What it prints goes to a file."""
    with _log(folder, name).open("wb") as log:
        return subprocess.Popen(
            [sys.executable, "-m", *command],
            # A file of the user's folder may change the middleware (DEFAULT_FASTDDS_PROFILES.xml), or hide a module of Python.
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            # Ctrl-C reaches the command alone, which ends the others.
            start_new_session=True,
            preexec_fn=_end_with_command,
        )


def _end(processes: Mapping[str, subprocess.Popen[bytes]]) -> None:
    """End all processes, also frozen ones."""
    for process in processes.values():
        process.terminate()
        process.send_signal(signal.SIGCONT)
    end = time.monotonic() + ENDS_WITHIN
    for process in processes.values():
        try:
            process.wait(max(0.0, end - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _end_with_command() -> None:
    """Have the kernel end this process if the command is killed (prctl(2))."""
    set_death_signal = 1
    ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)


def _log(folder: Path, name: str) -> Path:
    return folder / f"{name}.out"

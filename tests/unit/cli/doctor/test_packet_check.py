"""The doctor's packets, by its own program in two processes on this machine: a network that enforces nothing."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from understudy.api import names
from understudy.cli.common.cluster_access.kubectl_proxy import Answer
from understudy.cli.common.cluster_access.pod_session import Session
from understudy.cli.common.errors import CommandError
from understudy.cli.doctor import packet_check, pod_program
from understudy.cli.doctor.clock_check import of_session

UID = "0b5d9f5e-7c1e-4a8e-9f2b-5d2f3f6f9a10"


@contextlib.contextmanager
def talking(*_: object) -> Iterator[Session]:
    """The program, with nothing between it and whoever asks."""
    command = [sys.executable, "-c", Path(pod_program.__file__).read_text()]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=dict(os.environ)
    ) as running:
        yield Session("here", running)
        running.terminate()
        running.communicate()


class Here:
    """Two pods of this machine, under policies that nobody enforces."""

    talking = staticmethod(talking)

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.sender = {"metadata": {"uid": UID}, "spec": {"nodeName": "here"}}
        self.receiver = {"spec": {"nodeName": "here"}, "status": {"podIP": "127.0.0.1"}}

    def __getattr__(self, name: str) -> Any:
        def write() -> Answer:
            self.asked.append(name)
            return Answer({}, "", time.time(), time.time())

        return write


@pytest.fixture(autouse=True)
def ports(monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as two,
    ):
        one.bind(("127.0.0.1", 0))
        two.bind(("127.0.0.1", 0))
        monkeypatch.setattr(names, "PROBE_PORT", one.getsockname()[1])
        monkeypatch.setattr(packet_check, "OPEN_PORT", two.getsockname()[1])


def test_a_network_without_enforcement_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packet_check, "WITHIN", 1.0)
    pods, progress = Here(), list[str]()
    measured = packet_check.measure(pods, progress.append)  # type: ignore[arg-type]
    assert (measured.before, measured.established, measured.fresh, measured.others) == (True, None, True, True)
    assert pods.asked == ["fence"], "there is no use in opening a gate that doesn't close"
    assert [(one.level, one.check) for one in packet_check.judge(measured)] == [("FAIL", "gate")]
    assert progress == [
        "reading the clocks of their nodes",
        "sending packets without a gate",
        "sending packets to a closed gate",
    ]


def test_a_clock_difference_is_reported_with_its_uncertainty() -> None:
    with talking() as talk:
        clock = of_session(talk)
    assert abs(clock.ahead) <= clock.give < 1.0


def test_an_error_in_a_pod_is_reported() -> None:
    with talking() as talk:
        with pytest.raises(CommandError, match="pod here: ValueError: pod UID 'short' has 5 bytes"):
            talk.ask("send", uid="short", host="127.0.0.1", port=1, seconds=1.0)
        with pytest.raises(CommandError, match="AttributeError"):
            talk.ask("dance")
        assert talk.ask("clock") > 0, "it goes on"

"""Discovery servers that share the address of a Service, on two hosts: what an address leads to is moved as a Service does it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.network_namespaces import Network, network
from tests.unit.ros.processes import PACKAGE
from understudy.ros.dds.sole_server import PAUSE, QUIET, SUCCEEDS_EVERY

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root")

ADDRESSES = {"a": "10.64.0.2", "b": "10.64.0.3"}
SERVICE = "10.64.9.9"
RUNNING = """
import signal, sys, time

def report(*_):
    print("reports its end", flush=True)
    sys.exit()

signal.signal(signal.SIGTERM, report)
print("runs", flush=True)
time.sleep(60)
"""
QUESTIONS = """
import socket, sys, time

asking = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
asking.bind(("", 11812))
asking.setblocking(False)
answers, reports, end = 0, 0, time.monotonic() + 1
while time.monotonic() < end:
    try:
        asking.sendto(bytes(16), (sys.argv[1], 11812))
        if asking.recv(64).startswith(bytes(16)):
            answers += 1
        else:
            reports += 1
    except OSError:
        pass
print(answers, reports)
"""
"""Asks as fast as it can for a second, and prints the numbers of answers, and of reports to the predecessor of who is asked."""

WITHIN = 15.0


class Hosts:
    """Two hosts with a supervised server each, and the Service that leads to one of them."""

    def __init__(self, lan: Network, folder: Path) -> None:
        self._hosts = {name: lan.host(address) for name, address in ADDRESSES.items()}
        self._folder = folder
        self._started: dict[str, subprocess.Popen[bytes]] = {}
        self._leads_to = ""

    def lead_to(self, host: str) -> None:
        for name in self._hosts:
            if name == self._leads_to:
                self._inside(name, "ip", "addr", "del", f"{SERVICE}/16", "dev", "eth0")
        self._inside(host, "ip", "addr", "add", f"{SERVICE}/16", "dev", "eth0")
        self._leads_to = host
        for other in self._hosts.keys() - {host}:  # as long as nobody is asked, it still knows the former one
            self._inside(other, "ip", "neigh", "flush", "dev", "eth0")

    def lead_each_to_itself(self) -> None:
        """As on a node that was cut off, and that has not received what the Service leads to since."""
        (other,) = self._hosts.keys() - {self._leads_to}
        self._inside(other, "ip", "addr", "add", f"{SERVICE}/16", "dev", "eth0")

    def lead_both_to_one(self) -> None:
        """As on that node some time after the network is back."""
        (other,) = self._hosts.keys() - {self._leads_to}
        self._inside(other, "ip", "addr", "del", f"{SERVICE}/16", "dev", "eth0")

    def begin_beside(self, host: str, other: str) -> None:
        """Note on the pod of a server beside which other one it began, as the operator does."""
        (self._folder / f"{host}-beside").write_text(f"uid-of-{other}/{ADDRESSES[other]}")

    def start(self, host: str, *, service: str = SERVICE) -> None:
        command = [
            sys.executable,
            "-m",
            "understudy.ros.dds.sole_server",
            service,
            "11812",
            str(self._folder / f"{host}-beside"),
            sys.executable,
            "-c",
            RUNNING,
        ]
        with (self._folder / host).open("wb") as log:
            self._started[host] = subprocess.Popen(
                [*self._hosts[host], *command],
                stdout=log,
                env={**os.environ, "PYTHONPATH": str(PACKAGE)},
            )

    def starts(self, host: str) -> int:
        """How often the server of a host has started."""
        return (self._folder / host).read_text().count("runs")

    def ends(self, host: str) -> int:
        """How often it was ended for another one."""
        return (self._folder / host).read_text().count("this one ends")

    def starts_again(self, host: str) -> int:
        """How often it was ended and started again, because another one ran beside it."""
        return (self._folder / host).read_text().count("starts again")

    def reports(self, host: str) -> int:
        """How often the server of a host reported its end to its participants."""
        return (self._folder / host).read_text().count("reports its end")

    def end(self, *hosts: str) -> None:
        for host in hosts or tuple(self._started):
            supervisor = self._started.pop(host)
            supervisor.terminate()
            assert supervisor.wait(10) == 0

    def flood(self, host: str, other: str) -> tuple[int, int]:
        """Ask the supervisor of another host as fast as possible for a second.

        Returns the numbers of answers, and of reports to this host as the predecessor of the other one.
        """
        answers, reports = self._inside(host, sys.executable, "-c", QUESTIONS, ADDRESSES[other]).split()
        return int(answers), int(reports)

    def _inside(self, host: str, *command: str) -> str:
        return subprocess.run([*self._hosts[host], *command], check=True, stdout=subprocess.PIPE, text=True).stdout


@pytest.fixture
def hosts(tmp_path: Path) -> Iterator[Hosts]:
    with network() as lan:
        made = Hosts(lan, tmp_path)
        try:
            yield made
        finally:
            made.end()


def eventually(holds: object) -> None:
    assert callable(holds)
    end = time.monotonic() + WITHIN
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)


def run_a_and_lead_to_b(hosts: Hosts) -> None:
    hosts.lead_to("a")
    hosts.start("a")
    eventually(lambda: hosts.starts("a") == 1)
    hosts.lead_to("b")


def test_a_server_ends_when_the_service_leads_to_another_one_and_starts_when_it_leads_back(hosts: Hosts) -> None:
    run_a_and_lead_to_b(hosts)
    hosts.start("b")
    eventually(lambda: hosts.starts("b") == 1)
    assert hosts.ends("a") == 1, "before the other one begins"
    time.sleep(QUIET + 2.0)
    assert hosts.starts("b") == 1, "they did not run beside each other"

    hosts.lead_to("a")
    eventually(lambda: hosts.starts("a") == 2)
    assert hosts.ends("b") == 1


def test_a_server_ends_for_its_successor_although_the_service_still_leads_it_to_itself(hosts: Hosts) -> None:
    run_a_and_lead_to_b(hosts)
    hosts.lead_each_to_itself()
    hosts.start("b")
    eventually(lambda: hosts.starts("b") == 1)
    assert hosts.ends("a") == 0, "it asked only itself"

    hosts.begin_beside("b", "a")
    eventually(lambda: hosts.ends("a") == 1)
    time.sleep(QUIET + 2.0)
    assert (hosts.starts("a"), hosts.ends("b")) == (1, 0), "it stays ended as long as its successor runs"


def run_beside_each_other(hosts: Hosts) -> None:
    run_a_and_lead_to_b(hosts)
    hosts.lead_each_to_itself()
    hosts.start("b")
    eventually(lambda: hosts.starts("b") == 1)
    assert hosts.ends("a") == 0


def test_a_server_starts_again_after_another_one_ran_beside_it(hosts: Hosts) -> None:
    run_beside_each_other(hosts)
    hosts.lead_both_to_one()
    eventually(lambda: hosts.starts("b") == 2)
    assert (hosts.ends("a"), hosts.starts_again("b")) == (1, 1), "participants mix up the numbers of the two"
    time.sleep(QUIET + 2.0)
    assert (hosts.starts("a"), hosts.starts("b")) == (1, 2)


def test_a_server_that_its_kubelet_ends_reports_that_it_ran_beside_another_one(hosts: Hosts) -> None:
    run_beside_each_other(hosts)
    hosts.begin_beside("b", "a")
    hosts.end("a")
    eventually(lambda: hosts.starts("b") == 2)
    assert hosts.starts_again("b") == 1


def test_a_server_of_another_workload_does_not_end_it(hosts: Hosts) -> None:
    hosts.lead_to("a")
    hosts.start("a")
    hosts.lead_to("b")
    hosts.lead_each_to_itself()
    hosts.begin_beside("b", "a")  # the address of a pod that is gone is that of another workload's server now
    hosts.start("b", service="10.64.0.3")
    eventually(lambda: hosts.starts("a") + hosts.starts("b") == 2)
    time.sleep(2.0)
    assert hosts.ends("a") == 0


def test_a_server_sends_nothing_when_it_ends(hosts: Hosts) -> None:
    run_a_and_lead_to_b(hosts)
    hosts.start("b")
    eventually(lambda: hosts.starts("b") == 1)
    assert (hosts.ends("a"), hosts.reports("a")) == (1, 0), (
        "participants would take it for the beginning of the other one"
    )

    hosts.end()  # as the kubelet does
    assert hosts.reports("b") == 0


def test_a_server_that_receives_no_answer_goes_on(hosts: Hosts) -> None:
    hosts.start("a")  # the Service leads nowhere, or the network does not lead a pod back to itself
    eventually(lambda: hosts.starts("a") == 1)
    time.sleep(3.0)
    assert hosts.ends("a") == 0


def test_a_flood_of_questions_is_answered_slowly(hosts: Hosts) -> None:
    hosts.lead_to("a")
    hosts.start("a")
    eventually(lambda: hosts.starts("a") == 1)
    hosts.begin_beside("a", "b")
    answers, reports = hosts.flood("b", "a")
    assert 0 < answers <= 1.5 / PAUSE
    assert 0 < reports <= 1.5 / SUCCEEDS_EVERY, "a flood makes it send no more of them"
    assert hosts.ends("a") == 0

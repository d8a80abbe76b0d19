"""The agent finds the interfaces of its pod besides that of the pod network: real ones, in a network namespace."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.unit.agent.conftest import PACKAGE
from understudy.agent.network_interfaces import PERIOD

pytestmark = pytest.mark.skipif(
    os.geteuid() != 0 or not shutil.which("ip") or not shutil.which("unshare"), reason="takes root and ip"
)

OWN = "10.77.0.2"

LOOK = """
import json, subprocess, sys
from understudy.agent.network_interfaces import FurtherInterfaces
interfaces = FurtherInterfaces(sys.argv[1])
for now, commands in json.loads(sys.argv[2]):
    subprocess.run(["ip", "-batch", "-"], input="\\n".join(commands), text=True, check=True)
    print(json.dumps(interfaces.seen(now)))
"""

REPORT = """
import json, os, subprocess, sys
from understudy.agent.agent import Agent
from understudy.agent.pod_identity import PodIdentity
from understudy.kube.gates.probes import ProbeSender
subprocess.run(["ip", "-batch", "-"], input="\\n".join(json.loads(sys.argv[1])), text=True, check=True)
identity = PodIdentity.from_environment(os.environ)
print(json.dumps(Agent(identity, ProbeSender(identity.uid)).status().to_wire()))
"""


def added(name: str, *addresses: str, up: bool = True) -> list[str]:
    """Return the commands that add an interface to a pod. IPv6 addresses are usable at once."""
    made = [f"link add {name} type veth peer name {name}-peer", f"link set {name}-peer up"]
    made += [f"addr add {address} dev {name}{' nodad' if ':' in address else ''}" for address in addresses]
    return [*made, *([f"link set {name} up"] if up else [])]


POD = ["link set lo up", *added("eth0", f"{OWN}/16", "fd12::2/64")]
"""What every pod has."""


def in_namespace(script: str, *arguments: str, **environment: str) -> list[Any]:
    """Return what a script prints in a network namespace of its own."""
    found = subprocess.run(
        ["unshare", "--net", sys.executable, "-c", script, *arguments],
        env={**os.environ, "PYTHONPATH": str(PACKAGE), **environment},
        stdout=subprocess.PIPE,
        check=True,
    )
    return [json.loads(line) for line in found.stdout.splitlines()]


def seen(commands: list[str], *later: tuple[float, list[str]], own: str = OWN) -> list[dict[str, list[str]]]:
    """Return what an agent finds after these commands of ip in its pod, and then after those of each later second."""
    return in_namespace(LOOK, own, json.dumps([(0.0, [*POD, *commands]), *later]))


def test_a_further_interface_with_an_address_is_found() -> None:
    commands = [*added("net1", "192.168.7.2/24", "fd13::2/64"), *added("net2", "fd14::2/64")]
    assert seen(commands) == [{"net1": ["192.168.7.2", "fd13::2"], "net2": ["fd14::2"]}]


def test_what_leads_nowhere_else_does_not_count() -> None:
    commands = [
        "addr add 192.168.7.2/24 dev eth0",
        *added("net1", "169.254.172.2/22", "fe80::2/64"),
        *added("net2"),
        *added("net3", "192.168.8.2/24", up=False),
    ]
    assert seen(commands) == [{}]


def test_the_pods_own_interface_is_known_by_an_ipv6_address_too() -> None:
    assert seen(added("net1", "192.168.7.2/24"), own="fd12:0::2") == [{"net1": ["192.168.7.2"]}]


@pytest.mark.parametrize("own", ["", "10.77.0.99"])
def test_nothing_is_found_if_no_interface_is_known_to_be_the_pods_own(own: str) -> None:
    assert seen(added("net1", "192.168.7.2/24"), own=own) == [{}]


def test_an_interface_that_is_added_later_is_found_within_a_period() -> None:
    plugged = (PERIOD - 0.1, added("net1", "192.168.7.2/24"))
    found = seen([], plugged, (PERIOD, []), (2 * PERIOD, ["link del net1"]))
    assert found == [{}, {}, {"net1": ["192.168.7.2"]}, {}]


def test_an_agent_reports_further_interfaces(tmp_path: Path) -> None:
    pod = {"UNDERSTUDY_POD": "robot-1", "UNDERSTUDY_POD_UID": "0b5d9f5e-7c1e-4a8e-9f2b-5d2f3f6f9a10"}
    instance = {"UNDERSTUDY_WORKLOAD": "robot", "UNDERSTUDY_DIR": str(tmp_path), "UNDERSTUDY_POD_IP": OWN}
    commands = json.dumps([*POD, *added("net1", "192.168.7.2/24")])
    (status,) = in_namespace(REPORT, commands, **pod, **instance)
    assert status["furtherInterfaces"] == {"net1": ["192.168.7.2"]}

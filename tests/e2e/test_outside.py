"""A robot outside of the cluster, set up as docs/how-to/robot-outside-the-cluster.md says, on a machine beside the nodes.

The robot's firewall counts who sends to the gated ports.
"""

from __future__ import annotations

import json
import math
import os
import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pytest
from understudy_demo import robotview
from understudy_demo.robotview import RobotLog

from testcluster.local.machines import Machine
from tests.e2e.console import REPOSITORY, understudy
from tests.e2e.faults import cluster, local_layout
from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import Late, Robot, eventually, manifest, never
from tests.e2e.test_strategies import assert_handed_over, often

pytestmark = [pytest.mark.local_only, pytest.mark.xdist_group("machines")]

SOURCES = f"{REPOSITORY / 'operator'}:{REPOSITORY / 'examples' / 'quickstart' / 'src'}"
TOKEN = "go-template={{.data.token | base64decode}}"
DISCOVERY_PORT = 11811
DOMAIN = 17
DOMAIN_PORTS = 7400 + 250 * DOMAIN
GATED = (7950, 8149)

DRIVEN_WITHIN = 3.5
"""Seconds for which a failure may leave the robot undriven: the timeout of the policy, and `verifyWithin` of its first strategy."""

ENFORCED_WITHIN = 30.0
"""Seconds until every network has applied a policy of the user's."""

SERVER_AWAY = 25.0
"""Seconds after which a discovery server may start that replaces one that was lost: more than the DDS lease duration (RestartSec of
the how-to)."""

FIREWALL = f"""
table inet robot {{
  set drivers {{ type ipv4_addr; size 64; flags dynamic; counter; }}
  set refused {{ type inet_service; size 64; flags dynamic; counter; }}
  chain input {{
    type filter hook input priority 0; policy drop;
    iifname "lo" accept
    udp dport {GATED[0]}-{GATED[1]} update @drivers {{ ip saddr }} accept
    udp dport {{ 7000-7399, {DOMAIN_PORTS}-{DOMAIN_PORTS + 249} }} accept
    meta l4proto udp update @refused {{ udp dport }}
  }}
}}
"""
"""Accepts the ports that the how-to names, and nothing else."""


class OutsideRobot(Robot):
    """The robot, on a machine, and its discovery server, on another one."""

    def __init__(self, kubectl: Kubectl, robot: Machine, server: Machine, folder: Path, gate_kind: str) -> None:
        super().__init__(kubectl, gate_kind=gate_kind)
        self.machine, self._server, self._folder = robot, server, folder

    def set_up(self) -> None:
        """Follow the how-to until the robot's processes are started."""
        self.machine.up()
        self.machine.run("nft", "-f", "-", input=FIREWALL)
        self.start_server()
        self.kubectl.apply(manifest("strategies/executing.yaml"))
        found = self.objects(policy="quickstart-executing", edit=self._edit)
        self.kubectl.apply(item for item in found if item["kind"] != "Deployment")
        files = ("--write", str(self._folder), "--at", str(self._folder))
        eventually(
            lambda: understudy(self.kubectl, "robot-profile", self.workload, *files).returncode == 0,
            within=60,
            what="the robot's files are there",
            note=self.describe,
        )
        if self.gate_kind == "Mux":
            token = self.kubectl("get", "secret", f"{self.workload}-mux", "-o", TOKEN)
            (self._folder / "token").write_text(token)
            variables = {"UNDERSTUDY_TOKEN_FILE": self._folder / "token", "UNDERSTUDY_STATE": self._folder / "mux"}
            self._start("mux", ("ros.env", "mux.env"), variables, "understudy", "mux")
        self._start("robot", ("ros.env",), {"ROBOT_LOG": self._journal}, "understudy_quickstart.robot")

    def _start(self, name: str, files: Sequence[str], variables: Mapping[str, object], *module: str) -> None:
        """Start a Python module with the environment of files, as systemd does, and with variables."""
        lines = [line for file in files for line in shlex.split((self._folder / file).read_text())]
        own = {"PYTHONPATH": SOURCES, "HOME": self._folder, "ROS_LOG_DIR": self._folder / "ros", **variables}
        command = ["env", *lines, *(f"{key}={value}" for key, value in own.items()), sys.executable, "-m", *module]
        self.machine.start(command, self._folder / f"{name}.log")

    def _edit(self, workload: Object) -> None:
        server = f"{self._server.address}:{DISCOVERY_PORT}"
        workload["spec"]["ros"] = {"domainId": DOMAIN, "discovery": {"mode": "External", "server": server}}
        workload["spec"]["gate"] = {"robots": [f"{self.machine.address}/32", f"{self._server.address}/32"]}

    def start_server(self) -> None:
        """Switch the machine of the discovery server on, and start that."""
        self._server.up()
        path = f"PATH={Path(sys.executable).parent}:{os.environ['PATH']}"
        command = ["fastdds", "discovery", "-i", "0", "-l", self._server.address, "-p", str(DISCOVERY_PORT)]
        self._server.start(["env", path, *command], self._folder / "server.log")

    def stop_server(self) -> None:
        """Switch the machine of the discovery server off."""
        self._server.down()

    @property
    def _journal(self) -> Path:
        return self._folder / "robot.jsonl"

    def log(self, tail: int = 0) -> RobotLog:
        """What the robot wrote down of every command."""
        lines = self._journal.read_text().splitlines() if self._journal.exists() else []
        return robotview.parse(lines[-tail:]).between(self._begun, math.inf)

    def describe(self) -> str:
        """The same as for a robot of the cluster, and the end of the logs of both machines."""
        return "\n".join([super().describe(), *(path.read_text()[-2000:] for path in self._folder.glob("*.log"))])

    def addresses(self) -> dict[str, str]:
        """The addresses of its instances by their names."""
        return {pod["metadata"]["name"]: pod["status"]["podIP"] for pod in self.pods() if pod["status"].get("podIP")}

    def counted(self, name: str) -> dict[str, int]:
        """The packets that a set of the firewall has counted, by its elements."""
        found = json.loads(self.machine.run("nft", "-j", "list", "set", "inet", "robot", name))
        elements = found["nftables"][-1]["set"].get("elem", ())
        return {str(one["elem"]["val"]): one["elem"]["counter"]["packets"] for one in elements}

    def drivers(self, seconds: float = 2.0) -> dict[str, int]:
        """The addresses whose packets arrive at its gated ports from now on, with their numbers."""
        self.machine.run("nft", "flush", "set", "inet", "robot", "drivers")
        time.sleep(seconds)
        return self.counted("drivers")


@pytest.fixture
def outside(kubectl: Kubectl, tmp_path: Path, gate_kind: str) -> Iterator[OutsideRobot]:
    """A robot of the quickstart outside of the cluster, with an executing standby."""
    if Path(cluster("kubeconfig").strip()) != kubectl.kubeconfig:
        pytest.skip("the cluster under test isn't the one beside whose nodes a machine can be put")
    layout = local_layout()
    assert layout is not None
    machines = [Machine(layout, number) for number in (1, 2)]
    robot = OutsideRobot(kubectl, *machines, tmp_path, gate_kind)
    try:
        robot.set_up()
        robot.wait_protected()
        robot.wait_standby()
        yield robot
    finally:
        for machine in machines:
            machine.down()


def opened(robot: OutsideRobot) -> Object:
    """The policy that the how-to on network policies warns of: it opens the robot's gated ports for each instance."""
    ports = [{"protocol": "UDP", "port": GATED[0], "endPort": GATED[1]}]
    to = [{"ipBlock": {"cidr": f"{robot.machine.address}/32"}}]
    selector = {"matchLabels": {"understudy.dev/workload": robot.workload}}
    spec = {"podSelector": selector, "policyTypes": ["Egress"], "egress": [{"to": to, "ports": ports}]}
    metadata = {"name": "open"}
    return {"apiVersion": "networking.k8s.io/v1", "kind": "NetworkPolicy", "metadata": metadata, "spec": spec}


@pytest.mark.network_policy
def test_only_the_instance_in_control_reaches_a_robot_outside_of_the_cluster(outside: OutsideRobot) -> None:
    active = outside.wait_driven()
    address = outside.addresses()[active]
    drivers = outside.drivers()
    print(f"\n{active} is at {address}; packets in 2 s: {drivers}")
    assert drivers.get(address), "packets arrive from the pod's own address"
    never(set(drivers) - {address}, "packets of others than the instance in control")
    never(set(outside.log().sources()) - {active}, "commands of others than the instance in control")
    assert any(abs(motion.speed) > 0.1 for motion in outside.log().motions), "it drives by its scans and its map"
    assert not outside.counted("refused"), "the how-to names every port that its firewall must accept"
    read = eventually(
        lambda: outside.condition("OutputsRead").get("reason") == "AtGatedPorts" and outside.condition("OutputsRead"),
        within=30, what="the robot is seen at its gated port", note=outside.describe,
    )  # fmt: skip
    assert f"/cmd_vel by /robot at {outside.machine.address}:7950" in read["message"]

    # The standby sends, and it is the gate alone that keeps it from the robot.
    outside.kubectl.apply([opened(outside)])
    both = set(outside.addresses().values())
    eventually(lambda: set(outside.drivers()) == both, within=ENFORCED_WITHIN, what="both reach it", every=0)
    outside.kubectl("delete", "networkpolicy", "open")
    eventually(lambda: set(outside.drivers()) == {address}, within=ENFORCED_WITHIN, what="one reaches it", every=0)


def assert_driven_by(robot: OutsideRobot, pod: str) -> None:
    """Packets arrive at the gated ports from this pod, and from nobody else. A mux hears all of them, so there the commands count."""
    if robot.gate_kind == "Mux":
        begun = time.time()
        time.sleep(2)
        sources = robot.log().between(begun, math.inf).sources()
        assert pod in sources, robot.describe()
        never(set(sources) - {pod}, "commands of others")
        return
    drivers, address = robot.drivers(), robot.addresses()[pod]
    assert drivers.get(address), robot.describe()
    never(set(drivers) - {address}, f"packets of others than {pod}, at {address}")


def assert_taken_over(robot: OutsideRobot, how: str, number: int) -> None:
    """The active instance fails, and the standby takes over."""
    old = robot.wait_protected()
    robot.wait_standby()
    assert_driven_by(robot, old)
    robot.fail(old, how)
    recovery = robot.wait_recovered(number)
    assert (recovery.strategy, recovery.old) == ("Fallback/Executing", old), recovery
    assert_handed_over(robot, recovery)
    assert_driven_by(robot, recovery.new)
    gap = robot.log().handover(old, recovery.new, switch=recovery.moments["decided"]).gap
    assert gap is not None
    if gap > DRIVEN_WITHIN:
        raise Late(f"nobody drove for {gap:.3f} s")


@pytest.mark.parametrize("how", often("killed"))
def test_a_standby_takes_over_a_robot_outside_of_the_cluster(outside: OutsideRobot, how: str) -> None:
    assert_taken_over(outside, how, 1)
    outside.wait_protected()


def test_a_robot_outside_of_the_cluster_is_handed_over_as_planned(outside: OutsideRobot) -> None:
    old = outside.wait_driven()
    assert understudy(outside.kubectl, "failover", outside.workload, "--yes").returncode == 0
    new = eventually(
        lambda: (active := outside.status().get("active")) != old and active,
        within=60, what="another instance is in control", note=outside.describe,
    )  # fmt: skip
    outside.wait_driven()
    assert_driven_by(outside, new)


@pytest.mark.long
def test_a_robot_is_driven_while_its_discovery_server_is_away_and_found_by_a_new_one(outside: OutsideRobot) -> None:
    outside.stop_server()
    stopped = time.monotonic()
    time.sleep(5)
    assert outside.recoveries() == []
    assert_taken_over(outside, "killed", 1)
    time.sleep(max(0.0, stopped + SERVER_AWAY - time.monotonic()))
    outside.start_server()
    outside.wait_protected(180)
    assert_taken_over(outside, "killed", 2)

"""Measures whether a flood from one pod delays a failover: real failures in the middle of floods, and without a flood.

    scripts/bench flood [--failures 5] [--seconds 60] [--variants outside peer open graph robot] [--cpus core 500m none] [--at PART ...]

A stranger's pod, without rights and without labels, sends datagrams and makes connections at its full rate to all instances, the monitor
and the discovery server of one robot. SIGKILL ends the application that drives, and its executing standby takes over.

    outside  the stranger is in another namespace: network policies drop everything except connections to pages, since the tests' chart
             has metrics for everybody (metrics.from)
    peer     it is in the robot's namespace, so by default a peer: policies admit its datagrams at the discovery server
    open     the same with a policy that admits everything that arrives: floods reach agents, probes and pages
    graph    as peer, at the DDS ports of monitor and instances, the gated ones too, where policies admit peers; without a bound
    robot    as peer, at the robot's own ports, which Understudy does not protect; without a bound

``--cpus`` are limits of the stranger's pod, because its processes compete with the robot's for the processors of this machine. Those of a
pod on another machine would not. With ``core``, they are all on one processor, as the interrupts of a network card may be. It requests
almost nothing. ``--at`` names what is flooded.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import sys
import uuid
from dataclasses import dataclass
from pathlib import Path

from bench.flood import targets
from bench.flood.flooder import Plan
from bench.flood.report import add
from bench.flood.series import GAP, Found, Machine, Series, address
from bench.flood.stranger import Stranger, opened
from bench.flood.targets import DDS, PARTS, ROBOT, Targets
from bench.recovery import PERIOD, TIMEOUT, enforcer
from bench.results import Report
from tests.e2e.conftest import install
from tests.e2e.kubectl import Failed, Kubectl
from tests.e2e.scenario import Late, Robot, eventually, manifest
from understudy.api import names

MEMORY = "cat /sys/fs/cgroup/memory.peak 2>/dev/null || cat /sys/fs/cgroup/memory/memory.max_usage_in_bytes"
"""Prints the most memory of a container so far, in bytes."""


@dataclass(frozen=True)
class Variant:
    """Who floods, and what is in the way."""

    name: str
    peer: bool = True
    """Whether the stranger is in the robot's namespace."""
    opened: bool = False
    """Whether a policy admits everything."""
    parts: tuple[str, ...] = tuple(part for part in PARTS if part != DDS)
    bounded: bool = True


VARIANTS = {
    one.name: one
    for one in (
        Variant("outside", peer=False, parts=PARTS),
        Variant("peer"),
        Variant("open", opened=True),
        Variant("graph", parts=(DDS,), bounded=False),
        Variant("robot", parts=(ROBOT,), bounded=False),
    )
}


class Bench:
    """One robot, and strangers that flood it."""

    def __init__(self, kubectl: Kubectl, elsewhere: Kubectl, quiet: Found, options: argparse.Namespace) -> None:
        self.robot = Robot(kubectl)
        self._elsewhere, self._options, self.quiet = elsewhere, options, quiet
        kubectl.apply(manifest("strategies/executing.yaml"))
        kubectl.apply(self.robot.objects(policy="quickstart-executing"))
        self.robot.wait_protected()
        self._targets = Targets(self.robot)

    def without(self, failures: int) -> None:
        """Make failures without a flood."""
        series = self._rested_series(self.quiet)
        series.fail(failures, within=30.0 + 30.0 * failures)
        self._finish(series, self.quiet, "no flood")

    def run(self, variant: Variant, cpu: str) -> Found:
        """Make floods until there were enough failures in them."""
        found, kubectl, wanted = Found(), self.robot.kubectl, self._options.failures
        parts = tuple(part for part in variant.parts if part in (*self._options.at, ROBOT))
        stranger = Stranger(kubectl if variant.peer else self._elsewhere, cpu)
        try:
            with opened(kubectl) if variant.opened else contextlib.nullcontext():
                made = 0
                for _ in range(2 * wanted):
                    if made < wanted:
                        made += self._flood(found, stranger, parts, wanted - made, f"{variant.name}, {cpu}")
        finally:
            stranger.end()
        return found

    def _flood(self, found: Found, stranger: Stranger, parts: tuple[str, ...], most: int, name: str) -> int:
        series, seconds = self._rested_series(found), self._options.seconds
        before, machine = self._received(), Machine()
        protectors = self._protectors()
        flood = stranger.begin(seconds)
        try:
            series.fail(most, within=seconds, before_each=lambda: flood.aim(self._plan(parts)), to_the_end=True)
            shares = machine.shares()
            sent = flood.result(within=60.0)
        except (OSError, ValueError) as error:
            print(f"{name}: a flood ended early and does not count: {error!r}", file=sys.stderr)
            return 0
        finally:
            flood.end()
        lasted = sent["seconds"]
        received = {key: (value - before[key]) / lasted for key, value in self._received().items()}
        rates = {
            "datagrams sent": (sent.get("datagrams", 0.0) / lasted, "1/s"),
            "sent": (8e-6 * sent.get("bytes", 0.0) / lasted, "Mbit/s"),
            "connections begun": (sent.get("connections begun", 0.0) / lasted, "1/s"),
            "connections established": (sent.get("connections established", 0.0) / lasted, "1/s"),
            "datagrams that the monitor read": (received["InDatagrams"], "1/s"),
            "datagrams that it lost": (received["RcvbufErrors"], "1/s"),
            "processors of the stranger": (100 * sent["processor seconds"] / lasted, "% of one"),
            **{key: (value, "% of all") for key, value in shares.items()},
        }
        for key, (value, unit) in rates.items():
            found.rates.setdefault((key, unit), []).append(value)
        print(f"{name}: {', '.join(f'{key} {value:.4g} {unit}' for key, (value, unit) in rates.items())}", flush=True)
        self._finish(series, found, name)
        found.restarts["replaced pods"] = found.restarts.get("replaced pods", 0) + len(protectors - self._protectors())
        return series.made

    def _protectors(self) -> set[str]:
        """Return the pods of the monitor and the discovery server."""
        selector = f"{names.MONITORED}={self.robot.workload}"
        return {pod["metadata"]["name"] for pod in self.robot.kubectl.list("pods", selector)}

    def _plan(self, parts: tuple[str, ...]) -> Plan:
        return self._targets.plan(parts, self._options.processes)

    def _rested_series(self, found: Found) -> Series:
        self._rest()
        return Series(self.robot, found)

    def _rest(self) -> None:
        """Wait until the robot is protected, and the pods of the last failure are gone."""

        def rested() -> bool:
            pods = self.robot.pods()
            protected = self.robot.condition("Protected").get("status") == "True"
            return protected and len(pods) == 2 and all(map(address, pods))

        eventually(rested, within=180, what="the robot is at rest", every=1.0, note=self.robot.describe)

    def _finish(self, series: Series, found: Found, name: str) -> None:
        """Read what a series of failures has left, once the robot is at rest again."""
        self._rest()
        series.record()
        robot, own = self.robot, (names.AGENT_CONTAINER, "monitor", "discovery")
        for pod in [*robot.pods(), *robot.kubectl.list("pods", f"{names.MONITORED}={robot.workload}")]:
            for status in pod["status"].get("containerStatuses") or []:
                if status["name"] in own:
                    found.restarts[pod["metadata"]["name"]] = status["restartCount"]
                    with contextlib.suppress(Failed):  # it is gone by now
                        peak = int(robot.kubectl.shell(pod["metadata"]["name"], status["name"], MEMORY)) / 1e6
                        found.memory.setdefault(status["name"], []).append(peak)
        gaps = ", ".join(f"{gap:.0f}" for gap in found.values.get(GAP, [])[-series.made :])
        print(f"{name}: {series.made} failures, gaps {gaps} ms, false failovers: {found.unasked}", flush=True)

    def _received(self) -> dict[str, int]:
        monitor = self.robot.monitor_pods()[-1]["metadata"]["name"]
        return targets.udp_counters(self.robot.kubectl.shell(monitor, "monitor", "cat /proc/net/snmp"))


def main() -> int:
    parser = argparse.ArgumentParser(
        "scripts/bench flood", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--failures", type=int, default=5, help="for each variant and each limit")
    parser.add_argument("--quiet", type=int, default=2, help="failures without a flood before each variant and limit")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of one flood")
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--cpus", nargs="+", default=["core", "500m", "none"], metavar="LIMIT")
    parser.add_argument("--at", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--processes", type=int, default=2, help="that send datagrams; as many make connections")
    options = parser.parse_args()
    kubeconfig = Path(os.environ["KUBECONFIG"])
    install(kubeconfig)
    report, policies = Report("flood"), enforcer()
    own = f"bench-{uuid.uuid4().hex[:6]}"
    kubectl, elsewhere = Kubectl(kubeconfig, own), Kubectl(kubeconfig, f"{own}-stranger")
    results: dict[str, Found] = {}
    quiet = Found()
    try:
        for one in (kubectl, elsewhere):
            one("create", "namespace", one.namespace)
        bench = Bench(kubectl, elsewhere, quiet, options)
        for name, cpu in itertools.product(options.variants, options.cpus):
            bench.without(options.quiet)
            results[f"{name}, {cpu}"] = bench.run(VARIANTS[name], cpu)
    except (Failed, Late, KeyboardInterrupt) as error:
        print(error, file=sys.stderr)
        report.note("ended early", f"{error!r}"[:2000])
    finally:
        for one in (kubectl, elsewhere):
            one("delete", "namespace", one.namespace, "--wait=false", "--ignore-not-found")
    bounded = {name for name in results if VARIANTS[name.partition(",")[0]].bounded}
    add(report, quiet, results, bounded)
    report.note("failure", f"SIGKILL, timeout {TIMEOUT:g} s, command period {PERIOD * 1000:g} ms")
    report.note("floods", f"{options.seconds:g} s each, at {', '.join(options.at)}")
    report.note("network policies", policies)
    report.note(
        "what limits a flood here",
        "Nodes, robot and stranger share the processors of one machine, and packets pass between them without a network card. The "
        "processor that sends a packet also delivers it, so processors limit the rate, and so does a limit of the stranger. Packets then "
        "come in bursts, ten times a second",
    )
    print(report.table())
    print(report.write())
    return 0 if report.held and len(results) == len(options.variants) * len(options.cpus) else 1


if __name__ == "__main__":
    sys.exit(main())

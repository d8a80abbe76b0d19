"""Measures the reflex on the real cluster, at the robot: how long it had no command, and whether the loser ever came
back.

    scripts/bench reflex [--failures 50] [--deadline 100] [--how killed frozen cut]

The failures take turns: the application is killed; it is frozen (and thawed after the commit); its node's cable is
pulled (and put back after the commit). In every second failure the API server is stopped before the failure, until
the robot has been driven again for a while. The bench needs the local provider, because no other provider can do all
that.
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import sys
import time
import uuid
from pathlib import Path

from understudy_demo.recovery import Recovered

from bench.results import Report, of_network
from tests.e2e.conftest import install
from tests.e2e.faults import ApiServer, cluster, signal_processes, staying
from tests.e2e.kubectl import Failed, Kubectl, Object
from tests.e2e.scenario import APPLICATION, Late, Robot, eventually, manifest

PERIOD = 0.05
"""Seconds between the quickstart's commands."""

SLACK = 0.025
"""The most seconds that the robot's gap may add to deadline and period, at p95."""

ROBOTS_NODE = "node1"
"""The node of the robot, its discovery server and the monitor. Its cable is never pulled."""

BACK = "commands of the old pod when its node was back"
"""A subset of the commands of the old pod after the commit."""

STRATEGY = "Fallback/Executing (reflex)"

AWAY = 5.0
"""Seconds for which a disconnected node stays away after the commit."""

STANDBY = 600.0
"""Maximum seconds until the gate lets a standby through again. After several failures of the API server, the
scheduler's own watch of the nodes backs off. A standby was then seen to wait for its node for more than a minute."""

SETTLE = 4.0
"""Seconds without an API server after the failure: longer than the kubelet takes to restart a container."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--failures", type=int, default=50)
    parser.add_argument("--deadline", type=int, default=100, help="spec.gate.reflex.deadline in milliseconds")
    parser.add_argument("--how", nargs="+", choices=["killed", "frozen", "cut"], default=["killed", "frozen", "cut"])
    options = parser.parse_args()
    kubeconfig = Path(os.environ["KUBECONFIG"])
    install(kubeconfig)
    kubectl = Kubectl(kubeconfig, f"bench-{uuid.uuid4().hex[:6]}")
    others = [n["metadata"]["name"] for n in kubectl.list("nodes") if n["metadata"]["name"] != ROBOTS_NODE]
    provider = cluster("status").splitlines()[0]  # not later: the cluster is not ready with cordoned or lost nodes
    kubectl("create", "namespace", kubectl.namespace)
    kubectl("cordon", *others)
    bench, ended = Bench(kubectl, options.deadline / 1000, provider), ""
    try:
        bench.begin()
        turns = itertools.cycle(itertools.product(options.how, (False, True)))
        for number, (how, without_api) in zip(range(1, options.failures + 1), turns, strict=False):
            bench.fail(how, without_api)
            print(f"{number}/{options.failures}: {bench.told[-1]}", flush=True)
    except KeyboardInterrupt:
        print("ended early: these are the figures so far", flush=True)
    except (Failed, Late) as error:
        # The earlier measurements count, and the present state shows why the bench ended.
        print(f"ended early: {error}", flush=True)
        ended = str(error).partition(". ")[0]
    finally:
        if bench.api.stopped:
            bench.api.start()
        for node in others:
            cluster("node", "connect", node)
        kubectl("uncordon", *others)
        kubectl("delete", "namespace", kubectl.namespace, "--wait=false")
    report = bench.report()
    if ended:
        report.note("ended early", ended)
    print(report.table())
    print(report.write())
    return 0 if report.held and not ended else 1


class Bench:
    """One robot whose application fails repeatedly."""

    def __init__(self, kubectl: Kubectl, deadline: float, provider: str) -> None:
        self._kubectl, self._deadline, self._cluster = kubectl, deadline, provider
        self._robot = Robot(kubectl)
        self.api = ApiServer(kubectl)
        self.told: list[str] = []
        self._values: dict[str, list[float]] = {}
        self._count = 0
        self._early = 0

    def begin(self) -> None:
        """Start the robot, its application, and a standby that the gate lets through."""
        self._kubectl.apply(manifest("strategies/executing.yaml"))
        self._kubectl.apply(staying(self._robot.objects(policy="quickstart-executing", edit=self._edit)))
        self._armed()

    def _edit(self, workload: Object) -> None:
        spec = workload["spec"]
        spec["gate"] = {"reflex": {"deadline": f"{self._deadline * 1000:.0f}ms"}}
        away = {"key": "kubernetes.io/hostname", "operator": "NotIn", "values": [ROBOTS_NODE]}
        terms = {"nodeSelectorTerms": [{"matchExpressions": [away]}]}
        pod = spec["template"]["spec"]
        pod["affinity"] = {"nodeAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": terms}}
        # The nodes of the instances are cordoned, so that they run nothing else.
        pod["tolerations"] = [{"key": "node.kubernetes.io/unschedulable", "operator": "Exists"}]

    def _armed(self, *, apart: bool = False) -> Object:
        """Wait until the gate lets a standby through, with ``apart`` on another node, and return the active pod."""

        def armed() -> Object | None:
            # A network such as Cilium follows the gate late after an outage of the API server.
            if any(self._robot.condition(name).get("status") != "True" for name in ("Reflex", "GateEnforced")):
                return None
            active = self._robot.status()["active"]
            pods = {p["metadata"]["name"]: p for p in self._robot.pods() if not p["metadata"].get("deletionTimestamp")}
            if apart and len({p["spec"]["nodeName"] for p in pods.values()}) < 2:
                # While the failed pod was ending, the scheduler had no reason to prefer the other node.
                self._kubectl("delete", "pod", "--wait=true", *(name for name in pods if name != active))
                return None
            return pods.get(active)

        self._robot.wait_driven(180)
        found: Object = eventually(armed, within=STANDBY, what="a standby is let through", note=self._robot.describe)
        time.sleep(1.0)
        return found

    def fail(self, how: str, without_api: bool) -> None:
        """Make one failure, and record what the robot received."""
        pod = self._armed(apart=how == "cut")
        name, uid, node = pod["metadata"]["name"], pod["metadata"]["uid"], pod["spec"]["nodeName"]
        before = self._robot.status().get("recoveryCount") or 0
        if without_api:
            self.api.stop()
        match how:
            case "killed":
                signal_processes(uid, APPLICATION, signal.SIGKILL)
            case "frozen":
                signal_processes(uid, APPLICATION, signal.SIGSTOP)
            case _:
                cluster("node", "cut", node)
        if without_api:
            time.sleep(SETTLE)
            cluster("api", "start")
        recovery = self._robot.wait_recovered(before + 1, within=120)
        if how == "frozen":
            signal_processes(uid, APPLICATION, signal.SIGCONT)
        connected = time.time()
        if how == "cut":
            time.sleep(AWAY)
            connected = time.time()
            cluster("node", "connect", node)
        if without_api or how == "cut":
            self.api.start()
        time.sleep(3.0)
        if recovery.old != name or recovery.strategy != STRATEGY:
            # The application or its standby was late before the failure, so this one counts neither for nor against the
            # bound.
            self._early += 1
            self.told.append(f"{name} was to be {how}; it came to {recovery.strategy} of {recovery.old}: left out")
            return
        self._judge(recovery, how, without_api, connected if how == "cut" else None)

    def _judge(self, recovery: Recovered, how: str, without_api: bool, connected: float | None) -> None:
        log = self._robot.log(tail=4000)
        handover = log.handover(recovery.old, recovery.new, switch=recovery.moments["lastHealthy"])
        if handover.gap is None:
            raise Late("the robot never heard the standby")
        fenced = recovery.moments["fenced"]
        after = [c for c in log.of(recovery.old) if c.received > fenced]
        if connected is not None:
            # The policies of a disconnected node are as old as its last contact, so its agent has to stop the pod.
            stale = [c for c in after if c.received >= connected]
            self._values.setdefault(BACK, []).append(float(len(stale)))
        between = [c for c in log.of(recovery.old) if handover.first_new and handover.first_new < c.received <= fenced]
        kind = f"{how}{', no API server' if without_api else ''}"
        for group in ("all", kind):
            self._values.setdefault(f"{group}: robot's gap", []).append(handover.gap * 1000)
        self._values.setdefault("commands of the old pod after the commit", []).append(float(len(after)))
        self._values.setdefault("commands of the old pod between", []).append(float(len(between)))
        self._values.setdefault("t_cluster", []).append(recovery.parts["cluster"] * 1000)
        if not without_api:
            self._values.setdefault("first command of the standby to fenced", []).append(
                (fenced - recovery.moments["detected"]) * 1000
            )
        self._count += 1
        self.told.append(
            f"{kind}: gap {handover.gap * 1000:.0f} ms, {len(between)} before and {len(after)} after the commit"
        )

    def report(self) -> Report:
        """Return the report."""
        report = Report(of_network("reflex", self._cluster))
        most = (self._deadline + PERIOD + SLACK) * 1000
        for name, values in sorted(self._values.items()):
            commands = name.startswith("commands")
            must = {"p95": most} if name == "all: robot's gap" else {}
            if name in ("commands of the old pod after the commit", BACK, "t_cluster"):
                must = {"max": 0.0}
            report.figure(name, values, unit="commands" if commands else "ms", must=must)
        report.note("deadline", f"{self._deadline * 1000:.0f} ms, commands every {PERIOD * 1000:.0f} ms")
        report.note("left out", f"{self._early} failures whose pod was late, and replaced, before it was made to fail")
        report.note("network policies", self._cluster)
        return report


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (Failed, Late) as error:
        sys.exit(str(error).partition(". ")[0])

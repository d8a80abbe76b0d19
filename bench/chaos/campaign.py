"""Runs a campaign: starts the robots, makes the faults at their times, waits until all is well again, and judges."""

from __future__ import annotations

import argparse
import math
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from bench.chaos import discovery, plan
from bench.chaos.apply import Faults
from bench.chaos.judge import Injected, Judgement, Seen, judge
from bench.chaos.report import Aftermath, kinds_table, summarize
from bench.chaos.robots import REFLEX_DEADLINE, CampaignRobot, start
from bench.chaos.witness import UNREACHABLE, Witness, dump
from bench.recovery import enforcer
from tests.e2e.conftest import CHART, install
from tests.e2e.faults import cluster, is_ready
from tests.e2e.kubectl import Kubectl
from tests.support.cluster import Cluster
from understudy.api import names

SETTLE = 120.0
"""Seconds from the last fault within which everything must be healthy and protected."""

QUIET = 5.0
"""Seconds for which it must stay so."""

ENDING = 40.0
"""Seconds that a pod may take to end beyond its grace period."""


def run(kubeconfig: Path, namespace: str, options: argparse.Namespace) -> int:
    """Run the campaign and return the exit status."""
    for number in (signal.SIGINT, signal.SIGTERM):  # whoever ends it: what was broken must be repaired
        signal.signal(number, signal.default_int_handler)
    muxed = [
        index for index in range(len(options.robots)) if options.mux == "all" or (options.mux == "half" and index % 2)
    ]
    faults = plan.plan(options.seed, options.faults, len(options.robots), options.every, options.only, muxed)
    # The campaign changes labels, so that it is seen how soon they are restored without the admission policy.
    install(kubeconfig, CHART, "--set", f"admission.labelWriters={{{Cluster(kubeconfig).user}}}")
    kubectl = Kubectl(kubeconfig, namespace)
    folder = Path(tempfile.gettempdir()) / f"understudy-chaos-{options.seed}"  # for who looks into a violation
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    kubectl("create", "namespace", namespace)
    try:
        robots = start(kubectl, options.robots, options.timeout, folder, muxed)
        with Witness(kubectl, [robot.workload for robot in robots], folder) as witness:
            begun = time.time()
            before = witness.memory()
            injected = _make(faults, Faults(kubectl, robots, witness))
            aftermath = _settle(robots, witness, before)
            if ill := [
                robot for robot in robots if any(why.startswith(f"{robot.workload}:") for why in aftermath.unwell)
            ]:
                parts = [pod for pod in witness.pods() if pod.name.startswith(tuple(robot.workload for robot in ill))]
                discovery.keep(kubectl, parts, folder)
            if aftermath.leaked:
                left = kubectl("get", "robotworkloads,pods,replicasets,networkpolicies,leases", "-o", "yaml")
                (folder / "left.yaml").write_text(left)
            judgements = [_judge(robot, witness, injected, begun, folder) for robot in robots]
    finally:
        _whole(kubectl)
        kubectl("delete", "namespace", namespace, "--wait=false")
        volumes = [one["metadata"]["name"] for one in kubectl.list("persistentvolumes")]
        for volume in (one for one in volumes if one.startswith(namespace)):
            kubectl("delete", "persistentvolume", volume, "--wait=false")
    report = summarize(options.seed, injected, judgements, aftermath, settled_within=SETTLE)
    command = (
        f"--faults {options.faults} --seed {options.seed} --robots {' '.join(options.robots)} --every {options.every:g} "
        f"--mux {options.mux}"
    )
    only = f" --only {' '.join(options.only)}" if options.only else ""
    report.note("campaign", f"scripts/bench chaos {command} --timeout {options.timeout:g}{only}")
    report.note("robots", ", ".join(f"{robot.name}{' (Mux)' if robot.muxed else ''}" for robot in robots))
    report.note("network policies", enforcer())
    if options.machine:
        report.note("what else the machine did", options.machine)
    print(report.table())
    print(f"\n{kinds_table(injected, judgements)}\n")
    print(report.write())
    print(f"logs of all containers, and what each robot received: {folder}")
    return 0 if report.held else 1


def _make(planned: Sequence[plan.Fault], faults: Faults) -> list[Injected]:
    begun = time.monotonic()
    try:
        for fault in planned:
            time.sleep(max(0.0, begun + fault.at - time.monotonic()))
            faults.begin(fault)
    finally:
        injected = faults.wait()
    return injected


def _whole(kubectl: Kubectl) -> None:
    """Undo what an interrupted campaign has left undone."""
    cluster("api", "start")
    for node in kubectl.list("nodes"):
        if not is_ready(node):
            cluster("node", "up", node["metadata"]["name"])


def _settle(robots: Sequence[CampaignRobot], witness: Witness, before: dict[tuple[str, int], float]) -> Aftermath:
    """Wait until all is well, and look at what is left."""
    begun = time.time()
    since, unwell = math.nan, ["nobody has looked"]
    while time.time() < begun + SETTLE + QUIET:
        with suppress(*UNREACHABLE):
            unwell = witness.unwell()
            since = math.nan if unwell else (time.time() if math.isnan(since) else since)
            if time.time() - since > QUIET:
                break
        time.sleep(0.5)
    while (leaked := _leaked(robots, witness)) and time.time() < begun + SETTLE:
        time.sleep(1.0)  # standbys that lost nodes brought back are deleted one after the other
    after = witness.memory()
    growth = {
        f"{name} ({pid})": after[name, pid] - size for (name, pid), size in before.items() if (name, pid) in after
    }
    counts = Counter(f"{found.last} ({found.source.split('/')[-1]})" for found in witness.tracebacks)
    return Aftermath((time.time() if unwell else since) - begun, unwell, leaked, growth, counts)


def _leaked(robots: Sequence[CampaignRobot], witness: Witness) -> list[str]:
    """Return pods that should be gone, and instances that nobody needs."""
    late = time.time() - ENDING
    found = [f"{pod.name} has been ending for long" for pod in witness.pods() if 0 < pod.deleted < late]
    for robot in robots:
        instances = witness.instances(robot.workload)
        wanted = 2 if robot.way.strategy in ("executing", "initialized") else 1
        if len(instances) > wanted:
            found.append(f"{robot.name} has {len(instances)} instances instead of {wanted}")
    known = {names.WORKLOAD, names.POOL, names.MONITORED, "app"}
    found += [f"{pod.name} has no label of ours" for pod in witness.pods() if pod.owner and not known & set(pod.labels)]
    return found


def _judge(
    robot: CampaignRobot, witness: Witness, injected: Sequence[Injected], begun: float, folder: Path
) -> Judgement:
    journal = robot.journal()
    seen = Seen(
        robot.name,
        robot.index,
        robot.timeout,
        REFLEX_DEADLINE if robot.way.reflex else 0.0,
        robot.muxed,
        commands=[command for command in journal.log.commands if command.received >= begun],
        commits=witness.commits(robot.workload),
        recoveries=[one for one in witness.recoveries(robot.workload) if one.moments.get("detected", 0.0) >= begun],
        steps=journal.steps,
        finished=journal.finished,
        goals=_ended(robot.goals()),
        nodes=witness.nodes(),
        monitors=witness.monitors(robot.workload),
        unmonitored=witness.unmonitored(robot.workload),
        evictions=witness.evictions(robot.workload),
        unled=witness.unled(),
        servers=witness.servers(robot.workload),
        astray=witness.astray(robot.workload),
        unstarted=witness.unstarted(robot.name),
        unmuxed=witness.unmuxed(robot.name),
        deleted=witness.deleted(),
        created=witness.created(),
    )
    dump(
        folder / f"{robot.name}.json",
        commits=seen.commits,
        recoveries=witness.records(robot.workload),
        commands=[(c.received, c.sent, c.source, c.sequence) for c in seen.commands],
        steps=seen.steps,
        finished=seen.finished,
        goals=seen.goals,
        monitors=seen.monitors,
        unmonitored=seen.unmonitored,
        evictions=seen.evictions,
        servers=seen.servers,
        astray=seen.astray,
        unled=seen.unled,
        unstarted=seen.unstarted,
        unmuxed=seen.unmuxed,
        deleted=seen.deleted,
        created=seen.created,
    )
    return judge(seen, injected)


def _ended(goals: dict[str, str]) -> dict[str, str]:
    """Return the goals without the one that the client still waits for."""
    last = list(goals)[-1:]
    return {goal: end for goal, end in goals.items() if end or goal not in last}

"""The command behind scripts/demo."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from datetime import UTC, datetime
from typing import Any

from understudy_demo import plot, timeline
from understudy_demo.kubectl import CommandFailed, Kubectl, run
from understudy_demo.play import FAILURES, NAMESPACE, STRATEGIES, WORKLOAD, Failure, NotSo, Play
from understudy_demo.recovery import OVERLAP_ALLOWED
from understudy_demo.robotview import RobotLog, parse
from understudy_demo.stage import BUILT, REPOSITORY, Stage

OUT = REPOSITORY / "out"


class Progress:
    """Lines with the seconds since the start, that of the script that runs this if there is one."""

    def __init__(self) -> None:
        self._start = float(os.environ.get("UNDERSTUDY_STARTED") or time.time())

    def __call__(self, text: str) -> None:
        """Print one."""
        print(f"[{time.time() - self._start:5.0f} s] {text}", flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Run the demo; 0 when every recovery was good."""
    try:
        return _demo(arguments)
    except KeyboardInterrupt:
        print("\nInterrupted. Existing objects stay as they are, and scripts/demo begins again.", flush=True)
        return 130


def _demo(arguments: list[str] | None) -> int:
    parser = argparse.ArgumentParser(prog="scripts/demo", add_help=False)
    parser.add_argument("--keep", action="store_true")
    parser.add_argument("--provider", choices=["kind", "local", "current"])
    parser.add_argument("--only", action="append", choices=list(STRATEGIES))
    parser.add_argument("--how", choices=FAILURES, default="deleted")
    parser.add_argument("--images")
    options = parser.parse_args(arguments)
    strategies = [name for name in STRATEGIES if not options.only or name in options.only]

    say = Progress()
    stage = Stage(options.provider, say, registry=options.images)
    try:
        stage.cluster()
        stage.images()
        stage.chart()
    except CommandFailed as error:
        say(f"FAILED while setting up: {error}")
        say("what was set up stays; the same command goes on from there")
        return 1
    kubectl = Kubectl(NAMESPACE, stage.environment)
    play = Play(kubectl, say, images=options.images or BUILT)
    try:
        failures, log = _perform(play, strategies, options.how, say)
    except (CommandFailed, NotSo) as error:
        system = stage.release_namespace
        print(play.scene())
        say(f"FAILED: {error}")
        print(
            "It stays as it is. Where to look next:\n"
            f"    {_environment(stage)}\n"
            f"    kubectl -n {NAMESPACE} describe robotworkload {WORKLOAD}\n"
            f"    kubectl -n {NAMESPACE} logs deploy/{WORKLOAD}-monitor\n"
            f"    kubectl -n {system} logs -l app.kubernetes.io/component=operator --prefix --tail=200\n"
            "and scripts/demo begins again."
        )
        return 1

    problems = [f"{failure.strategy}: {problem}" for failure in failures for problem in failure.problems]
    problems += _returns(log)
    _report(failures, log, problems, stage, options.provider)
    if options.keep:
        _rest(play, say)
        _invite(stage)
    else:
        play.clear()
        stage.remove()
    for problem in problems:
        say(f"PROBLEM: {problem}")
    say("done" if not problems else "done, with problems")
    return 1 if problems else 0


def _perform(play: Play, strategies: list[str], how: str, say: Progress) -> tuple[list[Failure], RobotLog]:
    play.clear()
    say(f"the quickstart: robot and application in namespace {NAMESPACE}")
    play.begin(strategies[0])
    failures = []
    for strategy in strategies:
        play.prepare(strategy)
        failure = play.fail(strategy, how)
        failures.append(failure)
        print(f"\n{timeline.render(failure.recovered, failure.handover)}\n", flush=True)
    text = play.raw_log()
    OUT.mkdir(exist_ok=True)
    (OUT / "robot.jsonl").write_text(text)
    return failures, parse(text)


def _rest(play: Play, say: Progress) -> None:
    """Leave it with the strategy that shows most."""
    try:
        play.prepare("executing")
    except (CommandFailed, NotSo) as error:
        say(f"left without an executing standby: {error}")


def _returns(log: RobotLog) -> list[str]:
    """Moments at which two pods were driving, by the robot's clock alone, beyond one enforcement of the gate."""
    late = log.returns()
    firsts = {reign.source: reign.first for reign in log.reigns()}
    order = log.sources()
    worst = 0.0
    for command in late:
        followers = order[order.index(command.source) + 1 :]
        worst = max(worst, command.received - min(firsts[name] for name in followers))
    if worst <= OVERLAP_ALLOWED:
        return []
    return [f"two pods drove the robot at once for up to {worst:.3f} s ({len(late)} commands)"]


def _report(failures: list[Failure], log: RobotLog, problems: list[str], stage: Stage, provider: str | None) -> None:
    recoveries = [failure.recovered for failure in failures]
    if len(recoveries) > 1:
        print("All to one scale:")
        print(timeline.compare(recoveries))
    title = f"Three failures, three strategies ({plot.taken(log)})" if len(failures) == 3 else plot.taken(log)
    plot.draw(log, recoveries, OUT / "demo.png", title=title)
    record = {
        "taken": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": _said(["git", "-C", str(REPOSITORY), "describe", "--always", "--dirty"]),
        "machine": {"system": platform.platform(), "python": platform.python_version()},
        "cluster": {"provider": provider, "status": stage.status(), "version": _version(stage)},
        "failures": [failure.to_json() for failure in failures],
        "commandsAtRobot": {source: len(times) for source, times in log.times().items()},
        "problems": problems,
    }
    (OUT / "demo.json").write_text(json.dumps(record, indent=2) + "\n")
    print("\nThe picture: out/demo.png. All of it as data: out/demo.json; what the robot wrote down: out/robot.jsonl\n")


def _version(stage: Stage) -> Any:
    return json.loads(run(["kubectl", "version", "-o", "json"], stage.environment))["serverVersion"]["gitVersion"]


def _said(command: list[str]) -> str | None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else None


def _environment(stage: Stage) -> str:
    tools = "export PATH=${XDG_CACHE_HOME:-$HOME/.cache}/understudy/tools:$PATH"
    return f"{tools} KUBECONFIG={stage.environment['KUBECONFIG']}"


def _invite(stage: Stage) -> None:
    removal = "\n".join(f"    {command}" for command in [f"kubectl delete namespace {NAMESPACE}", *stage.left()])
    print(
        f"""It is left running. In this or another terminal:
    {_environment(stage)}
    kubectl config set-context --current --namespace {NAMESPACE}
Look at it:
    kubectl get robotworkloads,failurepolicies,fallbackpools,pods
    kubectl describe robotworkload {WORKLOAD}
    kubectl logs -f deploy/robot-1 | grep '"command"'       # every command at the robot, with the pod that sent it
    kubectl get networkpolicy {WORKLOAD}-gate -o yaml        # who may drive: the whole switch
Let it fail in another way:
    # no operator is needed for a failover
    kubectl scale -n {stage.release_namespace} deploy/understudy-operator --replicas 0
    # frozen, not killed: to Kubernetes the process runs, and only its commands stop
    kubectl exec $(kubectl get robotworkload {WORKLOAD} -o jsonpath='{{.status.active}}') -c drive -- sh -c \\
        'for p in /proc/[0-9]*; do grep -q "[q]uickstart.application" $p/cmdline && kill -STOP ${{p#/proc/}}; done; true'
    kubectl get robotworkload {WORKLOAD} -o yaml            # status.recoveries
    kubectl scale -n {stage.release_namespace} deploy/understudy-operator --replicas 2
Try another strategy:
    kubectl apply -f examples/quickstart/manifests/strategies/
    kubectl patch robotworkload {WORKLOAD} --type merge \\
        -p '{{"spec":{{"failurePolicyRef":{{"name":"quickstart-uninitialized"}}}}}}'
    kubectl get robotworkload {WORKLOAD} -w                 # until its standby is ready: Uninitialized (1/1)
Remove it:
{removal}
"""
    )


if __name__ == "__main__":
    sys.exit(main())

"""``understudy inject NAME kill | freeze | slow | partition``: makes the active instance fail, to rehearse a recovery."""

from __future__ import annotations

import argparse
import time
from typing import Any

from understudy.api import names
from understudy.api.base import DURATION_MESSAGE, seconds
from understudy.cli.common import confirmation, option_rules
from understudy.cli.common.cluster_access.kubectl import WORKLOADS, Kubectl, add_options, add_robot
from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.robots import status_of
from understudy.cli.inject import fault_commands, partition

ALLOWED = f"{names.GROUP}/allow-inject"
"""Label of namespaces in which failures may be injected (value ``true``)."""

LONGEST = 600.0
"""Most seconds that a fault lasts."""

LENGTH, PERCENT = "10s", 80
"""Defaults of --for and --percent."""

FAULTS = ["kill", "freeze", "slow", "partition"]

_APPLIES_TO = {
    "--for": ("freeze", "slow", "partition"),
    "--percent": ("slow",),
    "--from": ("partition",),
    "--container": ("freeze", "slow"),
}
"""The faults to which an option applies."""


@reports_errors("inject")
def main(arguments: list[str]) -> int:
    """Run the command."""
    parser = _parser()
    options = parser.parse_args(arguments)
    for option, faults in _APPLIES_TO.items():
        option_rules.reject_unless(
            parser,
            options,
            options.fault in faults,
            option,
            f"applies to {option_rules.listed(faults)}, not to {options.fault}",
        )
    length = _length(LENGTH if options.length is None else options.length)
    kubectl = Kubectl(options)
    _allowed(kubectl)
    pod = _pod(kubectl, options.name)
    means = partition.means(kubectl, options.name, options.whom or ()) if options.fault == "partition" else None
    confirmation.confirm(
        f"Pod {pod} is the active instance of {options.name}. {options.fault.capitalize()} it?", yes=options.yes
    )
    if options.fault == "kill":
        kubectl.delete("pod", pod, "--grace-period=0", "--force")
        print(f"{pod} was force-deleted")
    elif means is not None:
        partition.cut_off(kubectl, pod, means, length)
    else:
        percent = 100 if options.fault == "freeze" else options.percent or PERCENT
        _stop(kubectl, pod, options.container or _container(kubectl, pod), length, percent)
    print(f"To see the recovery: understudy timeline -n {kubectl.namespace} {options.name}")
    return 0


def _length(value: str) -> float:
    try:
        length = seconds(value)
    except ValueError as error:
        raise CommandError(f'--for "{value}": {DURATION_MESSAGE}') from error
    if not 0 < length <= LONGEST:
        raise CommandError(f"--for {value}: give a duration above 0 and up to {LONGEST:g} s")
    return length


def _allowed(kubectl: Kubectl) -> None:
    """Raise CommandError unless the namespace's label allows fault injection."""
    labels = kubectl.get("namespaces", kubectl.namespace)["metadata"].get("labels") or {}
    if labels.get(ALLOWED) != "true":
        raise CommandError(
            f"namespace {kubectl.namespace} does not allow fault injection (label {ALLOWED}=true). If no robot in it can do "
            f"harm: kubectl label namespace {kubectl.namespace} {ALLOWED}=true"
        )


def _pod(kubectl: Kubectl, name: str) -> str:
    pod = status_of(kubectl.get(WORKLOADS, name)).active
    if not pod:
        raise CommandError(f"{name} has no active instance that could fail: understudy explain {name}")
    return pod


def _container(kubectl: Kubectl, pod: str) -> str:
    """Return the first container of the application."""
    containers: list[Any] = kubectl.get("pods", pod)["spec"]["containers"]
    found: str = next(one["name"] for one in containers if one["name"] != names.AGENT_CONTAINER)
    return found


def _stop(kubectl: Kubectl, pod: str, container: str, length: float, percent: int) -> None:
    """Stop the processes all or part of the time, and wait until the fault is over. Raises CommandError."""
    cycle = [f"{value:g}" for value in fault_commands.cycles(length, percent)]
    stopped = kubectl.execute(pod, container, "sh", "-c", fault_commands.FREEZE_AND_SLOW, "sh", *cycle).split()
    share = "" if percent >= 100 else f" {percent} % of the time"
    print(
        f"{pod}: {len(stopped) - 1} processes of container {container} are stopped{share}, for {length:g} s", flush=True
    )
    try:
        time.sleep(length)
    except KeyboardInterrupt:
        kubectl.execute(pod, container, "sh", "-c", fault_commands.UNDO, "sh", *stopped)
        print(f"\n{pod}: its processes continue", flush=True)
        return
    print(f"{pod}: its processes continue, if the pod still exists", flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy inject",
        description="Makes the active instance of a RobotWorkload fail, to see what Understudy does. Works only in a namespace whose "
        f"label {ALLOWED}=true allows it.",
        epilog="Exit status: 0 if the fault was injected, 2 if it was not.",
    )
    option_rules.add_examples(
        parser,
        "understudy inject robot-1 freeze -n fleet --for 10s",
        "understudy inject robot-1 partition --from monitor --yes",
    )
    add_robot(parser)
    parser.add_argument(
        "fault",
        choices=FAULTS,
        help="kill: force-delete its pod. freeze: stop its processes, which Kubernetes still sees as running. slow: stop them for a part "
        "of every tenth of a second. partition: cut its pod off from the network",
    )
    parser.add_argument(
        "--for",
        metavar="DURATION",
        dest="length",
        help=f"how long the fault lasts (default: {LENGTH})",
    )
    parser.add_argument(
        "--percent", type=option_rules.whole(1, 99, "; use freeze for 100"), metavar="1..99",
        help=f"slow: the share of the time for which the processes are stopped (default: {PERCENT})",
    )  # fmt: skip
    parser.add_argument(
        "--from", metavar="WHOM", dest="whom", action="append",
        help=f"partition: cut off only from this peer: the word {partition.MONITOR} (the pod of the workload's monitor), an IP address or "
        "a CIDR; may be given several times (default: everything)",
    )  # fmt: skip
    parser.add_argument(
        "-c",
        "--container",
        help="the container whose processes are stopped (default: the first container of the application)",
    )
    confirmation.add_option(parser)
    add_options(parser)
    return parser

"""``understudy inject NAME kill | freeze | slow | partition``: makes the instance in control fail, for who rehearses it."""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

from understudy.api import names
from understudy.api.base import DURATION_MESSAGE, seconds
from understudy.cli.common import confirmation, option_rules
from understudy.cli.common.errors import CommandError
from understudy.cli.common.kubectl import WORKLOADS, Kubectl, add_options
from understudy.cli.common.robots import status_of
from understudy.cli.inject import fault_commands, partition

DONE, CANT = 0, 2
"""Exit statuses."""

ALLOWED = f"{names.GROUP}/allow-inject"
"""On namespaces in which failures may be made (value ``true``)."""

LONGEST = 600.0
"""Seconds that a fault lasts at most."""

LENGTH, PERCENT = "10s", 80
"""What is meant where --for and --percent aren't given."""

FAULTS = ["kill", "freeze", "slow", "partition"]

_MEANT_FOR = {
    "--for": ("freeze", "slow", "partition"),
    "--percent": ("slow",),
    "--from": ("partition",),
    "--container": ("freeze", "slow"),
}
"""The faults for which an option says something."""


def main(arguments: list[str]) -> int:
    """Run the command."""
    parser = _parser()
    given = parser.parse_args(arguments)
    for option, meant in _MEANT_FOR.items():
        option_rules.only(
            parser, given, given.fault in meant, option, f"is for {option_rules.listed(meant)}, not for {given.fault}"
        )
    try:
        length = _length(LENGTH if given.length is None else given.length)
        kubectl = Kubectl(given)
        _allowed(kubectl)
        pod = _pod(kubectl, given.name)
        means = partition.means(kubectl, given.name, given.whom or ()) if given.fault == "partition" else None
        confirmation.confirm(
            f"Pod {pod} drives the robot of {given.name}. {given.fault.capitalize()} it?", yes=given.yes
        )
        if given.fault == "kill":
            kubectl.delete("pod", pod, "--grace-period=0", "--force")
            print(f"{pod} was deleted by force")
        elif means is not None:
            partition.cut_off(kubectl, pod, means, length)
        else:
            percent = 100 if given.fault == "freeze" else given.percent or PERCENT
            _stop(kubectl, pod, given.container or _container(kubectl, pod), length, percent)
        print(f"What became of it: understudy timeline -n {kubectl.namespace} {given.name}")
        return DONE
    except CommandError as error:
        print(f"understudy inject: {error}", file=sys.stderr)
        return CANT


def _length(given: str) -> float:
    try:
        length = seconds(given)
    except ValueError as error:
        raise CommandError(f'--for "{given}": {DURATION_MESSAGE}') from error
    if not 0 < length <= LONGEST:
        raise CommandError(f"--for {given}: a fault lasts longer than nothing, and {LONGEST:g} s at most")
    return length


def _allowed(kubectl: Kubectl) -> None:
    """Raise CommandError where the namespace's owner hasn't said that failures may be made."""
    labels = kubectl.get("namespaces", kubectl.namespace)["metadata"].get("labels") or {}
    if labels.get(ALLOWED) != "true":
        raise CommandError(
            f"namespace {kubectl.namespace} isn't for rehearsals, since it hasn't the label {ALLOWED}=true. Where no robot in it can do "
            f"harm: kubectl label namespace {kubectl.namespace} {ALLOWED}=true"
        )


def _pod(kubectl: Kubectl, name: str) -> str:
    pod = status_of(kubectl.get(WORKLOADS, name)).active
    if not pod:
        raise CommandError(
            f"no instance of {name} is in control, so there is nothing to fail: understudy explain {name}"
        )
    return pod


def _container(kubectl: Kubectl, pod: str) -> str:
    """The first container that isn't ours."""
    containers: list[Any] = kubectl.get("pods", pod)["spec"]["containers"]
    found: str = next(one["name"] for one in containers if one["name"] != names.AGENT_CONTAINER)
    return found


def _stop(kubectl: Kubectl, pod: str, container: str, length: float, percent: int) -> None:
    """Stop its processes, all or a part of the time, and wait until that is over. Raises CommandError."""
    given = [f"{value:g}" for value in fault_commands.cycles(length, percent)]
    said = kubectl.execute(pod, container, "sh", "-c", fault_commands.FREEZE_AND_SLOW, "sh", *given).split()
    share = "" if percent >= 100 else f" for {percent} % of the time"
    print(f"{pod}: {len(said) - 1} processes of container {container} are stopped{share}, for {length:g} s", flush=True)
    try:
        time.sleep(length)
    except KeyboardInterrupt:
        kubectl.execute(pod, container, "sh", "-c", fault_commands.UNDO, "sh", *said)
        print(f"\n{pod}: its processes go on", flush=True)
        return
    print(f"{pod}: its processes go on, where it is still there", flush=True)


def _percent(text: str) -> int:
    if not text.isascii() or not text.isdigit() or not 0 < int(text) < 100:
        raise argparse.ArgumentTypeError(
            f"{text!r}: give a whole number from 1 to 99; what stands still all the time is a freeze"
        )
    return int(text)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy inject",
        description="Makes the instance of a RobotWorkload fail that is in control, to see what Understudy does. Only in a namespace whose "
        f"label {ALLOWED}=true says that this is allowed.",
        epilog="Exit status: 0 where the fault was made, 2 where it wasn't.",
    )
    parser.add_argument("name", metavar="NAME", help="the RobotWorkload")
    parser.add_argument(
        "fault",
        choices=FAULTS,
        help="kill: its pod is deleted by force. freeze: its processes are stopped, and to Kubernetes they run. slow: the same for a part "
        "of the time, a tenth of a second after the other. partition: its pod is cut off from the network",
    )
    parser.add_argument(
        "--for",
        metavar="DURATION",
        dest="length",
        help=f"how long it is frozen, slow or cut off ({LENGTH})",
    )
    parser.add_argument(
        "--percent", type=_percent, metavar="1..99",
        help=f"slow: the share of the time for which it is stopped ({PERCENT})",
    )  # fmt: skip
    parser.add_argument(
        "--from", metavar="WHOM", dest="whom", action="append",
        help=f"partition: from whom alone it is cut off: {partition.MONITOR} (its monitor's pod), an address or a network; may be given "
        "more than once. Without it, from everything",
    )  # fmt: skip
    parser.add_argument("-c", "--container", help="whose processes; without it, the first one of the application")
    confirmation.add_option(parser)
    add_options(parser)
    return parser

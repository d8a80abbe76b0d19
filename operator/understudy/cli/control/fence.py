"""``understudy fence NAME``: shuts everybody out of a robot by hand, until somebody lets them in again."""

from __future__ import annotations

import argparse
import sys
import time

from understudy.api import names
from understudy.api.kinds.pause_spec import Pause
from understudy.cli.common import confirmation, terminal
from understudy.cli.common.errors import CommandError
from understudy.cli.common.kubectl import WORKLOADS, Kubectl, add_options
from understudy.cli.common.robots import UNWATCHED, robot, status_of
from understudy.cli.common.wording import wrapped
from understudy.cli.control import signature
from understudy.kube.client import Object
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateKind, GateRecord

FENCED, UNSURE, CANT = 0, 1, 2
"""Exit statuses."""

HEARD_WITHIN = 30.0
"""Seconds for which the gate is kept closed against a monitor that hasn't said that it has heard of the pause: one that is
recovering the workload finishes that first.
"""

LOOK = 0.3
"""Seconds between two looks."""

TRIES = 10
"""Times that the gate is written to where others write to it too."""


def main(arguments: list[str]) -> int:
    """Run the command."""
    given = _parser().parse_args(arguments)
    try:
        pause = signature.signed(given, "fenced", before="fenced: ")
        kubectl = Kubectl(given)
        item = kubectl.get(WORKLOADS, given.name)
        confirmation.confirm(
            f"{given.name} drives a robot, which will be told nothing from then on. Close its gate?", yes=given.yes
        )
        return _fence(kubectl, item, pause)
    except CommandError as error:
        print(f"understudy fence: {error}", file=sys.stderr)
        return CANT


def _fence(kubectl: Kubectl, item: Object, pause: Pause) -> int:
    name, kind = item["metadata"]["name"], registry.of(item)
    # The pause goes first: a monitor opens a gate that is closed for no reason that it knows.
    kubectl.patch(WORKLOADS, name, {"spec": {"pause": pause.to_wire() | {"until": None}}})
    shut_out, epoch = _close(kubectl, name, kind)
    where = f"{item['metadata']['namespace']}/{name}"
    _say(f"{where}: gate closed at epoch {epoch} (shut out: {', '.join(shut_out) or 'nobody was in control'}).")
    heard = robot(item).health == UNWATCHED or _heard(kubectl, name, kind)
    _close(kubectl, name, kind)
    _say(
        f"It is {pause.words}. No command is sent to the robot instead: see that it stands. understudy resume {name} lets an instance in "
        "again, and the robot is driven on at once."
    )
    if heard:
        return FENCED
    print(
        f"understudy fence: its monitor hasn't said within {HEARD_WITHIN:g} s that it leaves it alone, and may open the gate again when a "
        f"recovery that is under way ends: see understudy explain {name}, and fence it again",
        file=sys.stderr,
    )
    return UNSURE


def _say(text: str) -> None:
    print("\n".join(wrapped(text, terminal.columns(sys.stdout), indent=0)), flush=True)


def _close(kubectl: Kubectl, name: str, kind: GateKind) -> tuple[tuple[str, ...], int]:
    """Close the gate where it isn't; who was let through, and its epoch then. Raises CommandError."""
    resource, what = kind.resource.qualified, f"{kind.object_kind} {names.gate(name)}"
    for _ in range(TRIES):
        gate = kubectl.find(resource, names.gate(name))
        if gate is None:
            raise CommandError(f"{what} does not exist, so no instance is let through: see understudy explain {name}")
        record, let_in = GateRecord.of(gate), kind.let_through(gate)
        if not let_in and not record.active:
            return (), record.epoch
        try:
            kubectl.patch(resource, names.gate(name), kind.commitment(name, over=record))
        except CommandError:
            found = kubectl.find(resource, names.gate(name))
            if found is None or GateRecord.of(found).version == record.version:
                raise
            continue  # another writer was first
        return let_in, record.epoch + 1
    raise CommandError(f"others write {what} all the time: delete the pod in control")


def _heard(kubectl: Kubectl, name: str, kind: GateKind) -> bool:
    """Wait until the monitor says that it leaves the workload alone, with the gate kept closed; whether it did."""
    end = time.monotonic() + HEARD_WITHIN
    while time.monotonic() < end:
        _close(kubectl, name, kind)
        said = status_of(kubectl.get(WORKLOADS, name)).conditions or []
        if any((one.type, one.status) == ("Paused", "True") and "fenced: " in one.message for one in said):
            return True
        time.sleep(LOOK)
    return False


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy fence",
        description="Closes the gate of a RobotWorkload: none of its instances' outputs reach the robot any more, as soon as the network "
        "enforces it. And pauses the workload, so that nobody opens the gate again before understudy resume does. It is no "
        "emergency stop: what the robot does without commands is its own affair.",
        epilog="Exit status: 0 where the gate is closed and its monitor leaves it so, 1 where it is closed and the monitor hasn't said so, "
        "2 where it can't be done.",
    )
    parser.add_argument("name", metavar="NAME", help="the RobotWorkload")
    signature.add_options(parser, reason="why, for whoever finds it so")
    confirmation.add_option(parser)
    add_options(parser)
    return parser

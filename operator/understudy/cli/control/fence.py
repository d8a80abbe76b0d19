"""``understudy fence NAME``: closes the gate of a workload by hand, until somebody resumes the workload."""

from __future__ import annotations

import argparse
import sys
import time

from understudy.api import names
from understudy.api.kinds.pause_spec import Pause
from understudy.cli.common import confirmation
from understudy.cli.common.cluster_access.kubectl import WORKLOADS, Kubectl, add_options
from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.robots import UNWATCHED, robot, status_of
from understudy.cli.common.text import terminal
from understudy.cli.common.text.wording import wrapped
from understudy.cli.control import signature
from understudy.kube.client import Object
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateKind, GateRecord

FENCED, UNSURE = 0, 1
"""Exit statuses besides ERROR."""

CONFIRM_WITHIN = 30.0
"""Seconds for which this command keeps the gate closed until the monitor reports the pause. A monitor that is recovering the workload
finishes the recovery first.
"""

CHECK_PERIOD = 0.3
"""Seconds between two reads."""

TRIES = 10
"""Attempts to write the gate while others write it too."""


@reports_errors("fence")
def main(arguments: list[str]) -> int:
    """Run the command."""
    options = _parser().parse_args(arguments)
    pause = signature.signed(options, "fenced", before="fenced: ")
    kubectl = Kubectl(options)
    item = kubectl.get(WORKLOADS, options.name)
    confirmation.confirm(
        f"{options.name} controls a robot. When the gate is closed, the robot receives no commands. Close the gate?",
        yes=options.yes,
    )
    return _fence(kubectl, item, pause)


def _fence(kubectl: Kubectl, item: Object, pause: Pause) -> int:
    name, kind = item["metadata"]["name"], registry.of(item)
    # The pause goes first: a monitor that does not know of it would open the gate again.
    kubectl.patch(WORKLOADS, name, {"spec": {"pause": pause.to_wire() | {"until": None}}})
    fenced, epoch = _close(kubectl, name, kind)
    where = f"{item['metadata']['namespace']}/{name}"
    _print(f"{where}: gate closed at epoch {epoch} (fenced: {', '.join(fenced) or 'no instance was active'}).")
    reported = robot(item).health == UNWATCHED or _monitor_reports_pause(kubectl, name, kind)
    _close(kubectl, name, kind)
    _print(
        f"The workload is {pause.words}. WARNING: no safe command is sent to the robot. Make sure that the robot stands still. After "
        f"understudy resume {name}, the gate opens for an instance, and the robot can move at once."
    )
    if reported:
        return FENCED
    print(
        f"understudy fence: the gate is closed, but the monitor did not confirm the pause within {CONFIRM_WITHIN:g} s. If a recovery is in "
        f"progress, the monitor may open the gate again. Run understudy explain {name}, and then understudy fence {name} again",
        file=sys.stderr,
    )
    return UNSURE


def _print(text: str) -> None:
    print("\n".join(wrapped(text, terminal.columns(sys.stdout), indent=0)), flush=True)


def _close(kubectl: Kubectl, name: str, kind: GateKind) -> tuple[tuple[str, ...], int]:
    """Close the gate unless it is closed, and return the instances that it selected and its epoch before. Raises
    CommandError."""
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
    raise CommandError(
        f"other processes keep changing {what}, so it could not be closed. To stop the active instance, delete its pod"
    )


def _monitor_reports_pause(kubectl: Kubectl, name: str, kind: GateKind) -> bool:
    """Keep the gate closed until the monitor reports the pause, and return whether it did in time."""
    end = time.monotonic() + CONFIRM_WITHIN
    while time.monotonic() < end:
        _close(kubectl, name, kind)
        conditions = status_of(kubectl.get(WORKLOADS, name)).conditions or []
        if any((one.type, one.status) == ("Paused", "True") and "fenced: " in one.message for one in conditions):
            return True
        time.sleep(CHECK_PERIOD)
    return False


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy fence",
        description="Closes the gate of a RobotWorkload: as soon as the network enforces this, no output of its "
        "instances reaches the robot. Also pauses the workload, so that the gate stays closed until understudy "
        "resume. This is not an emergency stop: what the robot does without commands is up to the robot.",
        epilog=f"Exit status: 0 if the gate is closed and the monitor has confirmed the pause (or does not run), 1 if the gate is closed "
        f"but the monitor has not confirmed the pause within {CONFIRM_WITHIN:g} s, so it may open the gate again (run understudy explain "
        "NAME, and then this command again), 2 on an error.",
    )
    parser.add_argument("name", metavar="NAME", help="the RobotWorkload")
    signature.add_options(parser, reason="why the workload is fenced, for other users")
    confirmation.add_option(parser)
    add_options(parser)
    return parser

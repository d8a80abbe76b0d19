"""``understudy fence NAME``: closes the gate of a workload by hand, until somebody resumes the workload."""

from __future__ import annotations

import argparse
import sys

from understudy.api import names
from understudy.api.kinds.pause_spec import FENCE, Pause
from understudy.cli.common import confirmation
from understudy.cli.common.cluster_access.kubectl import WORKLOADS, Kubectl, add_dry_run, add_options, add_robot
from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.option_rules import add_examples
from understudy.cli.common.text import terminal
from understudy.cli.common.text.wording import wrapped
from understudy.cli.control import signature
from understudy.failover.abandoned import ended
from understudy.failover.progress import beside
from understudy.kube.client import Object
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateKind, GateRecord

TRIES = 10
"""Attempts to write the gate while others write it too."""


@reports_errors("fence")
def main(arguments: list[str]) -> int:
    """Run the command."""
    options = _parser().parse_args(arguments)
    pause = signature.signed(options, "fenced", before=FENCE)
    kubectl = Kubectl(options)
    item = kubectl.get(WORKLOADS, options.name)
    confirmation.confirm(
        f"{options.name} controls a robot. When the gate is closed, the robot receives no commands. Close the gate?",
        yes=options.yes or kubectl.dry_run,
    )
    return _fence(kubectl, item, pause)


def _fence(kubectl: Kubectl, item: Object, pause: Pause) -> int:
    name, kind = item["metadata"]["name"], registry.of(item)
    # The pause goes first: its generation is part of the gate's record. A monitor that has not received the pause learns of it there.
    paused = kubectl.patch(WORKLOADS, name, {"spec": {"pause": pause.to_wire() | {"until": None}}})
    fenced, epoch = _close(kubectl, name, kind, paused["metadata"]["generation"])
    where = f"{item['metadata']['namespace']}/{name}"
    result = f"{where}: gate closed at epoch {epoch} (fenced: {', '.join(fenced) or 'no instance was active'})."
    _print(kubectl.shown(result))
    if kubectl.dry_run:
        return 0
    _print(
        f"The workload is {pause.words}. WARNING: no safe command is sent to the robot. Make sure that the robot stands still. After "
        f"understudy resume {name}, the gate opens for an instance, and the robot can move at once."
    )
    if kind.fence_hint:
        _print(kind.fence_hint)
    return 0


def _print(text: str) -> None:
    print("\n".join(wrapped(text, terminal.columns(sys.stdout), indent=0)), flush=True)


def _close(kubectl: Kubectl, name: str, kind: GateKind, generation: int) -> tuple[tuple[str, ...], int]:
    """Close the gate until the pause of this generation ends, and return the instances that it selected and its new epoch.

    A closed gate is written too: the API server then refuses what a monitor has sent before. Raises CommandError.
    """
    resource, what = kind.resource.qualified, f"{kind.object_kind} {names.gate(name)}"
    for _ in range(TRIES):
        gate = kubectl.find(resource, names.gate(name))
        if gate is None:
            raise CommandError(f"{what} does not exist, so no instance is let through: see understudy explain {name}")
        record = GateRecord.of(gate)
        try:
            kubectl.patch(resource, names.gate(name), fencing(kind, name, record, generation))
        except CommandError:
            found = kubectl.find(resource, names.gate(name))
            if found is None or GateRecord.of(found).version == record.version:
                raise
            continue  # another writer was first
        return kind.let_through(gate), record.epoch + 1
    raise CommandError(
        f"other processes keep changing {what}, so it could not be closed. To stop the active instance, delete its pod"
    )


def fencing(kind: GateKind, name: str, over: GateRecord, generation: int) -> Object:
    """Return the patch that closes the gate until the pause of this generation ends.

    A recovery under way ends. Its record stays, since it names the pods that have failed and are to be deleted.
    """
    recovery = over.recovery
    if (found := beside(recovery)) is not None and found.result == "Running":
        recovery = ended(found).model_dump_json()
    return kind.commitment(name, over=over, recovery=recovery, fenced=generation)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy fence",
        description="Closes the gate of a RobotWorkload: as soon as the network (or the mux at the robot) enforces this, no output of its "
        "instances reaches the robot. Also pauses the workload, so that the gate stays closed until understudy "
        "resume. This is not an emergency stop: what the robot does without commands is up to the robot.",
        epilog="Exit status: 0 if the gate is closed, 2 on an error.",
    )
    add_examples(
        parser,
        'understudy fence robot-1 -n fleet --reason "it left its lane"',
        "understudy fence robot-1 --reason rehearsal --dry-run=server",
    )
    add_robot(parser)
    signature.add_options(parser, reason="why the workload is fenced, for other users")
    confirmation.add_option(parser)
    add_dry_run(parser)
    add_options(parser)
    return parser

"""``understudy resume NAME``: ends a workload's pause and resets what its limits stopped."""

from __future__ import annotations

import argparse
import contextlib
import time

from understudy.api import names
from understudy.api.plain_text import plain
from understudy.cli.common.cluster_access.kubectl import WORKLOADS, Kubectl, add_dry_run, add_options, add_robots
from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.option_rules import add_examples
from understudy.cli.control import signature
from understudy.failover.progress import rfc3339
from understudy.kube.client import Object
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateRecord


@reports_errors("resume")
def main(arguments: list[str]) -> int:
    """Run the command."""
    options = _parser().parse_args(arguments)
    why = _why(options)
    kubectl = Kubectl(options)
    for name in options.names:
        _resume(kubectl, name, why)
    return 0


def _resume(kubectl: Kubectl, name: str, why: str | None) -> None:
    before = kubectl.get(WORKLOADS, name)
    # Without a reason, remove that of an earlier resume.
    word = {"metadata": {"annotations": {names.RESUMED: rfc3339(time.time()), names.RESUMED_FOR: why}}}
    item = kubectl.patch(WORKLOADS, name, word | {"spec": {"pause": None}})
    _free_gate(kubectl, item)
    where = f"{item['metadata']['namespace']}/{item['metadata']['name']}"
    pause = (before.get("spec") or {}).get("pause")
    was = f"pause ended; it was paused by {pause.get('owner')}: {pause.get('reason')}" if pause else "it was not paused"
    result = f"{where}: {plain(was)}. A failure is recovered at once again, and the budget (limits.budget) is reset."
    print(kubectl.shown(result), flush=True)


def _free_gate(kubectl: Kubectl, item: Object) -> None:
    """Remove the fence from the gate. Monitors compare it with the generation of the workload, which begins again in a restored backup."""
    resource, gate = registry.of(item).resource.qualified, names.gate(item["metadata"]["name"])
    with contextlib.suppress(
        CommandError
    ):  # not every user who may resume a robot may write its gate, and usually nobody has to
        if (found := kubectl.find(resource, gate)) is not None and GateRecord.of(found).fenced:
            kubectl.patch(resource, gate, {"metadata": {"annotations": {names.FENCED: None}}})


def _why(options: argparse.Namespace) -> str | None:
    """Return who resumes it and why; None if no reason is given. Raises CommandError if it is empty."""
    if options.reason is None:
        return None
    signature.refuse_empty(options, "resumed")
    return f"{options.owner[:128]}: {options.reason[:256]}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy resume",
        description="Ends the pause of a RobotWorkload. The monitor then acts again: it opens a gate that "
        "understudy fence closed, for an instance that is ready. The command also resets the budget "
        "(limits.budget), so that a recovery that a limit deferred starts at once.",
        epilog="Exit status: 0 if it was resumed, 2 on an error.",
    )
    add_examples(
        parser, "understudy resume robot-1 -n fleet", 'understudy resume robot-1 --reason "the gripper is mounted"'
    )
    add_robots(parser, required=True)
    signature.add_options(parser, reason="what was found or done, for the record", required=False)
    add_dry_run(parser)
    add_options(parser)
    return parser

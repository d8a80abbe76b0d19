"""``understudy resume NAME``: ends a workload's pause, and says that somebody has looked at what its limits stopped."""

from __future__ import annotations

import argparse
import sys
import time

from understudy.api import names
from understudy.cli.common.errors import CommandError
from understudy.cli.common.kubectl import WORKLOADS, Kubectl, add_options
from understudy.cli.control import signature
from understudy.failover.progress import rfc3339

DONE, CANT = 0, 2
"""Exit statuses."""


def main(arguments: list[str]) -> int:
    """Run the command."""
    given = _parser().parse_args(arguments)
    try:
        why = _why(given)
        kubectl = Kubectl(given)
        before = kubectl.get(WORKLOADS, given.name)
        # Without a reason that of an earlier time goes: it isn't this one's.
        word = {"metadata": {"annotations": {names.RESUMED: rfc3339(time.time()), names.RESUMED_FOR: why}}}
        item = kubectl.patch(WORKLOADS, given.name, word | {"spec": {"pause": None}})
    except CommandError as error:
        print(f"understudy resume: {error}", file=sys.stderr)
        return CANT
    where = f"{item['metadata']['namespace']}/{item['metadata']['name']}"
    pause = (before.get("spec") or {}).get("pause")
    was = f"no longer paused by {pause.get('owner')}: {pause.get('reason')}" if pause else "it wasn't paused"
    print(f"{where}: {was}. Whatever fails now is recovered at once; what was spent of limits.budget is forgotten.")
    return DONE


def _why(given: argparse.Namespace) -> str | None:
    """Who resumes it and why, in words; None where that isn't told. Raises CommandError where it is empty."""
    if given.reason is None:
        return None
    signature.refuse_empty(given, "resumed")
    return f"{given.owner[:128]}: {given.reason[:256]}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy resume",
        description="Ends the pause of a RobotWorkload. What was spent of limits.budget before doesn't count any more, and nothing that "
        "was to be tried again later is waited for.",
        epilog="Exit status: 0 where it goes on, 2 where that can't be done.",
    )
    parser.add_argument("name", metavar="NAME", help="the RobotWorkload")
    signature.add_options(parser, reason="what was found or done, for whoever asks why it goes on", required=False)
    add_options(parser)
    return parser

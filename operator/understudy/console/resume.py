"""``understudy resume NAME``: ends a workload's pause, and says that somebody has looked at what its limits stopped."""

from __future__ import annotations

import argparse
import sys
import time

from understudy.api import names
from understudy.console.kubectl import WORKLOADS, Kubectl, Unusable, add_options
from understudy.mitigation.progress import rfc3339

DONE, CANT = 0, 2
"""Exit statuses."""


def main(arguments: list[str]) -> int:
    """Run the command."""
    given = _parser().parse_args(arguments)
    try:
        kubectl = Kubectl(given)
        before = kubectl.get(WORKLOADS, given.name)
        word = {"metadata": {"annotations": {names.RESUMED: rfc3339(time.time())}}}
        item = kubectl.patch(WORKLOADS, given.name, word | {"spec": {"pause": None}})
    except Unusable as error:
        print(f"understudy resume: {error}", file=sys.stderr)
        return CANT
    where = f"{item['metadata']['namespace']}/{item['metadata']['name']}"
    pause = (before.get("spec") or {}).get("pause")
    was = f"no longer paused by {pause.get('owner')}: {pause.get('reason')}" if pause else "it wasn't paused"
    print(f"{where}: {was}. Whatever fails now is recovered at once; what was spent of limits.budget is forgotten.")
    return DONE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy resume",
        description="Ends the pause of a RobotWorkload. What was spent of limits.budget before doesn't count any more, and nothing that "
        "was to be tried again later is waited for.",
        epilog="Exit status: 0 where it goes on, 2 where that can't be done.",
    )
    parser.add_argument("name", metavar="NAME", help="the RobotWorkload")
    add_options(parser)
    return parser

"""``understudy pause NAME``: suspends automatic recovery while somebody works on the robot or its application."""

from __future__ import annotations

import argparse
import re
import time
from datetime import UTC, datetime

from understudy.api.base import DURATION_MESSAGE, seconds
from understudy.api.kinds.pause_spec import Pause
from understudy.api.moments import MOMENT_MESSAGE, MOMENT_PATTERN, unix
from understudy.cli.common.cluster_access.kubectl import WORKLOADS, Kubectl, add_dry_run, add_options, add_robots
from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.option_rules import add_examples
from understudy.cli.control import signature


@reports_errors("pause")
def main(arguments: list[str]) -> int:
    """Run the command."""
    options = _parser().parse_args(arguments)
    pause = _pause(options, time.time())
    kubectl = Kubectl(options)
    for name in options.names:
        item = kubectl.patch(WORKLOADS, name, {"spec": {"pause": pause.to_wire() | _no_end(pause)}})
        where = f"{item['metadata']['namespace']}/{item['metadata']['name']}"
        result = f"{where}: {pause.words}. Understudy takes no action and sends no safe command. understudy resume ends the pause."
        print(kubectl.shown(result), flush=True)
    return 0


def _pause(options: argparse.Namespace, now: float) -> Pause:
    """Build the pause from the options. Raises CommandError."""
    until: str | None = options.until
    if options.length is not None:
        try:
            until = datetime.fromtimestamp(now + seconds(options.length), UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        except ValueError as error:
            raise CommandError(f'--for "{options.length}": {DURATION_MESSAGE}') from error
    if until is not None:
        end = unix(until) if re.match(MOMENT_PATTERN, until) else None
        if end is None:
            raise CommandError(f'--until "{until}": {MOMENT_MESSAGE}')
        if end <= now:
            raise CommandError(f"--until {until} is in the past")
    return signature.signed(options, "paused", until=until)


def _no_end(pause: Pause) -> dict[str, None]:
    """Return a patch that removes the end of an earlier pause if this one has none."""
    return {} if pause.until is not None else {"until": None}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy pause",
        description="Pauses a RobotWorkload (spec.pause): its monitor keeps watching and reporting, but does not act: "
        "no recovery, no planned switchover and no safe command. A recovery that is under way is completed first.",
        epilog="Exit status: 0 if it is paused now, 2 on an error.",
    )
    add_examples(
        parser,
        'understudy pause robot-1 --reason "a new gripper" --for 30m',
        'understudy pause robot-1 robot-2 -n fleet --reason "floor is cleaned"',
    )
    add_robots(parser, required=True)
    signature.add_options(parser, reason="why the workload is paused, for other users")
    end = parser.add_mutually_exclusive_group()
    end.add_argument("--until", metavar="TIME", help="time at which the pause ends, such as 2026-11-22T18:00:00Z")
    end.add_argument("--for", metavar="DURATION", dest="length", help="how long the pause lasts, such as 30m")
    add_dry_run(parser)
    add_options(parser)
    return parser

"""``understudy timeline NAME``: the last recoveries of a workload, by the parts of their time."""

from __future__ import annotations

import argparse
import sys
import time

from understudy.api.output_formats import structured
from understudy.cli.common import option_rules, recovery_text, terminal
from understudy.cli.common.errors import CommandError
from understudy.cli.common.kubectl import Kubectl, add_options
from understudy.cli.common.robots import status_of

SHOWN, CANT = 0, 2
"""Exit statuses."""

EACH = 3
"""How many are told one by one."""


def main(arguments: list[str]) -> int:
    """Run the command."""
    parser = _parser()
    given = parser.parse_args(arguments)
    option_rules.only(parser, given, given.output == "text", "--last", f"is for text: {given.output} has all of them")
    try:
        item = Kubectl(given).get("robotworkloads.understudy.dev", given.name)
        status = status_of(item)
    except CommandError as error:
        print(f"understudy timeline: {error}", file=sys.stderr)
        return CANT
    found, count = status.recoveries or [], status.recovery_count or 0
    if given.output != "text":
        told = {"recoveryCount": count, "recoveries": [recovery.to_wire() for recovery in found]}
        metadata = {key: item["metadata"][key] for key in ("namespace", "name")}
        print(structured({**metadata, **told}, given.output))
        return SHOWN
    told_lines = recovery_text.lines(
        f"{item['metadata']['namespace']}/{item['metadata']['name']}",
        count,
        found,
        last=EACH if given.last is None else given.last,
        now=time.time(),
        columns=terminal.columns(sys.stdout),
        colours=terminal.colours(sys.stdout),
    )
    print("\n".join(told_lines))
    return SHOWN


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy timeline",
        description="Shows the last recoveries of a RobotWorkload: all that its status keeps in one comparison, and the newest ones each "
        "with its parts to scale, its moments, what was handed over and what was tried in vain.",
        epilog="Exit status: 0 where they are shown, 2 where it can't be told.",
    )
    parser.add_argument("name", metavar="NAME", help="the RobotWorkload")
    parser.add_argument("--last", metavar="N", type=_count, help=f"how many are shown one by one ({EACH})")
    parser.add_argument(
        "-o", "--output", choices=["text", "json", "yaml"], default="text", help="text, or the records as JSON or YAML"
    )
    add_options(parser)
    return parser


def _count(text: str) -> int:
    if not (text.isdecimal() and int(text)):
        raise argparse.ArgumentTypeError(f"found {text!r:.50}; give a whole number from 1 on")
    return int(text)

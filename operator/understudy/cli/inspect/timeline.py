"""``understudy timeline NAME``: shows the last recoveries of a workload with the parts of their time."""

from __future__ import annotations

import argparse
import sys
import time

from understudy.api.output_formats import structured
from understudy.cli.common import option_rules
from understudy.cli.common.cluster_access.kubectl import Kubectl, add_options, add_robot
from understudy.cli.common.errors import reports_errors
from understudy.cli.common.robots import status_of
from understudy.cli.common.text import recovery_text, terminal

EACH = 3
"""How many recoveries are shown in detail."""


@reports_errors("timeline")
def main(arguments: list[str]) -> int:
    """Run the command."""
    parser = _parser()
    options = parser.parse_args(arguments)
    option_rules.reject_unless(
        parser,
        options,
        options.output == "text",
        "--last",
        f"applies to text only: {options.output} contains all recoveries",
    )
    item = Kubectl(options).get("robotworkloads.understudy.dev", options.name)
    status = status_of(item)
    found, count = status.recoveries or [], status.recovery_count or 0
    if options.output != "text":
        document = {"recoveryCount": count, "recoveries": [recovery.to_wire() for recovery in found]}
        metadata = {key: item["metadata"][key] for key in ("namespace", "name")}
        print(structured({**metadata, **document}, options.output))
        return 0
    text_lines = recovery_text.lines(
        f"{item['metadata']['namespace']}/{item['metadata']['name']}",
        count,
        found,
        last=EACH if options.last is None else options.last,
        now=time.time(),
        columns=terminal.columns(sys.stdout),
        colours=terminal.colours(sys.stdout),
    )
    print("\n".join(text_lines))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy timeline",
        description="Shows the last recoveries of a RobotWorkload: a comparison of all recoveries in its status, and the newest ones in "
        "detail, with the parts of their time drawn to scale, the time of each step, the restored state and failed attempts.",
        epilog="Exit status: 0 if they were shown, 2 if they could not be read.",
    )
    option_rules.add_examples(parser, "understudy timeline robot-1 -n fleet", "understudy timeline robot-1 --last 3")
    add_robot(parser)
    parser.add_argument(
        "--last", metavar="N", type=option_rules.whole(1), help=f"how many are shown in detail (default: {EACH})"
    )
    option_rules.add_output(parser, "text, or the records as JSON or YAML")
    add_options(parser)
    return parser

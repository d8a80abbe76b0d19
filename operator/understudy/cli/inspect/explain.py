"""``understudy explain NAME``: why a workload is as it is, what would happen if it failed now, and what is missing."""

from __future__ import annotations

import argparse
import sys

from understudy.api.output_formats import structured
from understudy.cli.common import terminal
from understudy.cli.common.errors import CommandError
from understudy.cli.common.kubectl import Kubectl, add_options
from understudy.cli.inspect import explanation
from understudy.cli.inspect.cluster_observation import around
from understudy.cli.inspect.explanation import Known

WELL, NOT_WELL, CANT = 0, 1, 2
"""Exit statuses."""


def main(arguments: list[str]) -> int:
    """Run the command."""
    given = _parser().parse_args(arguments)
    try:
        known = Known.of(around(Kubectl(given), given.name))
        out = sys.stdout
        if given.output == "text":
            print("\n".join(explanation.lines(known, columns=terminal.columns(out), colours=terminal.colours(out))))
        else:
            print(structured(explanation.for_scripts(known), given.output))
        return WELL if known.is_well else NOT_WELL
    except CommandError as error:
        print(f"understudy explain: {error}", file=sys.stderr)
        return CANT


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy explain",
        description="Says of a RobotWorkload why it is as it is, which strategy would be carried out if it failed now and why those "
        "before it couldn't, what its pools have, and what is missing, each with the way out. It judges by the operator's own rules "
        "what the cluster has at this moment, and acts on nothing.",
        epilog="Exit status: 0 where it is protected and healthy (or degraded), 1 where it isn't, 2 where it can't be told.",
    )
    parser.add_argument("name", metavar="NAME", help="the RobotWorkload")
    parser.add_argument(
        "-o", "--output", choices=["text", "json", "yaml"], default="text", help="text, or all of it as JSON or YAML"
    )
    add_options(parser)
    return parser

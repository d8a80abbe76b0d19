"""``understudy explain NAME``: explains a workload's state, what a failure would trigger now, and what is missing."""

from __future__ import annotations

import argparse
import sys

from understudy.api.output_formats import structured
from understudy.cli.common.cluster_access.kubectl import Kubectl, add_options, add_robot
from understudy.cli.common.errors import reports_errors
from understudy.cli.common.option_rules import add_examples, add_output
from understudy.cli.common.text import terminal
from understudy.cli.inspect import explanation
from understudy.cli.inspect.cluster_observation import around
from understudy.cli.inspect.explanation import Facts

HEALTHY, NOT_HEALTHY = 0, 1
"""Exit statuses besides ERROR."""


@reports_errors("explain")
def main(arguments: list[str]) -> int:
    """Run the command."""
    options = _parser().parse_args(arguments)
    known = Facts.of(around(Kubectl(options), options.name))
    out = sys.stdout
    if options.output == "text":
        print("\n".join(explanation.lines(known, columns=terminal.columns(out), colours=terminal.colours(out))))
    else:
        print(structured(explanation.for_scripts(known), options.output))
    return HEALTHY if known.is_well else NOT_HEALTHY


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy explain",
        description="Explains the state of a RobotWorkload: which strategy a failure would trigger now, why the strategies "
        "before it are not available, what its pools provide, and what is missing, each with a remedy. It applies the operator's own rules "
        "to the current state of the cluster, and changes nothing.",
        epilog="Exit status: 0 if the workload is protected (the monitor watches it, and the first strategy of its policy could run now) "
        "and healthy (or degraded), 1 if it is not, 2 if this cannot be determined.",
    )
    add_examples(parser, "understudy explain robot-1 -n fleet", "understudy explain rw/robot-1 -o json")
    add_robot(parser)
    add_output(parser)
    add_options(parser)
    return parser

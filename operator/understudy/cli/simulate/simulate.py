"""``understudy simulate POLICY --bag BAG``: reports what a policy's health tree would have detected in a recording, and when."""

from __future__ import annotations

import argparse
from pathlib import Path

from understudy.api.output_formats import structured
from understudy.cli.common import plot_files
from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.option_rules import add_examples, add_output
from understudy.cli.common.text import terminal
from understudy.cli.simulate import fault_times, policy_file
from understudy.cli.simulate.bags import Bag
from understudy.cli.simulate.replay import replay
from understudy.cli.simulate.simulation_report import Report

NOTHING, DETECTED = 0, 1
"""Exit statuses besides ERROR."""


@reports_errors("simulate")
def main(arguments: list[str]) -> int:
    """Run the command. The result goes to standard output."""
    options = _parser().parse_args(arguments)
    report, detected = _simulated(options)
    terminal.write([report])
    return DETECTED if detected else NOTHING


def _simulated(options: argparse.Namespace) -> tuple[str, bool]:
    """Return the output, and whether a failure was detected. Raises CommandError."""
    if options.plot is not None:
        plot_files.check_plot_file(options.plot)
    policy = policy_file.read(options.policy_file, options.policy, options.grace)
    with Bag.open(options.bag) as bag:
        try:
            times = [fault_times.parse(text, bag.start, bag.end) for text in options.onset]
        except ValueError as error:
            raise CommandError(f"--onset: {error}") from error
        found = replay(policy.tree(bag.definitions.fields), policy.debounce, bag)
        report = Report(policy, bag, found, times)
        written = report.text() if options.output == "text" else structured(report.data(), options.output)
        if options.plot is not None:
            from understudy.cli.simulate import plots

            plots.draw(
                options.plot, f"Policy {policy.name} over {Path(bag.path).name}", found, bag.start, bag.end, times
            )
        return written, bool(found.evaluation.detections)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy simulate",
        description="Evaluates the health tree of a FailurePolicy over a recorded bag, with its debounce and startup grace, and reports "
        "what would have been detected and when. It needs neither a cluster nor ROS, but the extra understudy[bags].",
        epilog="Exit status: 0 if nothing would have been detected, 1 if something would, 2 on an error.",
    )
    add_examples(
        parser,
        "understudy simulate policy.yaml --bag drive/",
        "understudy simulate policy.yaml --bag drive/ --onset 42.5 --plot detection.png",
    )
    policy_file.add_options(parser)
    parser.add_argument("--bag", required=True, metavar="BAG", help="a rosbag2 folder, or an .mcap or .db3 file")
    parser.add_argument(
        "--onset",
        action="append",
        default=[],
        metavar="TIME",
        help="time of a real failure, to report the delay until its detection: seconds from the start of the bag, "
        "or a time such as 2026-11-22T18:00:00Z; may be given several times",
    )
    parser.add_argument(
        "--grace",
        metavar="DURATION",
        help="how long the instance may take to become healthy for the first time, instead of the policy's "
        "startupGrace; use 0s if it was already running at the start of the recording",
    )
    parser.add_argument("--plot", metavar="FILE.png", help="draw the result (needs the extra understudy[plots])")
    add_output(parser, "output format (default: text)")
    return parser

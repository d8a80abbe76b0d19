"""``understudy simulate POLICY --bag BAG``: what a policy's health tree would have detected in a recording, and when."""

from __future__ import annotations

import argparse
import io
import os
import sys
from pathlib import Path

from understudy.api.output_formats import structured
from understudy.cli.common import plot_files
from understudy.cli.common.errors import CommandError
from understudy.cli.simulate import fault_times, policy_file
from understudy.cli.simulate.bags import Bag
from understudy.cli.simulate.replay import replay
from understudy.cli.simulate.simulation_report import Report

NOTHING, DETECTED, CANT = 0, 1, 2
"""Exit statuses."""


def main(arguments: list[str]) -> int:
    """Run the command; what came of it goes to standard output."""
    given = _parser().parse_args(arguments)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        report, detected = _simulated(given)
    except CommandError as error:
        print(f"understudy simulate: {error}", file=sys.stderr)
        return CANT
    try:
        print(report)
        sys.stdout.flush()
    except BrokenPipeError:  # read by something like head, which has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return DETECTED if detected else NOTHING


def _simulated(given: argparse.Namespace) -> tuple[str, bool]:
    """What is printed, and whether anything was detected. Raises CommandError."""
    if given.plot is not None:
        plot_files.usable(given.plot)
    policy = policy_file.read(given.policy_file, given.policy, given.grace)
    with Bag.open(given.bag) as bag:
        try:
            times = [fault_times.parse(text, bag.start, bag.end) for text in given.onset]
        except ValueError as error:
            raise CommandError(f"--onset: {error}") from error
        found = replay(policy.tree(bag.definitions.fields), policy.debounce, bag)
        report = Report(policy, bag, found, times)
        told = report.text() if given.output == "text" else structured(report.data(), given.output)
        if given.plot is not None:
            from understudy.cli.simulate import plots

            plots.draw(given.plot, f"Policy {policy.name} over {Path(bag.path).name}", found, bag.start, bag.end, times)
        return told, bool(found.course.detections)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy simulate",
        description="Runs the health tree of a FailurePolicy over a recorded bag, with its debounce and its grace, and says what "
        "would have been detected and when. Needs neither a cluster nor ROS; bags are read by the extra understudy[bags].",
        epilog="Exit status: 0 where nothing would have been detected, 1 where something would, 2 where it can't be done as asked for.",
    )
    parser.add_argument(
        "policy_file", metavar="POLICY.yaml", help="a file with a FailurePolicy, or - for standard input"
    )
    parser.add_argument("--bag", required=True, metavar="BAG", help="a rosbag2 folder, or an .mcap or .db3 file")
    parser.add_argument("--policy", metavar="NAME", help="which policy, where the file holds several")
    parser.add_argument(
        "--onset",
        action="append",
        default=[],
        metavar="TIME",
        help="when something really failed, in seconds from the bag's start or as a wall time, to be told how much later that was "
        "detected; may be given several times",
    )
    parser.add_argument(
        "--grace",
        metavar="TIME",
        help="how long the instance has to become healthy for the first time, instead of the policy's startupGrace: 0s where it had been "
        "up when the recording began",
    )
    parser.add_argument("--plot", metavar="FILE.png", help="draw it (needs the extra understudy[plots])")
    parser.add_argument("-o", "--output", choices=("text", "json", "yaml"), default="text", help="how it is printed")
    return parser

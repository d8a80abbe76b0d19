"""``understudy report``: writes a report about the recoveries of a period, as one HTML page and as CSV."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from understudy.api import base, names
from understudy.cli.common.cluster_access.kubectl import WORKLOADS, Kubectl, add_options, add_robots, chosen
from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.option_rules import add_examples
from understudy.cli.common.text.wording import clock, counted, moment
from understudy.cli.report.csv_sheets import sheets
from understudy.cli.report.page import page
from understudy.cli.report.recovery_records import Findings, Span, findings


@reports_errors("report")
def main(arguments: list[str]) -> int:
    """Run the command."""
    options = _parser().parse_args(arguments)
    now = time.time()
    period = _period(options, now)
    kubectl = Kubectl(options)
    items = _robots(kubectl, options)
    pods, unknown = _pods(kubectl, options)
    found = findings(items, period, pods, pods_unknown=unknown)
    data = sheets(found)
    where = _where(found, options)
    _write(Path(options.output), page(found, data, where=where, made=now))
    if options.csv is not None:
        for name, text in data.items():
            _write(Path(options.csv, name), text)
    print(_summary(found, options))
    return 0


def _robots(kubectl: Kubectl, options: argparse.Namespace) -> Sequence[Mapping[str, Any]]:
    """Return the selected RobotWorkloads. Raises CommandError, also if there are none."""
    answer = kubectl.get(WORKLOADS, *chosen(options), *(["-A"] if options.all_namespaces else []))
    items: list[Mapping[str, Any]] = answer.get("items", [answer])
    if items:
        return items
    if options.namespace and not _may_be_there(kubectl, options.namespace):
        raise CommandError(f"namespace {options.namespace} does not exist")
    where = "the cluster" if options.all_namespaces else "this namespace (use -n NAMESPACE or -A)"
    raise CommandError(f"there is no RobotWorkload in {where}")


def _may_be_there(kubectl: Kubectl, namespace: str) -> bool:
    """Return whether a namespace may exist. A user with access to its objects may lack the permission to get the namespace."""
    try:
        return kubectl.find("namespaces", namespace) is not None
    except CommandError:
        return True


def _pods(kubectl: Kubectl, options: argparse.Namespace) -> tuple[Sequence[Mapping[str, Any]], str]:
    """Return the pods of robots and pools, and the reason if they cannot be listed, in which case the report is written without them."""
    where, found = ["-A"] if options.all_namespaces else [], {}
    try:
        for label in (names.WORKLOAD, names.MONITORED, names.POOL):  # they may be few of the cluster's pods
            for pod in kubectl.get("pods", *where, "-l", label)["items"]:
                found[pod["metadata"]["uid"]] = pod
    except CommandError as error:
        return [], str(error)
    return list(found.values()), ""


def _period(options: argparse.Namespace, now: float) -> Span:
    end = min(now, _moment("--to", options.to)) if options.to else now
    if options.from_:
        begin = _moment("--from", options.from_)
    else:
        try:
            begin = end - base.seconds(options.since)
            datetime.fromtimestamp(begin, UTC)
        except (ValueError, OverflowError, OSError) as error:  # also for dates before year 1
            raise CommandError(f"--since: {error}") from error
    if begin >= end:
        raise CommandError(
            f"the period would begin at {clock(begin)} and end at {clock(end)}: it must begin in the past and end after its beginning"
        )
    return Span(begin, end)


def _moment(option: str, text: str) -> float:
    try:
        return moment(text)
    except ValueError:
        raise CommandError(
            f"{option}: found {text!r:.60}; give a date or a time, such as 2026-11-20 or 2026-11-20T14:00:00Z"
        ) from None


def _where(found: Findings, options: argparse.Namespace) -> str:
    if options.names or options.selector:
        return ", ".join(found.named(robot_period.robot) for robot_period in found.robot_periods)
    namespaces = sorted({robot_period.robot.namespace for robot_period in found.robot_periods})
    return "all namespaces" if options.all_namespaces else f"namespace {namespaces[0]}"


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8", newline="")
    except OSError as error:
        raise CommandError(f"{path} cannot be written: {error.strerror}; give another path") from error


def _summary(found: Findings, options: argparse.Namespace) -> str:
    entries, lost = found.entries, len(found.incomplete)
    text = (
        f"{options.output}: {counted(len(found.robot_periods), 'robot')}, {counted(len(entries), 'recovery', 'recoveries')} from "
        f"{clock(found.period.begin)} to {clock(found.period.end)}"
    )
    if lost:
        text += f"; the data on {counted(lost, 'robot')} is incomplete, because a status records only the last ten recoveries"
    return text


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy report",
        description="Writes an HTML report about the recoveries of a period: recovery times by strategy and part, "
        "how long the robots were without commands, reserved resources, and every recovery. The data come from the "
        "status of the RobotWorkloads, which contains the last ten recoveries of each robot; the report says for "
        "which time they are incomplete. The command changes nothing in the cluster.",
        epilog="Exit status: 0 if the report was written, 2 if not: kubectl failed, a name does not exist, or there is no robot.",
    )
    add_examples(
        parser,
        "understudy report -n fleet --since 168h -o week.html",
        "understudy report robot-1 --from 2026-11-01 --to 2026-12-01 --csv november/",
    )
    add_robots(parser)
    begin = parser.add_mutually_exclusive_group()
    begin.add_argument(
        "--since",
        metavar="DURATION",
        default="24h",
        help="length of the period, such as 30m or 168h (default: %(default)s)",
    )
    begin.add_argument(
        "--from", dest="from_", metavar="TIME", help="start of the period, such as 2026-11-20 or 2026-11-20T14:00:00Z"
    )
    parser.add_argument("--to", metavar="TIME", help="end of the period (default: now)")
    parser.add_argument(
        "-o", "--output", metavar="FILE", default="understudy-report.html", help="the HTML file (default: %(default)s)"
    )
    parser.add_argument(
        "--csv",
        metavar="FOLDER",
        help="also write the data as files: recoveries.csv, robots.csv, strategies.csv and reserved.csv",
    )
    add_options(parser, all_namespaces=True)
    return parser

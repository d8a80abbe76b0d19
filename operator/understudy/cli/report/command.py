"""``understudy report``: what the recoveries of a period came to, as one page to keep and as data."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from understudy.api import base, names
from understudy.cli.common.errors import CommandError
from understudy.cli.common.kubectl import WORKLOADS, Kubectl, add_options
from understudy.cli.common.wording import clock, counted
from understudy.cli.report.csv_sheets import sheets
from understudy.cli.report.page import page
from understudy.cli.report.prometheus_client import Prometheus
from understudy.cli.report.prometheus_figures import Measured, measured
from understudy.cli.report.recovery_records import Findings, Span, findings

WRITTEN, CANT = 0, 2
"""Exit statuses."""


def main(arguments: list[str]) -> int:
    """Run the command."""
    given = _parser().parse_args(arguments)
    try:
        now = time.time()
        period = _period(given, now)
        kubectl = Kubectl(given)
        items = _robots(kubectl, given)
        pods, unknown = _pods(kubectl, given)
        found = findings(items, period, pods, pods_unknown=unknown)
        told = _measured(found, given)
        data = sheets(found, told)
        where = _where(found, given)
        _write(Path(given.output), page(found, data, where=where, made=now, measured=told))
        if given.csv is not None:
            for name, text in data.items():
                _write(Path(given.csv, name), text)
    except CommandError as error:
        print(f"understudy report: {error}", file=sys.stderr)
        return CANT
    print(_told(found, given, told))
    return WRITTEN


def _robots(kubectl: Kubectl, given: argparse.Namespace) -> Sequence[Mapping[str, Any]]:
    """The RobotWorkloads that were asked for. Raises CommandError, also where there is none."""
    answer = kubectl.get(WORKLOADS, *given.names, *(["-A"] if given.all_namespaces else []))
    items: list[Mapping[str, Any]] = answer.get("items", [answer])
    if items:
        return items
    if given.namespace and not _may_be_there(kubectl, given.namespace):
        raise CommandError(f"there is no namespace {given.namespace}")
    where = "the cluster" if given.all_namespaces else "this namespace (-n NAMESPACE and -A ask elsewhere)"
    raise CommandError(f"there is no RobotWorkload in {where}")


def _may_be_there(kubectl: Kubectl, namespace: str) -> bool:
    """Whether there is such a namespace, or nobody knows: who may look into it may not be allowed to look at it."""
    try:
        return kubectl.find("namespaces", namespace) is not None
    except CommandError:
        return True


def _pods(kubectl: Kubectl, given: argparse.Namespace) -> tuple[Sequence[Mapping[str, Any]], str]:
    """The pods that robots and pools have; and why they can't be told, where they can't: that is no reason to write nothing."""
    where, found = ["-A"] if given.all_namespaces else [], {}
    try:
        for label in (names.WORKLOAD, names.MONITORED, names.POOL):  # of a cluster's pods they may be few
            for pod in kubectl.get("pods", *where, "-l", label)["items"]:
                found[pod["metadata"]["uid"]] = pod
    except CommandError as error:
        return [], str(error)
    return list(found.values()), ""


def _measured(found: Findings, given: argparse.Namespace) -> Measured | None:
    """What a Prometheus has of the same robots and the same period; None where none was named. Raises CommandError."""
    if given.prometheus is None:
        for option in ("prometheus_token_file", "prometheus_ca_file"):
            if getattr(given, option) is not None:
                raise CommandError(f"--{option.replace('_', '-')} is for --prometheus URL, which isn't given")
        return None
    prometheus = Prometheus(given.prometheus, token_file=given.prometheus_token_file, ca_file=given.prometheus_ca_file)
    namespace = None if given.all_namespaces else found.courses[0].robot.namespace
    return measured(prometheus, found.period, namespace=namespace, names=given.names)


def _period(given: argparse.Namespace, now: float) -> Span:
    end = min(now, _moment("--to", given.to)) if given.to else now
    if given.from_:
        begin = _moment("--from", given.from_)
    else:
        try:
            begin = end - base.seconds(given.since)
            datetime.fromtimestamp(begin, UTC)
        except (ValueError, OverflowError, OSError) as error:  # also of what reaches back beyond the calendar
            raise CommandError(f"--since: {error}") from error
    if begin >= end:
        raise CommandError(
            f"the period would begin at {clock(begin)} and end at {clock(end)}: give one that has passed, at least in part"
        )
    return Span(begin, end)


def _moment(option: str, text: str) -> float:
    """A moment as people and clusters write it; in UTC where it doesn't say."""
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        raise CommandError(
            f"{option}: found {text!r:.60}; write a date or a moment, such as 2026-11-20 or 2026-11-20T14:00:00Z"
        ) from None
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()


def _where(found: Findings, given: argparse.Namespace) -> str:
    if given.names:
        return ", ".join(found.named(course.robot) for course in found.courses)
    namespaces = sorted({course.robot.namespace for course in found.courses})
    return "all namespaces" if given.all_namespaces else f"namespace {namespaces[0]}"


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8", newline="")
    except OSError as error:
        raise CommandError(f"{path} can't be written: {error.strerror}; give another place") from error


def _told(found: Findings, given: argparse.Namespace, told_of: Measured | None) -> str:
    entries, lost = found.entries, len(found.incomplete)
    told = (
        f"{given.output}: {counted(len(found.courses), 'robot')}, {counted(len(entries), 'recovery', 'recoveries')} from "
        f"{clock(found.period.begin)} to {clock(found.period.end)}"
    )
    if lost:
        told += f"; of {counted(lost, 'robot')} not the whole period is known, since a status keeps the last ten recoveries only"
    if told_of is not None:
        counts = counted(told_of.counted("Recovery"), "recovery", "recoveries")
        told += (
            f"; {counts} by Prometheus, {told_of.counted('Recovery', result='Failed')} of them failed"
            if told_of.seen
            else f"; Prometheus at {told_of.url} has nothing of these robots in it"
        )
    return told


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy report",
        description="Writes what the recoveries of a period came to into one HTML file: recovery times by strategy and part, the robots' "
        "gaps and downtime, what is reserved for them, and every recovery. It is made from the records in the RobotWorkloads' status, "
        "which keep the last ten of each robot, and says of which time they aren't whole; a Prometheus, where one is named, has counted "
        "them all. It acts on nothing.",
        epilog="Exit status: 0 where it is written, 2 where it can't be: kubectl or Prometheus failed, a name isn't there, or there is no "
        "robot at all.",
    )
    parser.add_argument("names", metavar="NAME", nargs="*", help="a RobotWorkload; all where none is named")
    begin = parser.add_mutually_exclusive_group()
    begin.add_argument(
        "--since", metavar="DURATION", default="24h", help="how long the period is (%(default)s), such as 30m or 168h"
    )
    begin.add_argument(
        "--from", dest="from_", metavar="TIME", help="when it begins, such as 2026-11-20 or 2026-11-20T14:00:00Z"
    )
    parser.add_argument("--to", metavar="TIME", help="when it ends; now, where that isn't given")
    parser.add_argument(
        "-o", "--output", metavar="FILE", default="understudy-report.html", help="the page (%(default)s)"
    )
    parser.add_argument(
        "--csv",
        metavar="FOLDER",
        help="write the data there too: recoveries.csv, robots.csv, strategies.csv and reserved.csv, and with --prometheus "
        "prometheus-recoveries.csv, prometheus-times.csv and prometheus-pools.csv",
    )
    parser.add_argument(
        "--prometheus",
        metavar="URL",
        help="ask this Prometheus too, which knows of all recoveries of the period how many there were and how long they took, such as "
        "http://localhost:9090",
    )
    parser.add_argument("--prometheus-token-file", metavar="FILE", help="a file with the bearer token that it wants")
    parser.add_argument("--prometheus-ca-file", metavar="FILE", help="by which its certificate is trusted, in PEM")
    add_options(parser, all_namespaces=True)
    return parser

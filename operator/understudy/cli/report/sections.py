"""Builds the sections of the page: text, charts and tables; each chart has a table with its values. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping

from understudy.cli.common.robots import summary
from understudy.cli.common.text.recovery_text import outcome, parts_of, tried
from understudy.cli.common.text.time_bars import NAMES, short
from understudy.cli.common.text.wording import clock, counted, listed, unix
from understudy.cli.report.drawing import charts, html_tables
from understudy.cli.report.drawing.html_markup import Markup, element
from understudy.cli.report.drawing.html_tables import Cell, moment, number, seconds, span
from understudy.cli.report.recovery_records import Entry, Findings, RobotPeriod
from understudy.cli.report.reserved_resources import ROLES, Amounts
from understudy.cli.report.sample_statistics import Spread

HOW = (
    "A robot's downtime is the sum, over its recoveries, of the time from the last healthy output of the former instance until the "
    "gate opened for the next one: recoverySeconds of the record, plus the time for which the budget deferred it. For a switchover it is "
    "the time of the switch. Overlapping times count once. If every strategy failed, it counts until the robot was healthy again; "
    "≥ means that this was not recorded. A failure that continues counts until the end of the period. Availability is the rest, as a "
    "share of the time for which the records are complete.",
    "This is the monitor's view: it excludes time in which the monitor did not run or the robot was paused for maintenance, and "
    "robots whose RobotWorkload was deleted. Only the robot's own log can say how long it received no command.",
)


def known(findings: Findings) -> Iterator[Markup]:
    """Describe the records, and for which part of the period they are incomplete."""
    ever = sum(robot_period.ever for robot_period in findings.robot_periods)
    kept = sum(robot_period.kept for robot_period in findings.robot_periods)
    if not ever:
        yield element("p", "These robots have had no recovery since they were created.", class_="card")
        return
    had = counted(ever, "recovery", "recoveries")
    text = (
        f"A RobotWorkload keeps the records of its last ten recoveries. Of all {had} of these robots, {kept} "
        f"{'is' if kept == 1 else 'are'} recorded; {len(findings.entries)} of those began in this period."
    )
    if not findings.incomplete:
        why = " No record of this period is missing." if ever > kept else ""
        yield element("section", element("p", text + why), class_="card")
        return
    lost = [element("li", _lost(robot_period, findings)) for robot_period in findings.incomplete]
    yield element(
        "section",
        element(
            "p",
            element("strong", "The data on this period is incomplete. "),
            text,
            " Older records of these robots were replaced by newer ones, so recoveries of this period may be missing:",
        ),
        element("ul", *lost),
        class_="card warn",
    )


def _lost(robot_period: RobotPeriod, findings: Findings) -> str:
    name = findings.named(robot_period.robot)
    since = (
        f"known since {clock(robot_period.known.begin)}" if robot_period.known is not None else "no data on the period"
    )
    return f"{name}: {robot_period.forgotten} of {robot_period.ever} are no longer recorded; {since}"


def tiles(findings: Findings) -> Markup:
    """Build the tiles with the most important figures."""
    entries = findings.entries
    failures = [entry for entry in entries if entry.of_failure]
    longest = max(
        (outage.span.length for robot_period in findings.robot_periods for outage in robot_period.outages), default=None
    )
    protected = sum(robot_period.robot.protected for robot_period in findings.robot_periods)
    robots = len(findings.robot_periods)
    known = sum(robot_period.known.length for robot_period in findings.robot_periods if robot_period.known is not None)
    shown = (
        ("Robots", str(robots), f"{protected} protected now, {robots - protected} not"),
        ("Failures recovered", str(sum(entry.recovered for entry in failures)), f"of {len(failures)}"),
        ("Failed recoveries", str(sum(entry.failed for entry in failures)), "no strategy was verified"),
        ("Without a failure", str(len(entries) - len(failures)), "planned, or after a dependency's recovery"),
        ("Longest downtime", span(longest) if longest is not None else "–", "of one outage"),
        ("Availability", availability(findings.availability), f"over {span(known)} of recorded robot time"),
    )
    return element(
        "dl",
        *(
            element("div", element("dt", name), element("dd", value, element("small", note)))
            for name, value, note in shown
        ),
        class_="tiles",
    )


def availability(share: float | None) -> str:
    """Format a share in percent, never rounded up: a robot with downtime never shows 100 %."""
    if share is None:
        return "–"
    return f"{int(max(0.0, share) * 100_000 + 1e-7) / 1000:g} %"


def robots(findings: Findings) -> Iterator[Markup]:
    """Build the table of robots: their current state, and their recoveries in the period."""
    yield element("h2", "Robots")
    yield element("p", summary([robot_period.robot for robot_period in findings.robot_periods]) + " (current state).")
    yield html_tables.table(
        "Robots: current state, and recoveries in the period",
        [_robot(c, findings) for c in findings.robot_periods],
        sortable=True,
    )
    for robot_period in findings.robot_periods:
        if robot_period.robot.problems:
            items = [element("li", f"{p.about} ({p.reason}): {p.message}") for p in robot_period.robot.problems]
            name = findings.named(robot_period.robot)
            yield element("section", element("h3", f"{name} now"), element("ul", *items), class_="card warn")
    yield element(
        "details",
        element("summary", "How downtime and availability are computed"),
        *(element("p", how) for how in HOW),
        class_="card",
        open="",
    )


def _robot(robot_period: RobotPeriod, findings: Findings) -> dict[str, Cell]:
    robot, known = robot_period.robot, robot_period.known
    failures = [entry for entry in robot_period.entries if entry.of_failure]
    at_most = "≤ " if robot_period.down_at_least else ""
    return {
        "Robot": Cell(findings.named(robot)),
        "Health now": Cell(
            robot.health, state="good" if robot.is_well else "warned" if robot.health != "Failed" else "bad"
        ),
        "Protected now": Cell("yes", state="good") if robot.protected else Cell("NO", state="bad"),
        "Failures": number(len(failures)),
        "Recovered": number(sum(entry.recovered for entry in failures)),
        "Failed": number(sum(entry.failed for entry in failures)),
        "Without a failure": number(len(robot_period.entries) - len(failures)),
        "Downtime": seconds(robot_period.down if known is not None else None, at_least=robot_period.down_at_least),
        "Availability": Cell(
            f"{at_most}{availability(robot_period.availability)}", robot_period.availability, number=True
        ),
        "Recorded time": Cell(span(known.length) if known else "none", known.length if known else 0.0, number=True),
        "Records": Cell(f"{robot_period.kept} of {robot_period.ever}", robot_period.ever, number=True),
    }


def strategies(findings: Findings) -> Iterator[Markup]:
    """Build the chart of recovery times, as in the paper."""
    yield element("h2", "Recovery time by strategy")
    groups = findings.groups
    if not groups:
        yield element("p", "No recovery of this period is recorded.", class_="card")
        return
    yield element(
        "figure",
        charts.legend(*NAMES.items(), ("dot", "one recovery"), ("median", "p50"), ("tail", "p95")),
        charts.recovery_times(groups),
        element(
            "figcaption",
            "From the last healthy output until the gate opened for the next instance: the mean of each of the four parts, stacked. "
            "Quantiles are interpolated linearly; with few recoveries they mean little.",
        ),
    )
    rows = [
        {"Strategy": Cell(g.name), "n": number(g.spread.count), **_parts(g.parts), **_spread(g.spread)} for g in groups
    ]
    yield html_tables.table("Recovery time by strategy, and the mean of each part", rows)


def _parts(parts: Mapping[str, float]) -> dict[str, Cell]:
    return {name.capitalize(): seconds(parts.get(part)) for part, name in NAMES.items()}


def _spread(spread: Spread) -> dict[str, Cell]:
    figures = {
        "Mean": spread.mean,
        "p50": spread.p50,
        "p95": spread.p95,
        "Least": spread.least,
        "Greatest": spread.greatest,
    }
    return {name: seconds(value) for name, value in figures.items()}


def over_time(findings: Findings) -> Iterator[Markup]:
    """Build the chart of recoveries over time."""
    yield element("h2", "Recoveries over time")
    if not findings.eventful:
        yield element("p", "No recovery or outage of these robots is recorded in this period.", class_="card")
        return
    quiet = len(findings.robot_periods) - len(findings.eventful)
    others = f" {counted(quiet, 'robot')} without an event {'is' if quiet == 1 else 'are'} not shown." if quiet else ""
    yield element(
        "figure",
        charts.legend(
            ("recovered", "recovered"),
            ("planned", "without a failure"),
            ("failed", "failed"),
            ("outage", "outage"),
            ("known", "recorded time"),
            ("unknown", "not recorded, or before creation"),
        ),
        charts.timeline(findings),
        element("figcaption", f"By robot, in UTC. Every mark is also in the table of recoveries below.{others}"),
    )


def gaps(findings: Findings) -> Iterator[Markup]:
    """Build the chart of command gaps."""
    yield element("h2", "Interruption of the robot's commands")
    groups = [group for group in findings.groups if group.gaps]
    if not groups:
        yield element("p", "No interruption was recorded in this period.", class_="card")
        return
    yield element(
        "figure",
        charts.legend(("dot", "one recovery"), ("median", "p50"), ("tail", "p95")),
        charts.gaps(groups),
        element(
            "figcaption",
            "Between the last healthy output (for a switchover: the last output of the former instance) and the first output of the "
            "next instance, as the monitor received them on the outputs that are topics. Logarithmic axis.",
        ),
    )
    rows = [{"Strategy": Cell(g.name), "n": number(len(g.gaps)), **_spread(Spread.of(g.gaps))} for g in groups]
    yield html_tables.table("Gap by strategy", rows)


def reserved(findings: Findings) -> Iterator[Markup]:
    """Build the chart of resources that each strategy reserves."""
    yield element("h2", "Reserved CPU and memory")
    shares = findings.shares
    if findings.shares_unknown:
        yield element("p", f"The pods could not be listed: {findings.shares_unknown}", class_="card")
        return
    roles = [role for role in ROLES if any(share.roles.get(role, Amounts()).cpu for share in shares)]
    if not roles:
        yield element("p", "No pod of these robots requests CPU.", class_="card")
        return
    yield element(
        "figure",
        charts.legend(*((role, ROLES[role]) for role in roles)),
        charts.reserved(shares),
        element(
            "figcaption",
            "CPU requests of pods, by the strategy that a failure would trigger now: the mean per robot, by role of the "
            "pods, and the waiting pods of each shared pool. These are requests, not usage.",
        ),
    )
    rows = [
        {
            "Strategy": Cell(share.name),
            "n": number(share.count),
            **{ROLES[role].capitalize(): _milli(share.roles.get(role, Amounts()).cpu) for role in roles},
            "All": _milli(share.total.cpu),
            "Memory": Cell(f"{share.total.memory / 2**20:.0f} MiB", share.total.memory, number=True),
        }
        for share in shares
    ]
    yield html_tables.table("Reserved CPU and memory by strategy", rows)


def _milli(cores: float) -> Cell:
    return Cell(f"{cores * 1000:.4g} m", cores, number=True)


def failures(findings: Findings) -> Iterator[Markup]:
    """List failed recoveries and failed attempts."""
    yield element("h2", "Failed recoveries and failed attempts")
    failed = [e for e in findings.entries if e.failed or any(a.result != "Verified" for a in e.recovery.attempts)]
    if not failed:
        yield element(
            "p",
            "No failed recovery and no failed attempt is recorded in this period.",
            class_="card",
        )
    for entry in failed:
        recovery = entry.recovery
        vain = [element("li", tried(attempt)) for attempt in recovery.attempts if attempt.result != "Verified"]
        yield element(
            "section",
            element(
                "h3",
                f"{findings.named(entry)} #{recovery.number}, {clock(entry.began)}: ",
                element("span", outcome(recovery), class_="bad" if entry.failed else "good"),
            ),
            element("p", recovery.reason),
            element("ul", *vain) if vain else element("p", "No attempt is recorded."),
            class_="card fault" if entry.failed else "card",
        )


def recoveries(findings: Findings) -> Iterator[Markup]:
    """Build the table of all recoveries."""
    yield element("h2", "Recoveries")
    if not findings.entries:
        lasts = [robot_period.robot.last_recovery for robot_period in findings.robot_periods]
        newest = max((unix(last.ended) for last in lasts if last is not None and last.ended), default=None)
        before = f" The last recorded one ended at {clock(newest)}." if newest is not None else ""
        yield element("p", f"No recovery that began in this period is recorded.{before}", class_="card")
        return
    results = Counter(entry.recovery.result.lower() for entry in findings.entries)
    counts = listed(f"{count} {result}" for result, count in sorted(results.items()))
    yield html_tables.table(
        f"Recoveries that began in the period, newest first: {counts}",
        [_recovery(entry, findings) for entry in findings.entries],
        sortable=True,
    )


def _recovery(entry: Entry, findings: Findings) -> dict[str, Cell]:
    recovery = entry.recovery
    pods = short([recovery.from_pod, recovery.to_pod])
    why = recovery.switchover or ("planned" if recovery.planned else "dependency" if recovery.follows else "")
    result = f"{recovery.result}{f' ({why.lower()})' if why else ''}"
    return {
        "Robot": Cell(findings.named(entry)),
        "#": number(recovery.number),
        "Began": moment(entry.began),
        "Result": Cell(result, state="bad" if entry.failed else "good"),
        "Strategy": Cell(recovery.strategy or "–"),
        "Time": seconds(recovery.recovery_seconds),
        **_parts(parts_of(recovery)),
        "Deferred": seconds(entry.held),
        "Gap": seconds(entry.gap),
        "From and to": Cell(f"{pods[recovery.from_pod] or 'none'} → {pods[recovery.to_pod] or 'none'}"),
        "Reason": Cell(recovery.reason, state="long"),
    }

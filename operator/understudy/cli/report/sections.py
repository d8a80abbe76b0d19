"""The parts of the page: what was found in words, figures and tables, each figure with its figures beside it; pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from understudy.cli.common.recovery_text import outcome, parts_of, tried
from understudy.cli.common.robots import summary
from understudy.cli.common.time_bars import NAMES, short
from understudy.cli.common.wording import clock, counted, listed, unix
from understudy.cli.report import charts, html_tables
from understudy.cli.report.html_markup import Markup, element
from understudy.cli.report.html_tables import Cell, moment, number, seconds, span
from understudy.cli.report.recovery_records import Course, Entry, Findings
from understudy.cli.report.reserved_resources import ROLES, Amounts
from understudy.cli.report.sample_statistics import Spread

HOW = (
    "A robot's downtime is the sum, over its recoveries, of the time from the last healthy output of the former instance until the "
    "gate was open for the next one: recoverySeconds of the record, and what the policy's budget held it for. Of a switchover it is "
    "the time of the switch. Times that overlap count once. Where every strategy failed, it counts until the robot was healthy again; "
    "≥ stands where that was not recorded. A failure that isn't over counts until the end of the period. Availability is the rest, as a "
    "share of the time of which the records are whole.",
    "This is the monitor's view: time in which the monitor itself was away, or in which a robot was paused for maintenance, is not "
    "seen, and robots whose RobotWorkload was deleted are not in here. How long a robot got no command, only its own log can say.",
)


def known(findings: Findings) -> Iterator[Markup]:
    """What the records are, and what they can't say of this period."""
    ever = sum(course.ever for course in findings.courses)
    kept = sum(course.kept for course in findings.courses)
    if not ever:
        yield element("p", "These robots have had no recovery since they were made.", class_="card")
        return
    had = counted(ever, "recovery", "recoveries")
    told = (
        f"A RobotWorkload keeps the records of its last ten recoveries. Of {had} that these robots ever had, {kept} "
        f"{'is' if kept == 1 else 'are'} kept; {len(findings.entries)} of those began in this period."
    )
    if not findings.incomplete:
        why = " None of this period is missing." if ever > kept else ""
        yield element("section", element("p", told + why), class_="card")
        return
    lost = [element("li", _lost(course, findings)) for course in findings.incomplete]
    yield element(
        "section",
        element(
            "p",
            element("strong", "Not the whole period is known. "),
            told,
            " Of these robots older records have made room for newer ones, so that recoveries of this period may be missing:",
        ),
        element("ul", *lost),
        class_="card warn",
    )


def _lost(course: Course, findings: Findings) -> str:
    name = findings.named(course.robot)
    since = f"known since {clock(course.known.begin)}" if course.known is not None else "nothing of the period is known"
    return f"{name}: {course.forgotten} of {course.ever} are not kept; {since}"


def tiles(findings: Findings) -> Markup:
    """The figures that are looked for first."""
    entries = findings.entries
    failures = [entry for entry in entries if entry.of_failure]
    longest = max((outage.span.length for course in findings.courses for outage in course.outages), default=None)
    protected = sum(course.robot.protected for course in findings.courses)
    robots = len(findings.courses)
    known = sum(course.known.length for course in findings.courses if course.known is not None)
    shown = (
        ("Robots", str(robots), f"{protected} protected now, {robots - protected} not"),
        ("Failures recovered", str(sum(entry.recovered for entry in failures)), f"of {len(failures)}"),
        ("Failed recoveries", str(sum(entry.failed for entry in failures)), "nothing that was tried came to drive"),
        ("Without a failure", str(len(entries) - len(failures)), "as planned, or after a dependency's"),
        ("Longest downtime", span(longest) if longest is not None else "–", "at a stretch"),
        ("Availability", availability(findings.availability), f"over {span(known)} of known robot time"),
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
    """A share in percent, never rounded up: 100 % is said of no robot that was ever down."""
    if share is None:
        return "–"
    return f"{int(max(0.0, share) * 100_000 + 1e-7) / 1000:g} %"


def robots(findings: Findings) -> Iterator[Markup]:
    """How each robot is, and what it had in the period."""
    yield element("h2", "Robots")
    yield element("p", summary([course.robot for course in findings.courses]) + ", as they are now.")
    head = (
        "Robot",
        "Health now",
        "Protected now",
        "Failures",
        "Recovered",
        "Failed",
        "Without a failure",
        "Downtime",
        "Availability",
        "Known time",
        "Records kept",
    )
    yield html_tables.table(
        "Robots: how they are now, and what came to pass in the period",
        head,
        [_robot(c, findings) for c in findings.courses],
        sortable=True,
    )
    for course in findings.courses:
        if course.robot.problems:
            told = [element("li", f"{p.about} ({p.reason}): {p.message}") for p in course.robot.problems]
            name = findings.named(course.robot)
            yield element("section", element("h3", f"{name} now"), element("ul", *told), class_="card warn")
    yield element(
        "details",
        element("summary", "How downtime and availability are computed"),
        *(element("p", how) for how in HOW),
        class_="card",
        open="",
    )


def _robot(course: Course, findings: Findings) -> list[Cell]:
    robot, known = course.robot, course.known
    failures = [entry for entry in course.entries if entry.of_failure]
    return [
        Cell(findings.named(robot)),
        Cell(robot.health, state="good" if robot.is_well else "warned" if robot.health != "Failed" else "bad"),
        Cell("yes", state="good") if robot.protected else Cell("NO", state="bad"),
        number(len(failures)),
        number(sum(entry.recovered for entry in failures)),
        number(sum(entry.failed for entry in failures)),
        number(len(course.entries) - len(failures)),
        seconds(course.down if known is not None else None, at_least=course.down_at_least),
        Cell(
            f"{'≤ ' if course.down_at_least else ''}{availability(course.availability)}",
            course.availability,
            number=True,
        ),
        Cell(span(known.length), known.length, number=True) if known is not None else Cell("none", 0.0, number=True),
        Cell(f"{course.kept} of {course.ever}", course.ever, number=True),
    ]


def strategies(findings: Findings) -> Iterator[Markup]:
    """The paper's figure."""
    yield element("h2", "Recovery time by strategy")
    groups = findings.groups
    if not groups:
        yield element("p", "Nothing was recovered in this period, so far as it is known.", class_="card")
        return
    yield element(
        "figure",
        charts.legend(*NAMES.items(), ("dot", "one recovery"), ("median", "p50"), ("tail", "p95")),
        charts.recovery_times(groups),
        element(
            "figcaption",
            "From the last healthy output until the gate was open for the next instance, in four parts: the mean of each, stacked. "
            "Quantiles lie linearly between the two nearest values: those of a few recoveries say little.",
        ),
    )
    head = ("Strategy", "n", *(name.capitalize() for name in NAMES.values()), "Mean", "p50", "p95", "Least", "Greatest")
    rows = [
        [Cell(g.name), number(g.spread.count), *(seconds(g.parts[part]) for part in NAMES), *_spread(g.spread)]
        for g in groups
    ]
    yield html_tables.table("Recovery time by strategy, and the mean of each part", head, rows)


def _spread(spread: Spread) -> list[Cell]:
    return [seconds(value) for value in (spread.mean, spread.p50, spread.p95, spread.least, spread.greatest)]


def over_time(findings: Findings) -> Iterator[Markup]:
    """When each of them was."""
    yield element("h2", "Recoveries over time")
    if not findings.eventful:
        yield element("p", "Nothing that is known happened to these robots in this period.", class_="card")
        return
    quiet = len(findings.courses) - len(findings.eventful)
    others = f" Of {counted(quiet, 'robot')} there is nothing to be shown." if quiet else ""
    yield element(
        "figure",
        charts.legend(
            ("recovered", "recovered"),
            ("planned", "without a failure"),
            ("failed", "failed"),
            ("outage", "not driven"),
            ("known", "known time"),
            ("unknown", "not known, or before it was made"),
        ),
        charts.timeline(findings),
        element("figcaption", f"By robot, in UTC. Every mark is in the table of recoveries below.{others}"),
    )


def gaps(findings: Findings) -> Iterator[Markup]:
    """How long the robots heard nothing."""
    yield element("h2", "The robot's gap")
    groups = [group for group in findings.groups if group.gaps]
    if not groups:
        yield element("p", "No gap was recorded in this period.", class_="card")
        return
    yield element(
        "figure",
        charts.legend(("dot", "one recovery"), ("median", "p50"), ("tail", "p95")),
        charts.gaps(groups),
        element(
            "figcaption",
            "Between the last healthy output (of a switchover: the last output of the former instance) and the first one of the "
            "next instance, as the monitor hears the gated topics. Logarithmic axis.",
        ),
    )
    rows = [[Cell(g.name), number(len(g.gaps)), *_spread(Spread.of(g.gaps))] for g in groups]
    yield html_tables.table("Gap by strategy", ("Strategy", "n", "Mean", "p50", "p95", "Least", "Greatest"), rows)


def reserved(findings: Findings) -> Iterator[Markup]:
    """What each strategy keeps reserved: the other side of how long it takes."""
    yield element("h2", "Reserved CPU and memory")
    shares = findings.shares
    if findings.shares_unknown:
        yield element("p", f"The pods can't be told: {findings.shares_unknown}", class_="card")
        return
    roles = [role for role in ROLES if any(share.roles.get(role, Amounts()).cpu for share in shares)]
    if not roles:
        yield element("p", "No pod of these robots requests CPU, so that nothing is reserved.", class_="card")
        return
    yield element(
        "figure",
        charts.legend(*((role, ROLES[role]) for role in roles)),
        charts.reserved(shares),
        element(
            "figcaption",
            "CPU that pods request, by the strategy that would be used if a robot failed now: the mean of a robot, by what its pods are "
            "for; and of each shared pool what waits there. It is what is set aside for them, not what they use.",
        ),
    )
    head = ("Strategy", "n", *(ROLES[role].capitalize() for role in roles), "All", "Memory")
    rows = [
        [
            Cell(share.name),
            number(share.count),
            *(_milli(share.roles.get(role, Amounts()).cpu) for role in roles),
            _milli(share.total.cpu),
            Cell(f"{share.total.memory / 2**20:.0f} MiB", share.total.memory, number=True),
        ]
        for share in shares
    ]
    yield html_tables.table("Reserved CPU and memory by strategy", head, rows)


def _milli(cores: float) -> Cell:
    return Cell(f"{cores * 1000:.4g} m", cores, number=True)


def failures(findings: Findings) -> Iterator[Markup]:
    """What came to nothing, whole or in part."""
    yield element("h2", "What failed, and what was tried in vain")
    failed = [e for e in findings.entries if e.failed or any(a.result != "Verified" for a in e.recovery.attempts)]
    if not failed:
        yield element(
            "p",
            "No recovery failed in this period, and no strategy was tried in vain, so far as it is known.",
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
            element("ul", *vain) if vain else element("p", "Of its attempts nothing is recorded."),
            class_="card fault" if entry.failed else "card",
        )


def recoveries(findings: Findings) -> Iterator[Markup]:
    """Every one of them."""
    yield element("h2", "Recoveries")
    if not findings.entries:
        lasts = [course.robot.last_recovery for course in findings.courses]
        newest = max((unix(last.ended) for last in lasts if last is not None and last.ended), default=None)
        before = f" The last one that is known ended at {clock(newest)}." if newest is not None else ""
        yield element("p", f"No recovery that is known began in this period.{before}", class_="card")
        return
    results = Counter(entry.recovery.result.lower() for entry in findings.entries)
    told = listed(f"{count} {result}" for result, count in sorted(results.items()))
    head = (
        "Robot",
        "#",
        "Began",
        "Result",
        "Strategy",
        "Time",
        *(name.capitalize() for name in NAMES.values()),
        "Held",
        "Gap",
        "From and to",
        "Reason",
    )
    yield html_tables.table(
        f"Recoveries that began in the period, newest first: {told}",
        head,
        [_recovery(entry, findings) for entry in findings.entries],
        sortable=True,
    )


def _recovery(entry: Entry, findings: Findings) -> list[Cell]:
    recovery = entry.recovery
    parts, pods = parts_of(recovery), short([recovery.from_pod, recovery.to_pod])
    why = recovery.switchover or ("planned" if recovery.planned else "dependency" if recovery.follows else "")
    return [
        Cell(findings.named(entry)),
        number(recovery.number),
        moment(entry.began),
        Cell(f"{recovery.result}{f' ({why.lower()})' if why else ''}", state="bad" if entry.failed else "good"),
        Cell(recovery.strategy or "–"),
        seconds(recovery.recovery_seconds),
        *(seconds(parts.get(part)) for part in NAMES),
        seconds(entry.held),
        seconds(entry.gap),
        Cell(f"{pods[recovery.from_pod] or 'no pod'} → {pods[recovery.to_pod] or 'no pod'}"),
        Cell(recovery.reason, state="long"),
    ]

"""Writes the tables of figures in the pages from ``bench/results``.

A cell is a text with figures in brackets: ``[FIGURE; statistics; decimals]``. In the name of a figure, ``*`` stands for what the column
has of it, such as a strategy. A cell is empty if a figure of it was not measured.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from scripts.generation import figures
from understudy.advice.strategy_figures import PUBLISHED_CPU, PUBLISHED_SECONDS

_BLOCK = re.compile(
    r"(?P<begin><!-- table (?P<name>[\w-]+): written by scripts/generate from bench/results -->\n)"
    r".*?(?P<end><!-- end of table (?P=name) -->)",
    re.DOTALL,
)
_BEGIN = "<!-- table "
_IN_CELL = re.compile(r"\[(?P<name>[^][;]+); (?P<of>[^;]+); (?P<decimals>\d)\]")


@dataclass(frozen=True)
class Column:
    """A column of figures: its head, its result file, and what that file calls its subject."""

    head: str
    file: str
    subject: str


def in_page(page: str, results: Path) -> str:
    """Return the page with its tables as they follow from the results.

    Raises ValueError if a table has no name that is known, or no end.
    """
    if page.count(_BEGIN) != len(_BLOCK.findall(page)):
        raise ValueError("a table must stand between '<!-- table NAME: written by …' and '<!-- end of table NAME -->'")

    def again(match: re.Match[str]) -> str:
        if match["name"] not in TABLES:
            raise ValueError(f"there is no table {match['name']} in scripts/generation/tables.py")
        return match["begin"] + TABLES[match["name"]](results) + "\n" + match["end"]

    return _BLOCK.sub(again, page)


def cell(template: str, column: Column, results: Path) -> str:
    """Return a cell with its figures filled in; nothing if one of them was not measured."""
    result = figures.read(results / f"{column.file}.json")
    missing = False

    def number(match: re.Match[str]) -> str:
        nonlocal missing
        found = figures.figure(result, match["name"].replace("*", column.subject))
        if found is None:
            missing = True
            return ""
        values = [figures.written(value, int(match["decimals"])) for value in figures.statistics(found, match["of"])]
        return "0" if set(values) == {"0"} else " / ".join(values)

    filled = _IN_CELL.sub(number, template)
    return "" if missing else filled


def table(
    columns: Sequence[Column], rows: Mapping[str, str], results: Path, *, last: tuple[str, Sequence[str]] | None = None
) -> str:
    """Return a table with a column for each of ``columns``, and the files that its figures are from.

    ``last`` is the head and the cells of a column that was not measured, such as bounds.
    """
    heads = ["", *(column.head for column in columns), *([last[0]] if last else [])]
    lines = [f"|{'|'.join(f' {head} ' if head else ' ' for head in heads)}|", f"|{' --- |' * len(heads)}"]
    for number, (label, template) in enumerate(rows.items()):
        cells = [cell(template, column, results) for column in columns]
        if any(cells):
            lines.append(f"| {' | '.join([label, *cells, *([last[1][number]] if last else [])])} |")
    return "\n".join([*lines, "", figures.sources(results, {column.file for column in columns})])


def configurations(stacks: Mapping[str, str], heads: Mapping[str, str], results: Path) -> Iterator[Column]:
    """Yield a column for each configuration that was measured, of each stack in turn.

    ``stacks`` has what stands before the heads of a stack's columns, by its file; ``heads`` has the heads that are not the names.
    """
    for file, stack in stacks.items():
        for name in figures.read(results / f"{file}.json").get("figures", {}):
            configuration, colon, figure = name.partition(": ")
            if colon and figure == "t_recovery":
                head = heads.get(configuration, configuration.replace("-", " "))
                yield Column(f"{stack}{head}", file, configuration)


# -- docs/figures.md --------------------------------------------------------------------------------------------------

_RECOVERY = {
    "t_detection": "[*: t_detection; p50 p95; 0]",
    "t_cluster": "[*: t_cluster; p50 p95; 1]",
    "t_startup": "[*: t_startup; p50 p95; 0]",
    "t_re-initialization": "[*: t_reinitialization; p50 p95; 0]",
    "t_recovery": "[*: t_recovery; p50 p95; 0]",
    "robot without commands": "[*: robot: gap without commands; p50 p95; 0]",
    "commands of two pods overlapping": "[*: robot: overlap of two pods; max; 0]",
    "commands of the understudy before the switch": "[*: robot: early commands; max; 0]",
}

_PAPER = ("500", "100 (patch), 2900 (restart)", "0 in full execution", "", "", "", "", "")


def recovery(results: Path) -> str:
    """Return the times of each strategy, as p50 / p95 in ms."""
    columns = [Column(f"`{name}`", "recovery", name.lower()) for name in ("Executing", "Uninitialized", "Restart")]
    return table(columns, _RECOVERY, results, last=("the paper", _PAPER))


_CAMPAIGNS = {
    "55": "one gap of 4 s",
    "56": "one false failover, 790 and 186 steps of state",
    "57": "one command from 18 s before the switch",
    "58": "nothing",
    "59": "gaps of 93, 62, 6, 5, 3 and 2 s; 14 commands that the judge took for another's",
    "60": "one gap of 2 s and one failover, which the judge misjudged",
    "61": "135 steps of state, which the judge misjudged: the monitor had been cut off with its node",
    "62": "one gap of 2.7 s, which the judge misjudged: the instance of the last strategy was frozen as soon as it drove",
    "63": "nothing",
    "64": "nothing",
    "65": "a standby drove for 14 s that an edited gate let through; one false failover",
    "66": "three tracebacks: a monitor asked its tree for a reason after a message had arrived, and started again",
    "71": "one traceback: an agent imported one package in two threads; seven commands, which the judge misjudged",
    "72": "four tracebacks: an agent whose caller had gone already, and a monitor that ended; three gaps and one command, which the "
    "judge misjudged",
    "73": "with a mux: nine commands of a fenced instance, up to 0.56 s after the fence; five gaps while Kubernetes waited to start a "
    "killed mux again; one pod too many. Without: one failover, which the judge misjudged",
    "75": "one command, 0.21 s old when a closed gate opened; one reader with a reflex that switched although nobody was silent",
}
"""What did not hold in each campaign of faults, which is judged by people."""


def campaigns(results: Path) -> str:
    """Return the campaigns of random faults, each on its commit, and their sums."""
    lines = ["| campaign | commit | faults | recoveries | did not hold |", f"|{' --- |' * 5}"]
    sums = [0.0, 0.0]
    for number, remark in _CAMPAIGNS.items():
        result = figures.read(results / f"chaos-{number}.json")
        counts = [sum(result["figures"][name]["values"]) for name in ("faults that were made", "recoveries")]
        sums = [before + count for before, count in zip(sums, counts, strict=True)]
        cells = [f"[{number}](../bench/results/chaos-{number}.json)", figures.short(result["commit"])]
        lines.append(f"| {' | '.join([*cells, *(f'{count:.0f}' for count in counts), remark])} |")
    return "\n".join([*lines, f"| all | | {' | '.join(f'{count:,.0f}' for count in sums)} | |"])


# -- examples/ --------------------------------------------------------------------------------------------------------

_NAVIGATION = {
    "t_detection": "[*: t_detection; mean in s; 2]",
    "t_cluster": "[*: t_cluster; mean in s; 2]",
    "t_startup": "[*: t_startup; mean in s; 2]",
    "t_re-initialization": "[*: t_reinitialization; mean in s; 2]",
    "t_recovery": "[*: t_recovery; mean in s; 2]",
    "robot without commands, p50 / p95": "[*: robot: gap without commands; p50 p95 in s; 2]",
    "localization off after the hand-over, at most": "[*: localization error after hand-over; max; 2] m",
    "commands of two pods overlapping, at most": "[*: robot: overlap of two pods; max in s; 2]",
    "mean CPU of the stacks, milli-CPU": "[*: mean CPU of stacks; mean; 0]",
}


def navigation(results: Path) -> str:
    """Return the figures of each configuration of a navigation stack."""
    stacks = {"navigation": "", "nav2": "Nav2: "}
    return table([*configurations(stacks, {"executing": "full navigation"}, results)], _NAVIGATION, results)


_MANIPULATION = {
    "recovered, p50 / p95": "[*: t_recovery; p50 p95 in s; 2] s",
    "the robot without commands, p50 / p95": "[*: robot: gap without commands; p50 p95 in s; 2] s",
    "largest joint step at a hand-over, of all": "[*: largest joint step at the hand-over; max; 1] mrad",
    "the same by that of the motion before, at most": "[*: the same by that of undisturbed motion; max; 2]",
    "mean CPU of all pods": "[*: mean CPU in all; mean; 0] milli-CPU",
}


def manipulation(results: Path) -> str:
    """Return the figures of each configuration of a planner for an arm."""
    stacks = {"manipulation": "", "moveit2": "MoveIt 2: "}
    return table([*configurations(stacks, {"executing": "full execution"}, results)], _MANIPULATION, results)


# -- docs/ ------------------------------------------------------------------------------------------------------------

_SCALE = {
    "operator at rest": (
        "[operator at rest, CPU, *; p50; 0] milli-CPU, [operator at rest, memory, *; max; 0] MB",
        "100, 250",
    ),
    "its list of everything, with the rests between its parts": (
        "[operator's list of everything, *; p50; 1] s",
        "60 s",
    ),
    "writes of healthy workloads, a minute": ("[writes of a healthy workload, *; max; 1]", "none"),
    "100 failures at once, until all were driven again": (
        "[100 failures at once, all recovered, *; p50; 1] s",
        "",
    ),
    "writes per failover, monitor and operator": (
        "[writes per failover, monitor, *; p50; 1] and [writes per failover, operator, *; p50; 1]",
        "6 (monitor)",
    ),
    "writes per failover of a burst": (
        "[writes per failover of a burst, monitor, *; p50; 1] and [writes per failover of a burst, operator, *; p50; 1]",
        "",
    ),
    "two failures a second: each recovered, p50 / p95": ("[2 failures/s, each recovered, *; p50 p95; 2] s", ""),
    "watch events per failover": (
        "[watch events per failover, *; p50; 0], [watch traffic per failover, *; p50; 2] MB",
        "",
    ),
    "claims at 100/s, p50 / p99": (
        "**[claims at 100/s, *; p50; 0] / [claims at 100/s, p99, *; p50; 0] ms**",
        "300 ms",
    ),
    "claims made twice, and lost": ("[claims made twice, *; max; 0], [claims lost, *; max; 0]", "none"),
    "of a claim: reads, watch events, lost races": (
        "[reads per claim, monitor, *; p50; 1], [watch events per claim, *; p50; 0], [races lost per claim, *; p50; 2]",
        "",
    ),
    "processor time of a claim: API server, monitors, operator": (
        "[CPU per claim, API server, *; p50; 0], [CPU per claim, monitors, *; p50; 0], [CPU per claim, operator, *; p50; 0] ms",
        "",
    ),
    "operator's start: time, memory, writes": (
        "[operator's start until all was looked at, *; p50; 1] s, [operator's memory at its start, *; p50; 1] MB, "
        "[writes at its start, *; max; 0]",
        "60 s, 250 MB, none",
    ),
}


def scale(results: Path) -> str:
    """Return the figures of fleets, by their number of robots, with the bounds of the greatest."""
    columns = [Column(f"{size} robots", "scale", f"{size} robots") for size in (100, 300, 1000)]
    rows = {label: template for label, (template, _) in _SCALE.items()}
    return table(columns, rows, results, last=("bound", [bound for _, bound in _SCALE.values()]))


_GAPS = {
    "on the cluster, timeout of 500 ms": "500 ms gap: ",
    "on the cluster, reflex of 100 ms": "100 ms reflex: ",
    "outside the cluster, with 385 messages a second": "",
}
"""Each robot of the soak, with what its figures begin with."""

_LIMITS = (100, 150, 200)


def gaps(results: Path) -> str:
    """Return the worst gaps of each minute that a busy machine makes without a failure, by robot."""
    heads = [
        "robot",
        "switches",
        "worst gap of a minute: p50 / p95 / max",
        "minutes with a gap above 100 ms",
        "above 150 ms",
    ]
    lines = [f"| {' | '.join([*heads, 'above 200 ms'])} |", f"|{' --- |' * 6}"]
    found = figures.read(results / "soak.json")["figures"]
    for robot, prefix in _GAPS.items():
        worst = found[f"{prefix}worst gap of /cmd_vel, each minute"]
        switches = found.get(f"{prefix}needless switches of the reader")
        cells = [f"{switches['max']:.0f}" if switches else "-"]
        cells.append(f"{' / '.join(f'{worst[of]:.0f}' for of in ('p50', 'p95', 'max'))} ms")
        cells += [str(sum(value > limit for value in worst["values"])) for limit in _LIMITS]
        lines.append(f"| {' | '.join([robot, *cells])} |")
    return "\n".join([*lines, "", figures.sources(results, {"soak"})])


_BLACKBOX = {
    "memory of the monitor": "[memory, * (a monitor without it, same run); p50; 1] MB",
    "more for the black box": "**[memory of the black box, *; p50; 1] MB**",
    "CPU of the monitor": "[CPU, * (a monitor without it, same run); mean; 0] milli-CPU",
    "more for the black box, mean of six differences": "**[CPU of the black box, *; mean; 1] milli-CPU**",
    "the least and the greatest of them": "[CPU of the black box, *; min max; 1] milli-CPU",
}


def blackbox(results: Path) -> str:
    """Return what the black box costs a monitor, without and with images."""
    columns = [Column(subject, "blackbox", subject) for subject in ("without images", "with images")]
    return table(columns, _BLACKBOX, results)


_OFF = {
    "place of a robot that stands": ("place", 1, "mm"),
    "its heading": ("heading", 2, "degrees"),
    "speed at 0.3 m/s, straight": ("speed at 0.3 m/s and 0 rad/s", 1, "mm/s"),
    "its turning": ("turn at 0.3 m/s and 0 rad/s", 3, "rad/s"),
    "speed at 0.3 m/s, turning at 0.4 rad/s": ("speed at 0.3 m/s and 0.4 rad/s", 1, "mm/s"),
    "its turning then": ("turn at 0.3 m/s and 0.4 rad/s", 3, "rad/s"),
    "a stop at 0.3 m/s, while commands go on: found after": ("stop found after", 2, "s"),
}


def tracker(results: Path) -> str:
    """Return by how much the tracker is wrong, and what it takes."""
    found = figures.read(results / "tracker.json")["figures"]
    lines = ["| | n | median / p95 / max |", "| --- | --- | --- |"]
    for label, (name, decimals, unit) in _OFF.items():
        numbers = [figures.written(value, decimals) for value in figures.statistics(found[name], "p50 p95 max")]
        lines.append(f"| {label} | {found[name]['n']} | {' / '.join(numbers)} {unit} |")
    alarms, computing = found["false alarms"], found["computing"]
    lines.append(f"| false alarms in 10 minutes of ordinary driving | | {alarms['max']:.0f} |")
    lines.append(f"| computing for an image | | {computing['p50']:.1f} ms |")
    return "\n".join([*lines, "", figures.sources(results, {"tracker"})])


def published(_results: Path) -> str:
    """Return the published figures of each strategy, which the choice of strategies has in the code.

    A unit test compares them with those of the navigation stack.
    """
    lines = ["| | recovers in | CPU of a standby |", "| --- | --- | --- |"]
    for way, seconds in PUBLISHED_SECONDS.items():
        time = f"{seconds:.2f} s" if seconds >= 1 else f"{1000 * seconds:.0f} ms"
        cpu = "" if way == "Restart" else f"{100 * PUBLISHED_CPU[way]:.0f} %"
        lines.append(f"| `{way}` | {time} | {cpu} |")
    return "\n".join(lines)


TABLES: Mapping[str, Callable[[Path], str]] = {
    "recovery": recovery,
    "campaigns": campaigns,
    "navigation": navigation,
    "manipulation": manipulation,
    "scale": scale,
    "gaps": gaps,
    "blackbox": blackbox,
    "tracker": tracker,
    "published": published,
}
"""Every table that a page can have, by the name in its markers."""

"""The results of a bench: a table for people, and ``bench/results/NAME.json`` with all raw values of each figure.

    report = Report("monitor")
    report.figure("detection", values, unit="ms", must={"p95": 15})
    report.baseline("detection", others, unit="ms", of="rclpy callbacks")
    print(report.table())
    print(report.write())

A baseline is the result of another way to do the same in the same run, or of a paper. ``held`` is whether every figure
is within its bounds.
"""

from __future__ import annotations

import json
import os
import platform
import re
import statistics
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent


def quantile(values: Sequence[float], fraction: float) -> float:
    """Return a quantile of whole percent, interpolated linearly between the two nearest ranks."""
    cuts = statistics.quantiles([*values] * (2 if len(values) == 1 else 1), n=100, method="inclusive")
    return [min(values), *cuts, max(values)][round(100 * fraction)]


def of_network(name: str, cluster: str) -> str:
    """Return the name of the results of a bench on a cluster, of which ``cluster`` is the status: another network has files of its own."""
    found = re.search(r"\bnetwork (\S+),", cluster)
    return name if found is None or found[1] == "own" else f"{name}-{found[1]}"


def columns(rows: Sequence[Sequence[str]]) -> str:
    """Return a table of words, the first row of which is the head."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


@dataclass
class Figure:
    """One quantity, measured several times."""

    name: str
    values: list[float]
    unit: str
    must: dict[str, float] = field(default_factory=dict)
    """Maximum values, by n, p50, p95, max or mean."""
    limit: str = ""
    """What the figure is compared with, in words."""
    of: str = ""
    """What was measured, if it is not ours."""

    @property
    def summary(self) -> dict[str, float]:
        """n, p50, p95, max and mean."""
        return {
            "n": len(self.values),
            "p50": quantile(self.values, 0.5),
            "p95": quantile(self.values, 0.95),
            "max": max(self.values),
            "mean": statistics.fmean(self.values),
        }

    @property
    def held(self) -> bool:
        """Whether the figure is within every bound."""
        return all(self.summary[key] <= most for key, most in self.must.items())

    def remark(self) -> str:
        """Return the bounds and whether they are kept, for the table."""
        bounds = [
            f"{key} <= {most:g}: {'ok' if self.summary[key] <= most else 'MISSED'}" for key, most in self.must.items()
        ]
        return ", ".join([*bounds, *([self.limit] if self.limit else [])])

    def json(self) -> dict[str, Any]:
        """Return the figure with its raw values."""
        extra = {key: value for key, value in {"must": self.must, "limit": self.limit, "of": self.of}.items() if value}
        return {
            **self.summary,
            "unit": self.unit,
            **extra,
            **({"held": self.held} if self.must else {}),
            "values": self.values,
        }


class Report:
    """The figures of one run of a bench."""

    def __init__(self, name: str) -> None:
        """``name`` is that of the bench and of its file of results."""
        self.name = name
        self._date = datetime.now(UTC)
        self._begun = processor_seconds()
        self._figures: list[Figure] = []
        self._baselines: list[Figure] = []
        self._notes: dict[str, str] = {}

    def figure(
        self, name: str, values: Sequence[float], *, unit: str, must: Mapping[str, float] | None = None, limit: str = ""
    ) -> Report:
        """Add a figure of ours. ``must`` bounds it, such as ``{"p95": 15}``; ``limit`` is what it is compared with, in
        words."""
        self._figures.append(_figure(name, values, unit, dict(must or {}), limit, ""))
        return self

    def baseline(self, name: str, values: Sequence[float], *, unit: str, of: str) -> Report:
        """Add a figure of something else, for comparison; ``of`` names its subject and source."""
        self._baselines.append(_figure(name, values, unit, {}, "", of))
        return self

    def note(self, name: str, text: str) -> Report:
        """Add a fact that is needed to interpret the figures, such as how the load was made."""
        self._notes[name] = text
        return self

    @property
    def held(self) -> bool:
        """Whether every figure is within its bounds."""
        return all(figure.held for figure in self._figures)

    def table(self) -> str:
        """Return the figures and baselines as a table, with the notes below."""
        head = ["figure", "n", "p50", "p95", "max", "unit", ""]
        rows = [head]
        for figure in [*self._figures, *self._baselines]:
            summary = figure.summary
            name = f"  {figure.name} ({figure.of})" if figure.of else figure.name
            numbers = [f"{summary['n']}", *(f"{summary[key]:.4g}" for key in ("p50", "p95", "max"))]
            rows.append([name, *numbers, figure.unit, figure.remark()])
        widths = [max(len(row[column]) for row in rows) for column in range(len(head))]
        lines = []
        for row in rows:
            cells = [
                cell.rjust(width) if 0 < i < 5 else cell.ljust(width)
                for i, (cell, width) in enumerate(zip(row, widths, strict=True))
            ]
            lines.append("  ".join(cells).rstrip())
        lines.insert(1, "-" * max(len(line) for line in lines))
        machine = {
            "machine": f"{_machine_note()}, {self._stolen():.1f} % of the processor time needed went to other machines"
        }
        notes = [f"{name}: {text}" for name, text in {**machine, "commit": commit(), **self._notes}.items()]
        return "\n".join([f"bench {self.name}", *lines, "", *notes])

    def json(self) -> dict[str, Any]:
        """Return the whole report, as it is written."""
        return {
            "bench": self.name,
            "date": self._date.isoformat(timespec="seconds"),
            "commit": commit(),
            "machine": {**machine(), "stolen_percent": round(self._stolen(), 2)},
            "notes": self._notes,
            "figures": {figure.name: figure.json() for figure in self._figures},
            "baselines": {f"{figure.name} ({figure.of})": figure.json() for figure in self._baselines},
        }

    def _stolen(self) -> float:
        """Return the percentage of the requested processor time since the start that the host gave to other machines."""
        used, stolen = (now - then for now, then in zip(processor_seconds(), self._begun, strict=True))
        return 100 * stolen / (used + stolen) if stolen else 0.0

    def write(self, folder: Path = HERE / "results") -> Path:
        """Write ``NAME.json``, and return its path, relative to the current folder if it is below that."""
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / f"{self.name}.json"
        file.write_text(json.dumps(self.json(), indent=1) + "\n")
        return file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file


def _figure(name: str, values: Sequence[float], unit: str, must: dict[str, float], limit: str, of: str) -> Figure:
    if not values:
        raise ValueError(f"figure {name!r} has no values: nothing was measured")
    if unknown := set(must) - {"n", "p50", "p95", "max", "mean"}:
        raise ValueError(f"figure {name!r}: must bounds {', '.join(sorted(unknown))}; known are n, p50, p95, max, mean")
    return Figure(name, [float(value) for value in values], unit, must, limit, of)


def machine() -> dict[str, Any]:
    """Return the properties of this machine: processor, cores, memory, kernel, system, Python."""
    return {
        "processor": _line("/proc/cpuinfo", "model name") or platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "memory_gib": round(int((_line("/proc/meminfo", "MemTotal") or "0 kB").split()[0]) / 2**20, 1),
        "kernel": platform.release(),
        "system": platform.freedesktop_os_release().get("PRETTY_NAME", platform.system()),
        "python": platform.python_version(),
        "load_1_min": round(os.getloadavg()[0], 2),
    }


def _machine_note() -> str:
    found = machine()
    return (
        f"{found['processor']}, {found['cores']} cores, {found['memory_gib']} GiB, {found['system']}, "
        f"kernel {found['kernel']}, Python {found['python']}, load {found['load_1_min']}"
    )


def processor_seconds() -> tuple[float, float]:
    """Return the processor time used and stolen since the machine's start, in seconds of one core (proc_stat(5)); 0 if
    unknown."""
    fields = [int(word) for word in (_line("/proc/stat", "cpu ", separator=" ") or "").split()]
    if len(fields) < 8:
        return 0.0, 0.0
    user, nice, system, _idle, _waiting, hard, soft, stolen, *_ = fields
    ticks = os.sysconf("SC_CLK_TCK")
    return (user + nice + system + hard + soft) / ticks, stolen / ticks


def _line(file: str, key: str, *, separator: str = ":") -> str | None:
    """Return the value of a key in a ``key : value`` file of /proc."""
    try:
        with open(file) as lines:
            return next((line.split(separator, 1)[1].strip() for line in lines if line.startswith(key)), None)
    except OSError:
        return None


def commit() -> str:
    """Return the present commit, with ``-dirty`` if files differ from it; ``unknown`` outside a clone."""
    found = subprocess.run(
        ["git", "describe", "--always", "--abbrev=12", "--dirty", "--exclude=*"],
        cwd=HERE,
        capture_output=True,
        text=True,
    )
    return found.stdout.strip() or "unknown"

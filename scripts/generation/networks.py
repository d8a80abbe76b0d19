"""Builds the tables of measured networks and handovers in ``docs/how-to/network-policies.md`` from ``bench/results``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

BEGIN = "<!-- networks: written by scripts/generate from bench/results -->"
END = "<!-- end of networks -->"

HANDOVERS_BEGIN = "<!-- handovers: written by scripts/generate from bench/results -->"
HANDOVERS_END = "<!-- end of handovers -->"

_NETWORKS = {"": "the local provider's own", "-cilium": "Cilium 1.18.4"}
"""Endings of the names of the results, and what enforced the policies."""

_COLUMNS = {
    "switch": ("recovery", "executing: decision to gate enforced"),
    "gap at the robot, `Executing`": ("recovery", "executing: robot: gap without commands"),
    "gap, `Uninitialized`": ("recovery", "uninitialized: robot: gap without commands"),
    "gap, `Restart`": ("recovery", "restart: robot: gap without commands"),
    "gap with a reflex": ("reflex", "all: robot's gap"),
}

_HANDOVERS = ("Switch", "BreakBeforeMake")


def table(results: Path) -> str:
    """Return p50, p95 and maximum of each figure in ms, by network, as Markdown."""
    lines = [f"| network | {' | '.join(_COLUMNS)} | measured |", f"| --- |{' --- |' * (len(_COLUMNS) + 1)}"]
    for ending, network in _NETWORKS.items():
        found = {bench: _read(results / f"{bench}{ending}.json") for bench in ("recovery", "reflex")}
        if any(found.values()):
            cells = [_cell(found[bench], figure) for bench, figure in _COLUMNS.values()]
            runs = [_run(one) for one in found.values() if one]
            lines.append(f"| {network} | {' | '.join(cells)} | {', '.join(dict.fromkeys(runs))} |")
    return "\n".join(lines)


def handovers(results: Path) -> str:
    """Return p50, p95 and maximum of both ways of a handover in ms, by network, as Markdown."""
    lines = ["| network | `handover` | no command | both open | measured |", f"|{' --- |' * 5}"]
    for ending, network in _NETWORKS.items():
        found = _read(results / f"handover{ending}.json")
        for handover in _HANDOVERS:
            gap, both = (_cell(found, f"{handover}: {name}", digits=1) for name in ("gap", "both open"))
            if gap:
                lines.append(f"| {network} | `{handover}` | {gap} | {both} | {_run(found)} |")
    return "\n".join(lines) if len(lines) > 2 else "Not measured yet: run `scripts/bench handover`."


def _run(result: Any) -> str:
    return f"{result['date'][:10]} on {result['commit'][:8]}"


def _read(file: Path) -> Any:
    return json.loads(file.read_text()) if file.is_file() else {}


def _cell(result: Any, figure: str, digits: int = 0) -> str:
    found = (result.get("figures") or {}).get(figure)
    return " / ".join(f"{found[key]:.{digits}f}" for key in ("p50", "p95", "max")) if found else ""

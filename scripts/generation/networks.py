"""Builds the table of measured networks in ``docs/how-to/network-policies.md`` from ``bench/results``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

BEGIN = "<!-- networks: written by scripts/generate from bench/results -->"
END = "<!-- end of networks -->"

_NETWORKS = {"": "the local provider's own", "-cilium": "Cilium 1.18.4"}
"""Endings of the names of the results, and what enforced the policies."""

_COLUMNS = {
    "switch": ("recovery", "executing: decision to gate enforced"),
    "gap at the robot, `Executing`": ("recovery", "executing: robot: gap without commands"),
    "both drive": ("recovery", "executing: robot: overlap of two pods"),
    "gap, `Uninitialized`": ("recovery", "uninitialized: robot: gap without commands"),
    "gap, `Restart`": ("recovery", "restart: robot: gap without commands"),
    "gap with a reflex": ("reflex", "all: robot's gap"),
}


def table(results: Path) -> str:
    """Return p50, p95 and maximum of each figure in ms, by network, as Markdown."""
    lines = [f"| network | {' | '.join(_COLUMNS)} | measured |", f"| --- |{' --- |' * (len(_COLUMNS) + 1)}"]
    for ending, network in _NETWORKS.items():
        found = {bench: _read(results / f"{bench}{ending}.json") for bench in ("recovery", "reflex")}
        if any(found.values()):
            cells = [_cell(found[bench], figure) for bench, figure in _COLUMNS.values()]
            runs = [f"{one['date'][:10]} on {one['commit'][:8]}" for one in found.values() if one]
            lines.append(f"| {network} | {' | '.join(cells)} | {', '.join(dict.fromkeys(runs))} |")
    return "\n".join(lines)


def _read(file: Path) -> Any:
    return json.loads(file.read_text()) if file.is_file() else {}


def _cell(result: Any, figure: str) -> str:
    found = (result.get("figures") or {}).get(figure)
    return f"{found['p50']:.0f} / {found['p95']:.0f} / {found['max']:.0f}" if found else ""

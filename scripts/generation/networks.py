"""Builds the tables of networks and handovers in ``docs/how-to/network-policies.md`` and ``README.md`` from ``bench/results``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scripts.generation import figures

BEGIN = "<!-- networks: written by scripts/generate from bench/results -->"
END = "<!-- end of networks -->"

HANDOVERS_BEGIN = "<!-- handovers: written by scripts/generate from bench/results -->"
HANDOVERS_END = "<!-- end of handovers -->"

SUMMARY_BEGIN = "<!-- compatibility: written by scripts/generate from bench/results -->"
SUMMARY_END = "<!-- end of compatibility -->"


@dataclass(frozen=True)
class _Network:
    """What enforces NetworkPolicies, and what is known about it beside its figures, as Markdown."""

    name: str
    flows: str
    """What happens to established flows after a change."""
    gate: str
    """Whether NetworkPolicies can be the gate."""
    mux: str = "yes"
    ending: str | None = None
    """Ending of the names of its results; None if there are none."""


_ROOM = "docs/how-to/network-policies.md#cilium"

_NETWORKS = (
    _Network("the local provider's own", "end", "yes", ending=""),
    _Network(
        "Cilium 1.18.4",
        "end",
        f"yes, with up to about 260 pods among the peers of a workload; more [need a setting]({_ROOM})",
        ending="-cilium",
    ),
    _Network("kind's own", "not known", "not tried yet", "not tried yet"),
    _Network("kube-router, kube-network-policies", "live on", "no"),
    _Network("one that enforces nothing", "", "no"),
)

_MEASURED = {network.ending: network.name for network in _NETWORKS if network.ending is not None}

_COLUMNS = {
    "switch": ("recovery", "executing: decision to gate enforced"),
    "gap at the robot, `Executing`": ("recovery", "executing: robot: gap without commands"),
    "gap, `Uninitialized`": ("recovery", "uninitialized: robot: gap without commands"),
    "gap, `Restart`": ("recovery", "restart: robot: gap without commands"),
    "gap with a reflex": ("reflex", "all: robot's gap"),
}

_HANDOVERS = ("Switch", "BreakBeforeMake")


def summary(results: Path) -> str:
    """Return what is known of each network, with p50 and p95 of a switch in ms and the files of these, as Markdown."""
    columns = ("network", "flows that exist at a change", "switch, p50 / p95", "NetworkPolicies as the gate")
    lines = [f"| {' | '.join(columns)} | [mux](docs/mux.md) as the gate |", "| --- | --- | --- | --- | --- |"]
    bench, figure = _COLUMNS["switch"]
    for one in _NETWORKS:
        found = figures.read(results / f"{bench}{one.ending}.json") if one.ending is not None else {}
        switch = _cell(found, figure, of=("p50", "p95"))
        lines.append(f"| {one.name} | {one.flows} | {switch and f'{switch} ms'} | {one.gate} | {one.mux} |")
    files = (f"{bench}{one.ending}" for one in _NETWORKS if one.ending is not None)
    return "\n".join([*lines, "", figures.sources(results, files)])


def table(results: Path) -> str:
    """Return p50, p95 and maximum of each figure in ms, by network, as Markdown."""
    lines = [f"| network | {' | '.join(_COLUMNS)} | measured |", f"| --- |{' --- |' * (len(_COLUMNS) + 1)}"]
    for ending, network in _MEASURED.items():
        found = {bench: figures.read(results / f"{bench}{ending}.json") for bench in ("recovery", "reflex")}
        if any(found.values()):
            cells = [_cell(found[bench], figure) for bench, figure in _COLUMNS.values()]
            runs = [_run(one) for one in found.values() if one]
            lines.append(f"| {network} | {' | '.join(cells)} | {', '.join(dict.fromkeys(runs))} |")
    return "\n".join(lines)


def handovers(results: Path) -> str:
    """Return p50, p95 and maximum of both ways of a handover in ms, by network, as Markdown."""
    lines = ["| network | `handover` | no command | both open | measured |", f"|{' --- |' * 5}"]
    for ending, network in _MEASURED.items():
        found = figures.read(results / f"handover{ending}.json")
        for handover in _HANDOVERS:
            gap, both = (_cell(found, f"{handover}: {name}", digits=1) for name in ("gap", "both open"))
            if gap:
                lines.append(f"| {network} | `{handover}` | {gap} | {both} | {_run(found)} |")
    return "\n".join(lines) if len(lines) > 2 else "Not measured yet: run `scripts/bench handover`."


def _run(result: Any) -> str:
    return f"{result['date'][:10]} on {figures.short(result['commit'])}"


def _cell(result: Any, figure: str, digits: int = 0, of: tuple[str, ...] = ("p50", "p95", "max")) -> str:
    found = (result.get("figures") or {}).get(figure)
    return " / ".join(f"{found[key]:.{digits}f}" for key in of) if found else ""

"""The tables of ``docs/how-to/network-policies.md`` are made of the results of the benches."""

from __future__ import annotations

import json
from pathlib import Path

from scripts.generation import networks


def result(folder: Path, name: str, **figures: tuple[float, float, float]) -> None:
    """Write the result of a bench, with p50, p95 and maximum of each figure."""
    written = {key: dict(zip(("p50", "p95", "max"), found, strict=True)) for key, found in figures.items()}
    found = {"date": "2026-12-01T10:00:00+00:00", "commit": "0123456789ab", "figures": written}
    (folder / f"{name}.json").write_text(json.dumps(found))


def test_a_handover_has_a_row_for_each_network_on_which_it_was_measured(tmp_path: Path) -> None:
    switch, closed = {"Switch: gap": (0, 4, 9.94), "Switch: both open": (5.04, 9, 12)}, (70, 80, 91.26)
    result(tmp_path, "handover", **switch, **{"BreakBeforeMake: gap": closed, "BreakBeforeMake: both open": (0, 0, 0)})
    result(tmp_path, "handover-cilium", **switch)
    _, _, *rows = networks.handovers(tmp_path).splitlines()
    measured = "2026-12-01 on 01234567"
    assert rows == [
        f"| the local provider's own | `Switch` | 0.0 / 4.0 / 9.9 | 5.0 / 9.0 / 12.0 | {measured} |",
        f"| the local provider's own | `BreakBeforeMake` | 70.0 / 80.0 / 91.3 | 0.0 / 0.0 / 0.0 | {measured} |",
        f"| Cilium 1.18.4 | `Switch` | 0.0 / 4.0 / 9.9 | 5.0 / 9.0 / 12.0 | {measured} |",
    ]


def test_without_results_the_page_says_how_handovers_are_measured(tmp_path: Path) -> None:
    assert networks.handovers(tmp_path) == "Not measured yet: run `scripts/bench handover`."


def test_a_network_has_a_row_with_the_figures_that_were_measured_on_it(tmp_path: Path) -> None:
    result(tmp_path, "recovery-cilium", **{"executing: robot: gap without commands": (530.4, 549, 550)})
    head, _, row = networks.table(tmp_path).splitlines()
    cells = dict(
        zip((cell.strip() for cell in head.split("|")), (cell.strip() for cell in row.split("|")), strict=True)
    )
    assert cells["network"] == "Cilium 1.18.4"
    assert cells["gap at the robot, `Executing`"] == "530 / 549 / 550"
    assert cells["gap with a reflex"] == ""

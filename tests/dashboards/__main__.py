"""Draws the chart's dashboards, with what a real Prometheus answers about a made-up fleet."""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from datetime import UTC, datetime
from pathlib import Path

from tests.dashboards.boards import Object, answered, rendered
from tests.dashboards.fleet import SCRAPED, fleet, moments
from tests.e2e.past import openmetrics
from tests.support.prometheus import built, fill, serving

CHOSEN = {"understudy-robot": {"namespace": "warehouse", "workload": "amr-07-navigation"}}
"""What somebody chose above a dashboard; nothing is all of it."""

ICONS = Path("node_modules", "@grafana", "ui", "dist", "public")
"""Which a page asks for beside itself."""
WIDTH = 1400
ROW, MARGIN, HEAD = 30, 8, 64
"""Of Grafana's grid, and of what is above it, in pixels."""


END = datetime(2026, 3, 2, 14, tzinfo=UTC).timestamp()
"""Of that past: always the same, so that pictures change with dashboards only."""
SERVED = (f"--query.lookback-delta={SCRAPED}s", "--storage.tsdb.retention.time=100y")
"""Blocks made by promtool have no marks of series that ended: one is over when it isn't in the next scrape."""


def main() -> None:
    """Make a history of metrics, serve it, query it and draw the result."""
    parser = argparse.ArgumentParser(prog="scripts/dashboards")
    parser.add_argument("--bundle", type=Path, required=True, help="the drawing program, in the folder of its packages")
    parser.add_argument("--out", type=Path, default=Path("docs/images"), help="where pictures go")
    parser.add_argument("--theme", choices=("light", "dark"), default="light")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    programs, operator = built(), fleet(END)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        fill(programs, place, openmetrics(moments(END), [*operator.robots, operator]))
        (place / "public").symlink_to(given.bundle.resolve().parent / ICONS)
        with serving(programs, place, *SERVED) as url:
            for name, board in rendered().items():
                answers = answered(url, board, END, SCRAPED, CHOSEN.get(name, {}))
                picture = given.out / f"dashboard-{name.removeprefix('understudy-')}.png"
                _draw(place, given.bundle, picture, {"theme": given.theme, "board": board, **answers})


def _draw(place: Path, bundle: Path, picture: Path, found: Object) -> None:
    rows = max(panel["gridPos"]["y"] + panel["gridPos"]["h"] for panel in found["board"]["panels"])
    program, styles = (path.resolve().as_uri() for path in (bundle, bundle.with_suffix(".css")))
    data = json.dumps({"width": WIDTH, **found}).replace("<", "\\u003c")
    (place / "page.html").write_text(
        f'<!doctype html><meta charset="utf-8"><link rel="stylesheet" href="{styles}"><body>'
        f'<script>window.given = {data}</script><script src="{program}"></script>'
    )
    picture.unlink(missing_ok=True)
    command = [
        "chromium", "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars",
        "--allow-file-access-from-files", f"--user-data-dir={place / 'browser'}", "--virtual-time-budget=8000",
        f"--window-size={WIDTH},{HEAD + rows * (ROW + MARGIN)}", f"--screenshot={picture.resolve()}", "--enable-logging=stderr",
        (place / "page.html").as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    wrong = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    if wrong or not picture.exists():
        raise SystemExit("\n".join(wrong) or done.stderr)
    print(picture)


if __name__ == "__main__":
    main()

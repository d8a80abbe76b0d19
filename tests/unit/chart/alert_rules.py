"""The alerts of the chart, for tests."""

from __future__ import annotations

import yaml

from tests.unit.chart.conftest import CHART, Object

ALERTS = yaml.safe_load((CHART / "files" / "alerts.yaml").read_text())


OTHERS = {"process_cpu_seconds_total", "process_resident_memory_bytes", "process_start_time_seconds"}


def alerts() -> list[Object]:
    return [rule for group in ALERTS["groups"] for rule in group["rules"]]

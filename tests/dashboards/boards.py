"""Dashboards as Grafana would ask a Prometheus for them: what their variables are, at which steps, and what came."""

from __future__ import annotations

import json
import re
import subprocess
import urllib.parse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from tests.support.prometheus import asked

CHART = Path(__file__).parents[2] / "charts" / "understudy"
HOURS = re.compile(r"now-(\d+)h")

Object = dict[str, Any]


def rendered() -> dict[str, Object]:
    """The dashboards of the chart, by file."""
    command = [
        "helm",
        "template",
        "understudy",
        str(CHART),
        "--kube-version",
        "1.34",
        "--set",
        "metrics.dashboards.enabled=true,allNamespaces=true",
    ]
    text = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
    found: dict[str, Object] = {}
    for item in yaml.safe_load_all(text):
        if item and item["kind"] == "ConfigMap" and item["metadata"]["name"].endswith("-dashboards"):
            found |= {Path(name).stem: json.loads(board) for name, board in item["data"].items()}
    return found


def answered(url: str, board: Object, end: float, scraped: int, chosen: Mapping[str, str]) -> Object:
    """What each target of each panel came to, over the board's time until a moment; the variables are those chosen, or all."""
    (hours,) = (int(hours) for hours in HOURS.findall(board["time"]["from"]))
    begin = end - hours * 3600
    values = {
        "__rate_interval": f"{4 * scraped}s",
        "__interval": f"{scraped}s",
        "__range": f"{hours}h",
        "__range_s": f"{hours * 3600}",
    }
    values |= {v["name"]: chosen.get(v["name"], ".+") for v in board["templating"]["list"]}
    panels = {}
    for panel in board["panels"]:
        panels[panel["id"]] = [
            {"target": target, "result": _asked(url, _replaced(target["expr"], values), target, begin, end, scraped)}
            for target in panel["targets"]
        ]
    shown = {v["label"]: chosen.get(v["name"], "All") for v in board["templating"]["list"] if v["type"] != "datasource"}
    return {"from": begin, "to": end, "step": scraped, "variables": shown, "panels": panels}


def _replaced(expression: str, values: Mapping[str, str]) -> str:
    for name in sorted(values, key=len, reverse=True):
        expression = expression.replace(f"${name}", values[name]).replace(f"${{{name}}}", values[name])
    return expression


def _asked(url: str, expression: str, target: Object, begin: float, end: float, step: int) -> Any:
    given: dict[str, object] = {"query": expression}
    if target.get("instant"):
        return asked(url, "query?" + urllib.parse.urlencode(given | {"time": end}))["result"]
    given |= {"start": begin, "end": end, "step": step}
    return asked(url, "query_range?" + urllib.parse.urlencode(given))["result"]

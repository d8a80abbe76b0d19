"""The manifests of examples/forklift agree with each other and with what the operator writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from understudy.cli.check.command import check

EXAMPLES = Path(__file__).parents[3] / "examples"
FILES = sorted((EXAMPLES / "forklift" / "manifests").glob("*.yaml"))
ITEMS: list[dict[str, Any]] = [item for file in FILES for item in yaml.safe_load_all(file.read_text())]


def test_the_manifests_pass_the_check_without_findings() -> None:
    assert check([(file.name, file.read_bytes()) for file in FILES]).findings == []


def test_commands_use_modules_of_the_quickstart_image() -> None:
    pods = [item["spec"]["template"]["spec"] for item in ITEMS if "template" in item["spec"]]
    commands = [one["command"] for pod in pods for one in pod["containers"] if "command" in one]
    assert len(commands) == 2
    for command in commands:
        assert (EXAMPLES / "quickstart" / "src" / f"{command[2].replace('.', '/')}.py").is_file()

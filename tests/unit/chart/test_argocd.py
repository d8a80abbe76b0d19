"""Argo CD's health checks of the three kinds, executed by Lua."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from understudy.api.conditions import condition

CHECKS: dict[str, str] = yaml.safe_load(
    (Path(__file__).parents[3] / "examples" / "argocd" / "argocd-cm.yaml").read_text()
)["data"]
"""The Lua of each check, by its key in ConfigMap argocd-cm."""


def lua(value: Any) -> str:
    """Return JSON data as a Lua expression."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"[{lua(key)}] = {lua(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list):
        return "{" + ", ".join(map(lua, value)) + "}"
    return f'"{value}"' if isinstance(value, str) else str(value)


def health(status: dict[str, Any] | None) -> tuple[str, str]:
    """Return status and message that Argo CD shows for an object of generation 2."""
    item = {"metadata": {"generation": 2}, **({} if status is None else {"status": status})}
    [check] = set(CHECKS.values())
    program = f"local obj = {lua(item)}\nlocal found = (function()\n{check}\nend)()\nprint(found.status)\nprint(found.message)"
    done = subprocess.run(["lua5.4", "-"], input=program, capture_output=True, text=True, check=True, timeout=10)
    shown, message = done.stdout.splitlines()
    return shown, message


def status(generation: int = 2, **conditions: str) -> dict[str, Any]:
    found = [condition(type_, value, "Reason", f"message of {type_}").to_wire() for type_, value in conditions.items()]  # type: ignore[arg-type]
    return {"observedGeneration": generation, "conditions": found}


def test_each_kind_has_a_check() -> None:
    kinds = {key.removeprefix("resource.customizations.health.understudy.dev_") for key in CHECKS}
    assert kinds == {"RobotWorkload", "FailurePolicy", "FallbackPool"}


@pytest.mark.parametrize(
    ("conditions", "expected"),
    [
        ({"Ready": "True", "Accepted": "True"}, ("Healthy", "message of Ready")),
        ({"Ready": "False", "Accepted": "True"}, ("Progressing", "message of Ready")),
        ({"Ready": "False", "Accepted": "False"}, ("Degraded", "message of Accepted")),
        ({"Ready": "True", "Accepted": "True", "Paused": "True"}, ("Suspended", "message of Paused")),
        ({"Ready": "True", "Accepted": "True", "Paused": "False"}, ("Healthy", "message of Ready")),
    ],
)
def test_the_health_follows_the_conditions(conditions: dict[str, str], expected: tuple[str, str]) -> None:
    assert health(status(**conditions)) == expected


@pytest.mark.parametrize("reported", [None, {}, status(generation=1, Ready="True")])
def test_an_object_that_the_operator_has_not_observed_is_progressing(reported: dict[str, Any] | None) -> None:
    assert health(reported) == ("Progressing", "The operator has not observed this spec yet.")

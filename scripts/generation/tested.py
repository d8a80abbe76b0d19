"""Builds the page of which end-to-end tests show which features on pods, from the marks of the tests."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from understudy.api.kinds.failure_policy import Strategy
from understudy.api.kinds.fallback_pool import Readiness
from understudy.api.kinds.robot_workload import Gate, Output
from understudy.api.kinds.tree_spec import Form
from understudy.trees.leaves import procedure_leaves
from understudy.trees.leaves.registry import LEAVES, PLUGINS

TESTS = Path("tests/e2e")
MARK = "shows"

_INTRODUCTION = """\
# What is tested on pods

<!-- Written by scripts/generate from the marks of the tests in tests/e2e: change those. -->

Which end-to-end test (`scripts/test e2e`) shows which feature: on a cluster, with the chart, the images and the gate. The features are
those of the code, and a test has the mark `@pytest.mark.shows("leaf/topic")` if its outcome depends on the feature: a leaf fails and
something follows from that, a step or a condition of a procedure decides over an instance, a strategy or a standby recovers the
robot, an output or a gate is seen at the robot. **none** means that no test shows the feature on pods. Unit tests cover those
too."""


@dataclass(frozen=True)
class Case:
    """An end-to-end test."""

    file: str
    name: str


def features() -> list[str]:
    """Return every feature that should have a test, as ``kind/name``, from the code."""
    named: Mapping[str, Iterable[str]] = {
        "leaf": [name for name in LEAVES if name not in PLUGINS],
        "step": procedure_leaves.STEPS,
        "condition": procedure_leaves.CONDITIONS,
        "language": _choices(Form),
        "strategy": _choices(Strategy.model_fields["type"].annotation),
        "handover": _choices(Strategy.model_fields["handover"].annotation),
        "readiness": _choices(Readiness),
        "output": [name for name in ("topic", "service", "action") if name in Output.model_fields],
        "gate": _choices(Gate.model_fields["kind"].annotation),
    }
    return [f"{kind}/{name}" for kind, names in named.items() for name in names]


def shown(root: Path) -> dict[str, list[Case]]:
    """Return the tests that show each feature.

    Raises ValueError if a mark names something that is no feature.
    """
    found: dict[str, list[Case]] = {feature: [] for feature in features()}
    for file in sorted((root / TESTS).glob("test_*.py")):
        for function in ast.walk(ast.parse(file.read_text())):
            if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            for feature in _marked(function):
                if feature not in found:
                    raise ValueError(
                        f"{file.name}, {function.name}: {feature} is no feature; there are {', '.join(found)}"
                    )
                found[feature].append(Case(file.name, function.name))
    return found


def page(root: Path) -> str:
    """Return the whole page as Markdown."""
    found = shown(root)
    lines = [_INTRODUCTION, "", f"{sum(map(bool, found.values()))} of {len(found)} features have a test.", ""]
    lines += ["| feature | | tests |", "| --- | --- | --- |"]
    for feature, tests in found.items():
        kind, _, name = feature.partition("/")
        links = (f"[{test.name}](../../{TESTS}/{test.file})" for test in tests)
        lines.append(f"| {kind} | `{name}` | {', '.join(links) or '**none**'} |")
    return "\n".join(lines) + "\n"


def _choices(annotation: object) -> list[str]:
    """Return the literals of a type, also of one that may be None."""
    arguments = get_args(annotation)
    return [argument for argument in arguments if isinstance(argument, str)] or [
        choice for argument in arguments for choice in _choices(argument)
    ]


def _marked(function: ast.FunctionDef | ast.AsyncFunctionDef) -> Iterator[object]:
    """Yield what the marks of a function say that it shows."""
    for decorator in function.decorator_list:
        if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == f"pytest.mark.{MARK}":
            yield from (ast.literal_eval(argument) for argument in decorator.args)

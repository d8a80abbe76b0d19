"""Templates in the examples and pages, and those of the robots of tests and benchmarks, meet the level that the chart applies by default.

`tests/cluster/test_restricted.py` asks an API server about those of the examples.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest
import yaml

from bench.chaos.robots import CampaignRobot
from bench.chaos.ways import BY_NAME
from tests.e2e import test_bad_input, test_keep_up
from tests.e2e.faults import Stage, Switch
from tests.e2e.kubectl import Kubectl
from tests.e2e.scenario import Robot
from tests.e2e.test_degraded import Degrading
from tests.e2e.test_tasks import Cell
from tests.support.pages import PAGES, REPOSITORY, page_name
from tests.support.pod_security import BEYOND, violations
from tests.unit.chart.conftest import CHART
from tests.unit.kube.memory import merge

Object = dict[str, Any]

EXAMPLES = sorted((REPOSITORY / "examples").rglob("*.yaml"))

TESTS = sorted((REPOSITORY / "tests" / "e2e").glob("*.py"))


class Applied:
    """Keeps what is applied."""

    namespace = "none"

    def __init__(self) -> None:
        self.objects: list[Object] = []
        self.patches: list[Object] = []

    def apply(self, objects: list[Object]) -> None:
        self.objects += objects

    def patch(self, kind: str, name: str, body: Object) -> None:
        self.patches.append(body)

    def __call__(self, *_: str) -> str:
        return ""

    def list(self, *_: str) -> list[Object]:
        return [{"metadata": {"name": name}} for name in ("one", "two", "three")]


def templates(items: list[Object]) -> Iterator[tuple[str, Object]]:
    for item in items:
        if found := ((item or {}).get("spec") or {}).get("template"):
            yield f"{item['kind']} {item['metadata']['name']}", found


def assert_within(items: list[Object]) -> int:
    """Assert that all templates are within the level, and return their number."""
    found = list(templates(items))
    assert {name: violations(template) for name, template in found} == {name: [] for name, _ in found}
    return len(found)


def test_the_chart_applies_it_to_namespaces_without_a_level() -> None:
    assert yaml.safe_load((CHART / "values.yaml").read_text())["admission"]["podSecurity"] == "restricted"


@pytest.mark.parametrize(
    "file", [file for file in EXAMPLES if file not in BEYOND], ids=lambda file: str(file.relative_to(REPOSITORY))
)
def test_templates_of_the_examples_are_within_it(file: Path) -> None:
    assert_within(list(yaml.safe_load_all(file.read_text())))


def test_the_examples_have_templates() -> None:
    items = [item for file in EXAMPLES if file not in BEYOND for item in yaml.safe_load_all(file.read_text())]
    assert assert_within([item for item in items if item and item["kind"] == "RobotWorkload"]) >= 10


def written(page: Path) -> list[Object]:
    """Return the RobotWorkloads and FallbackPools with a template in a page: complete ones, and parts that begin with the spec."""
    text = page.read_text()
    blocks = re.findall(r"^ *```yaml\n(.*?)```", text, re.DOTALL | re.MULTILINE)
    blocks += re.findall(r"<<'?EOF'?\n(.*?)^EOF$", text, re.DOTALL | re.MULTILINE)
    found = []
    for block in blocks:
        if "template:" not in block:
            continue
        for item in yaml.safe_load_all(block):
            whole = item if "spec" in item else {"spec": item}
            whole = {"kind": "RobotWorkload", "metadata": {"name": "part"}, **whole}
            if whole["kind"] in ("RobotWorkload", "FallbackPool"):
                found.append(whole)
    return found


@pytest.mark.parametrize("page", [page for page in PAGES if written(page)], ids=page_name)
def test_templates_in_the_pages_are_within_it(page: Path) -> None:
    assert assert_within(written(page)) >= 1


def test_the_pages_have_templates() -> None:
    pages = {page.name for page in PAGES if written(page)}
    assert pages >= {"tutorial.md", "own-application.md", "nav2.md", "reflex.md", "tasks.md", "dependencies.md"}


@pytest.mark.parametrize("cell", [lambda to: Cell(to, "Executing"), Degrading], ids=["tasks", "degraded"])
def test_applications_with_tasks_in_tests_are_within_it(cell: Any) -> None:
    kubectl = Applied()
    cell(kubectl)
    assert assert_within(kubectl.objects) == 1


@pytest.mark.parametrize("workload", ["robotworkload.yaml", "managed/robotworkload.yaml"])
def test_robots_of_tests_are_within_it(workload: str) -> None:
    kubectl = cast(Kubectl, Applied())
    edits = [lambda item: Switch(kubectl).put_into(item["spec"]["template"]), test_keep_up.application, None]
    for edit in edits:
        assert assert_within(Robot(kubectl).objects(policy="any", workload=workload, edit=edit)) == 2
    placed = Robot(kubectl).objects(policy="any", workload=workload)
    Stage(kubectl).place(placed)
    assert assert_within(placed) == 2


def test_a_template_that_a_test_breaks_is_not_refused_for_its_security() -> None:
    kubectl = Applied()
    test_bad_input._template_broken(cast(Kubectl, kubectl))
    for item in Robot(cast(Kubectl, kubectl)).objects(policy="any"):
        if item["kind"] == "RobotWorkload":
            merge(item, kubectl.patches[0])
            assert assert_within([item]) == 1


@pytest.mark.parametrize("file", TESTS, ids=lambda file: file.name)
def test_containers_that_tests_write_have_a_security_context(file: Path) -> None:
    """A container is a dictionary with an image and a name."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Dict):
            keys = {key.value for key in node.keys if isinstance(key, ast.Constant)}
            if keys >= {"name", "image"}:
                assert "securityContext" in keys, f"{file.name}:{node.lineno}"


@pytest.mark.parametrize("way", BY_NAME)
def test_robots_of_campaigns_are_within_it(way: str) -> None:
    assert assert_within(CampaignRobot(cast(Kubectl, Applied()), 0, BY_NAME[way], 0.5).all_objects()) >= 2

"""The manipulation example's manifests agree with each other, with the API's models and with the trees."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.manifests import MODELS, assert_references_lead_somewhere, covers
from understudy.api import names
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.trees.languages.notations import load_monitoring

EXAMPLE = Path(__file__).parents[3] / "examples" / "manipulation"
FILES = sorted([*(EXAMPLE / "manifests").rglob("*.yaml"), *(EXAMPLE / "moveit2").rglob("*.yaml")])
ALL: list[tuple[Path, dict[str, Any]]] = [(f, m) for f in FILES for m in yaml.safe_load_all(f.read_text())]


def of_kind(kind: str, folder: str = "") -> list[dict[str, Any]]:
    return [m for file, m in ALL if m["kind"] == kind and (not folder or folder in file.parts)]


OURS = [m for kind in MODELS for m in of_kind(kind)]


def test_the_tests_cover_every_file() -> None:
    assert [str(f.relative_to(EXAMPLE)) for f in FILES] == [
        "manifests/client.yaml",
        "manifests/robot.yaml",
        *(f"manifests/strategies/{name}.yaml" for name in ("executing", "pod-started", "restart")),
        "manifests/workload.yaml",
        *(f"moveit2/{name}.yaml" for name in ("executing", "planner-running", "restart", "workload")),
    ]


@pytest.mark.parametrize("manifest", OURS, ids=lambda m: m["metadata"]["name"])
def test_specs_conform_to_the_models(manifest: dict[str, Any]) -> None:
    spec = MODELS[manifest["kind"]].model_validate(manifest["spec"])
    # The models ignore unknown fields; whatever was written must come back.
    assert covers(spec.to_wire(), manifest["spec"])
    if isinstance(spec, FailurePolicySpec):
        load_monitoring(spec.monitoring)


@pytest.mark.parametrize("folder", ["manifests", "moveit2"])
def test_references_resolve(folder: str) -> None:
    (workload,) = of_kind("RobotWorkload", folder)
    assert_references_lead_somewhere(workload, of_kind("FailurePolicy", folder), of_kind("FallbackPool", folder))


@pytest.mark.parametrize("folder", ["manifests", "moveit2"])
def test_every_policy_has_the_same_health_tree(folder: str) -> None:
    first, *others = of_kind("FailurePolicy", folder)
    for other in others:
        assert other["spec"]["monitoring"] == first["spec"]["monitoring"]


@pytest.mark.parametrize("file", ["robot.yaml", "client.yaml"])
def test_configuration_comes_from_the_operator(file: str) -> None:
    (workload,) = {m["metadata"]["name"] for m in of_kind("RobotWorkload", "manifests")}
    text = "\n".join(line.split("#")[0] for line in (EXAMPLE / "manifests" / file).read_text().splitlines())
    used = {word.strip("{},") for word in text.split() if word.startswith(f"{workload}-")}
    assert used
    assert used <= {names.robot_env(workload), names.robot_profiles(workload)}


def test_commands_use_modules_of_the_image() -> None:
    for kind in ("Deployment", "RobotWorkload", "Job"):
        for manifest in of_kind(kind, "manifests"):
            (container,) = manifest["spec"]["template"]["spec"]["containers"]
            assert container["command"][:2] == ["python3", "-m"]
            assert (EXAMPLE / "src" / container["command"][2] / "__main__.py").is_file()
            assert container["imagePullPolicy"] == "IfNotPresent"


def test_the_moveit_workload_has_the_same_metadata() -> None:
    (ours,), (moveit,) = of_kind("RobotWorkload", "manifests"), of_kind("RobotWorkload", "moveit2")
    assert moveit["metadata"] == ours["metadata"]

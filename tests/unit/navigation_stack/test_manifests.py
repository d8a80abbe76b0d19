"""The navigation example's manifests agree with each other, with the API's models, the trees and the example's world."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from navigation_stack.names import NODES
from navigation_world import generate

from tests.support.manifests import MODELS, assert_references_lead_somewhere, covers
from understudy.api import names
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.trees.languages.notations import load_monitoring
from understudy.trees.languages.short.procedure_loader import load_check, load_procedure

EXAMPLE = Path(__file__).parents[3] / "examples" / "navigation"
FOLDERS = ("manifests", "nav2", "on-board")
FILES = sorted(file for folder in FOLDERS for file in (EXAMPLE / folder).rglob("*.yaml"))
STRATEGIES = ["executing", "localization-running", "pod-started", "restart", "stack-started"]


def load(file: Path) -> list[dict[str, Any]]:
    return list(yaml.safe_load_all(file.read_text()))


ALL = [(file, manifest) for file in FILES for manifest in load(file)]


def of_kind(kind: str, folder: str = "") -> list[dict[str, Any]]:
    return [m for file, m in ALL if m["kind"] == kind and (not folder or folder in file.parts)]


def procedures(manifest: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    spec = manifest["spec"]
    for name in ("bringUp", "initialization"):
        if name in spec:
            yield f"spec.{name}.yaml", spec[name]["yaml"]
    for number, strategy in enumerate(spec.get("strategies", [])):
        if "recovery" in strategy:
            yield f"spec.strategies[{number}].recovery.yaml", strategy["recovery"]["yaml"]


def leaves(tree: Any, kind: str) -> Iterator[Any]:
    if isinstance(tree, dict):
        for key, value in tree.items():
            if key == kind:
                yield value
            yield from leaves(value, kind)
    elif isinstance(tree, list):
        for value in tree:
            yield from leaves(value, kind)


def test_the_tests_cover_every_file() -> None:
    assert [str(f.relative_to(EXAMPLE)) for f in FILES] == [
        "manifests/client.yaml",
        "manifests/robot.yaml",
        *(f"manifests/strategies/{name}.yaml" for name in STRATEGIES),
        "manifests/workload.yaml",
        *(f"nav2/strategies/{name}.yaml" for name in STRATEGIES),
        "nav2/workload.yaml",
        "on-board/robot.yaml",
        "on-board/workload.yaml",
    ]


@pytest.mark.parametrize("manifest", [m for kind in MODELS for m in of_kind(kind)], ids=lambda m: m["metadata"]["name"])
def test_specs_conform_to_the_models(manifest: dict[str, Any]) -> None:
    spec = MODELS[manifest["kind"]].model_validate(manifest["spec"]).to_wire()
    # The models ignore unknown fields; whatever was written must come back.
    assert covers(spec, manifest["spec"])
    assert "namespace" not in manifest["metadata"]


@pytest.mark.parametrize("manifest", [m for kind in MODELS for m in of_kind(kind)], ids=lambda m: m["metadata"]["name"])
def test_trees_and_procedures_load(manifest: dict[str, Any]) -> None:
    for path, tree in procedures(manifest):
        load_procedure(tree, path=path)
    if "monitoring" in manifest["spec"]:
        load_monitoring(FailurePolicySpec.model_validate(manifest["spec"]).monitoring)
    if "readinessCheck" in manifest["spec"]:
        load_check(manifest["spec"]["readinessCheck"]["yaml"], path="spec.readinessCheck.yaml")


@pytest.mark.parametrize("folder", ["manifests", "nav2"])
def test_references_resolve(folder: str) -> None:
    (workload,) = of_kind("RobotWorkload", folder)
    assert_references_lead_somewhere(workload, of_kind("FailurePolicy", folder), of_kind("FallbackPool", folder))


@pytest.mark.parametrize("folder", ["manifests", "nav2"])
def test_every_policy_has_the_same_health_tree_and_keeps_the_same_state(folder: str) -> None:
    first, *others = of_kind("FailurePolicy", folder)
    assert len(others) == len(STRATEGIES) - 1
    for other in others:
        assert other["spec"]["monitoring"] == first["spec"]["monitoring"]
        assert other["spec"]["state"] == first["spec"]["state"]


def test_the_bring_up_publishes_the_start_pose_of_the_world() -> None:
    (workload,) = of_kind("RobotWorkload", "manifests")
    start = generate(7).start
    (start_pose,) = leaves(workload["spec"]["bringUp"], "publish")
    pose = start_pose["message"]["pose"]["pose"]
    assert (pose["position"]["x"], pose["position"]["y"]) == pytest.approx((start.x, start.y))
    assert 2 * math.atan2(pose["orientation"]["z"], pose["orientation"]["w"]) == pytest.approx(start.heading, abs=1e-4)
    seeds = {e["value"] for _, m in ALL for c in leaves(m, "env") for e in c if e["name"] == "NAVIGATION_SEED"}
    assert seeds == {"7"}


def test_only_the_bring_up_of_the_first_instance_publishes_the_start_pose() -> None:
    for _, manifest in ALL:
        for path, tree in procedures(manifest):
            assert bool(list(leaves(tree, "publish"))) == (path == "spec.bringUp.yaml")
            if path != "spec.bringUp.yaml" and "stack-started" not in manifest["metadata"]["name"]:
                assert list(leaves(tree, "restore_state"))


def test_managed_nodes_are_nodes_of_the_stack() -> None:
    for kind in MODELS:
        for manifest in of_kind(kind, "manifests"):
            for leaf in ("set_lifecycle", "lifecycle_is"):
                assert {f["node"] for f in leaves(manifest["spec"], leaf)} <= {f"/{node}" for node in NODES}


@pytest.mark.parametrize("file", ["robot.yaml", "client.yaml"])
def test_configuration_comes_from_the_operator(file: str) -> None:
    (workload,) = {m["metadata"]["name"] for m in of_kind("RobotWorkload", "manifests")}
    written = {names.robot_env(workload), names.robot_profiles(workload)}
    text = "\n".join(line.split("#")[0] for line in (EXAMPLE / "manifests" / file).read_text().splitlines())
    used = {word.strip("{},") for word in text.split() if word.startswith(f"{workload}-")}
    assert used
    assert used <= written


def test_commands_use_modules_of_the_image() -> None:
    for kind in ("Deployment", "RobotWorkload", "Job"):
        for manifest in of_kind(kind, "manifests"):
            (container,) = manifest["spec"]["template"]["spec"]["containers"]
            assert container["command"][:2] == ["python3", "-m"]
            assert (EXAMPLE / "src" / container["command"][2] / "__main__.py").is_file()
            assert container["imagePullPolicy"] == "IfNotPresent"


def test_the_nav2_workload_differs_only_in_its_image_and_its_nodes() -> None:
    (ours,), (nav2,) = of_kind("RobotWorkload", "manifests"), of_kind("RobotWorkload", "nav2")
    assert nav2["metadata"] == ours["metadata"]
    for field in ("outputs", "tasks", "monitor"):
        assert nav2["spec"][field] == ours["spec"][field]
    nodes = [{f["node"] for f in leaves(w["spec"]["bringUp"], "set_lifecycle")} for w in (ours, nav2)]
    assert nodes[0] < nodes[1]
    kept = [p["spec"]["state"]["keep"] for p in of_kind("FailurePolicy")]
    assert all([{**topic, "maxAge": ""} for topic in k] == [{**topic, "maxAge": ""} for topic in kept[0]] for k in kept)


def test_the_workload_with_an_instance_on_board_differs_only_in_its_gate_and_its_discovery() -> None:
    (ours,), (other,) = of_kind("RobotWorkload", "manifests"), of_kind("RobotWorkload", "on-board")
    assert other["metadata"] == ours["metadata"]
    assert {**other["spec"], "gate": None, "ros": None} == {**ours["spec"], "gate": None, "ros": None}
    (service,) = of_kind("Service", "on-board")
    assert other["spec"]["ros"]["discovery"]["server"].startswith(service["metadata"]["name"] + ":")


def test_the_robot_with_an_instance_on_board_uses_what_the_operator_writes_and_modules_of_the_image() -> None:
    (robot,), (workload,) = of_kind("Deployment", "on-board"), of_kind("RobotWorkload", "on-board")
    name = workload["metadata"]["name"]
    used = {one["name"] for one in leaves(robot, "configMapRef")} | {one["name"] for one in leaves(robot, "configMap")}
    assert used == {names.robot_env(name), names.mux(name), names.on_board(name), names.instance_profiles(name)}
    modules = [
        c["command"][2] for c in leaves(robot, "containers") for c in c if c.get("command", [""])[0] == "python3"
    ]
    assert modules == ["navigation_robot", "navigation_robot.standstill"]
    assert (EXAMPLE / "src" / "navigation_robot" / "standstill.py").is_file()


def test_no_key_is_a_yaml_boolean_by_accident() -> None:
    """kubectl reads YAML 1.1, in which y and n are true and false; Python's loader takes them for names."""
    for file in FILES:
        assert not re.search(r"[{,\n]\s*[yn]:", file.read_text()), file

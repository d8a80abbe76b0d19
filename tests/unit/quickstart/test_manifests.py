"""The quickstart's manifests agree with each other, with the API's models and with the operator's names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.manifests import MODELS, covers
from understudy.api import names

QUICKSTART = Path(__file__).parents[3] / "examples" / "quickstart"
MANIFESTS = QUICKSTART / "manifests"
FILES = sorted(MANIFESTS.rglob("*.yaml"))


def load(file: str | Path) -> list[dict[str, Any]]:
    return list(yaml.safe_load_all((MANIFESTS / file).read_text()))


def of_kind(kind: str) -> list[dict[str, Any]]:
    return [m for file in FILES for m in load(file) if m["kind"] == kind]


def test_the_tests_cover_every_file() -> None:
    assert [str(f.relative_to(MANIFESTS)) for f in FILES] == [
        "managed/robotworkload.yaml",
        "mux/host-network/robotworkload.yaml",
        "mux/on-board/robot.yaml",
        "mux/on-board/robotworkload.yaml",
        "mux/robot.yaml",
        "mux/robotworkload.yaml",
        "robot.yaml",
        "robotworkload.yaml",
        "strategies/executing.yaml",
        "strategies/initialized.yaml",
        "strategies/restart.yaml",
        "strategies/uninitialized.yaml",
        "workload-ref/deployment.yaml",
        "workload-ref/robotworkload.yaml",
    ]


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.name)
def test_manifests_can_be_applied_in_any_namespace(file: Path) -> None:
    assert all("namespace" not in m["metadata"] for m in load(file))


@pytest.mark.parametrize("manifest", [m for kind in MODELS for m in of_kind(kind)], ids=lambda m: m["metadata"]["name"])
def test_specs_conform_to_the_models(manifest: dict[str, Any]) -> None:
    spec = MODELS[manifest["kind"]].model_validate(manifest["spec"]).to_wire()
    # The models ignore unknown fields; whatever was written must come back.
    assert covers(spec, manifest["spec"])


def test_references_resolve() -> None:
    policies = {m["metadata"]["name"]: m["spec"] for m in of_kind("FailurePolicy")}
    pools = {m["metadata"]["name"]: m["spec"] for m in of_kind("FallbackPool")}
    workloads = of_kind("RobotWorkload")
    assert {w["spec"]["failurePolicyRef"]["name"] for w in workloads} <= set(policies)
    assert {s["poolRef"]["name"] for p in policies.values() for s in p["strategies"] if "poolRef" in s} == set(pools)
    for pool in pools.values():
        wanted = pool["workloadSelector"]["matchLabels"]
        assert all(wanted.items() <= w["metadata"]["labels"].items() for w in workloads)
        if "templateFrom" in pool:
            assert pool["templateFrom"]["workload"] in {
                w["metadata"]["name"] for w in workloads if "template" in w["spec"]
            }


@pytest.mark.parametrize("file", ["robot.yaml", "workload-ref/deployment.yaml"])
def test_configuration_comes_from_the_operator(file: str) -> None:
    (workload,) = {w["metadata"]["name"] for w in of_kind("RobotWorkload")}
    text = (MANIFESTS / file).read_text()
    written = {names.robot_env(workload), names.robot_profiles(workload)}
    used = {word.strip("{},") for word in text.split() if word.startswith(f"{workload}-")}
    assert used
    assert used <= written


def test_the_robot_mounts_its_profiles_at_the_expected_path() -> None:
    pod = load("robot.yaml")[0]["spec"]["template"]["spec"]
    mounts = {m["name"]: m["mountPath"] for m in pod["containers"][0]["volumeMounts"]}
    assert mounts["profiles"] == "/etc/understudy"


def test_the_instance_on_board_has_what_understudy_writes_for_it_where_it_looks_for_it() -> None:
    pod = load("mux/on-board/robot.yaml")[0]["spec"]["template"]["spec"]
    (there,) = (container for container in pod["containers"] if container["name"] == "on-board")
    (workload,) = {w["metadata"]["name"] for w in load("mux/on-board/robotworkload.yaml")}
    maps = {one["configMapRef"]["name"] for one in there["envFrom"]}
    assert maps == {names.robot_env(workload), names.on_board(workload)}
    mounts = {mount["mountPath"]: mount["name"] for mount in there["volumeMounts"]}
    volumes = {volume["name"]: volume for volume in pod["volumes"]}
    assert volumes[mounts["/etc/understudy"]]["configMap"]["name"] == names.instance_profiles(workload)


@pytest.mark.parametrize("folder", ["mux", "mux/on-board"])
def test_the_mux_of_a_robot_has_what_understudy_writes_for_it_where_it_looks_for_it(folder: str) -> None:
    pod = load(f"{folder}/robot.yaml")[0]["spec"]["template"]["spec"]
    (mux,) = (container for container in pod["containers"] if container["name"] == "mux")
    (workload,) = {w["metadata"]["name"] for w in load(f"{folder}/robotworkload.yaml")}
    maps = {one["configMapRef"]["name"] for one in mux["envFrom"]}
    assert (mux["args"], maps) == (["mux"], {names.robot_env(workload), names.mux(workload)})
    mounts = {mount["mountPath"]: mount["name"] for mount in mux["volumeMounts"]}
    volumes = {volume["name"]: volume for volume in pod["volumes"]}
    folder = names.MUX_TOKEN_FILE.rpartition("/")[0]
    assert volumes[mounts[folder]]["secret"]["secretName"] == names.mux(workload)
    assert names.STATE_DIR in mounts


@pytest.mark.parametrize("kind", ["Deployment", "RobotWorkload"])
def test_commands_use_modules_of_the_image(kind: str) -> None:
    for manifest in of_kind(kind):
        template = manifest["spec"].get("template")
        if template is None:
            continue
        container = template["spec"]["containers"][0]
        assert container["command"][:2] == ["python3", "-m"]
        module = container["command"][2].replace(".", "/")
        assert (QUICKSTART / "src" / f"{module}.py").is_file()
        assert container["imagePullPolicy"] == "IfNotPresent"

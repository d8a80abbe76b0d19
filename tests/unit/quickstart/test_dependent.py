"""The manifests of examples/dependent agree with each other and with what the operator writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from understudy.api import names
from understudy.cli.check.command import check
from understudy.controller.observed import dependency_graph
from understudy.controller.observed.dependency_graph import upstream

EXAMPLES = Path(__file__).parents[3] / "examples"
FILES = sorted((EXAMPLES / "dependent" / "manifests").glob("*.yaml"))
ITEMS: list[dict[str, Any]] = [item for file in FILES for item in yaml.safe_load_all(file.read_text())]
WORKLOADS = {item["metadata"]["name"]: item for item in ITEMS if item["kind"] == "RobotWorkload"}
CHAIN = ["robot-1-localization", "robot-1-planning", "robot-1-control"]


def test_the_manifests_pass_the_check_without_findings() -> None:
    assert check([(file.name, file.read_bytes()) for file in FILES]).findings == []


def test_each_workload_depends_on_the_one_before_it() -> None:
    known = dependency_graph.graph(WORKLOADS.values())
    assert [one.name for one in upstream(known, CHAIN[-1])] == CHAIN[:-1]


def containers() -> list[dict[str, Any]]:
    return [one for item in ITEMS for one in (item["spec"].get("template") or {}).get("spec", {}).get("containers", [])]


def test_commands_use_modules_of_the_quickstart_image() -> None:
    for container in containers():
        module = container["command"][2].replace(".", "/")
        assert (EXAMPLES / "quickstart" / "src" / f"{module}.py").is_file()


def test_every_reader_of_an_output_uses_its_gated_port() -> None:
    read = {"robot-1-planning": CHAIN[0], "robot-1-control": CHAIN[1], "robot-1": CHAIN[2]}
    for name, source in read.items():
        (item,) = (one for one in ITEMS if one["metadata"]["name"] == name)
        pod = item["spec"]["template"]["spec"]
        assert [v["configMap"]["name"] for v in pod["volumes"] if "configMap" in v] == [names.robot_profiles(source)]
        (container,) = pod["containers"]
        (mount,) = (m["mountPath"] for m in container["volumeMounts"] if m.get("readOnly"))
        variables = {entry["name"]: entry.get("value") for entry in container["env"]}
        assert (
            variables.get("FASTRTPS_DEFAULT_PROFILES_FILE", "/etc/understudy/profiles.xml") == f"{mount}/profiles.xml"
        )


def test_all_workloads_use_the_discovery_server_of_the_first_one() -> None:
    server = f"{names.discovery(CHAIN[0])}:{names.DISCOVERY_PORT}"
    for name in CHAIN[1:]:
        assert WORKLOADS[name]["spec"]["ros"]["discovery"] == {"mode": "External", "server": server}
    key = {"name": names.robot_env(CHAIN[0]), "key": "ROS_DISCOVERY_SERVER"}
    named = [
        entry["valueFrom"]["configMapKeyRef"]
        for container in containers()
        for entry in container.get("env", [])
        if entry["name"] == "ROS_DISCOVERY_SERVER"
    ]
    assert named == [key, key, key]

"""``understudy init``: what it writes passes ``understudy check``, and what it cannot know it asks for."""

from __future__ import annotations

import itertools
import re
import shlex
import threading
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.bag_recording import every, write
from tests.support.fake_kubectl import FakeKubectl
from tests.unit.dds import isolate_discovery
from understudy.cli.check.command import main as check
from understudy.cli.init.command import main
from understudy.cli.init.observed_topics import in_graph

TWIST, SCAN, STRING = "geometry_msgs/msg/Twist", "sensor_msgs/msg/LaserScan", "std_msgs/msg/String"
OUTPUT = ["--output", f"/cmd_vel={TWIST}"]


def deployment(name: str, *, replicas: int = 1, env: dict[str, str] | None = None, **pod: Any) -> dict[str, Any]:
    variables = [{"name": key, "value": value} for key, value in (env or {}).items()]
    container = {"name": f"{name}-container", "image": "registry.example/it:1", "command": ["/run"], "env": variables}
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": name},
        "spec": {
            "replicas": replicas,
            "selector": {"matchLabels": {"app": name}},
            "template": {"metadata": {"labels": {"app": name}}, "spec": {"containers": [container], **pod}},
        },
    }


@pytest.fixture
def manifests(tmp_path: Path) -> Path:
    """The files of somebody who has an application and a robot."""
    return saved(tmp_path, deployment("tug", env={"ROS_DOMAIN_ID": "7"}), deployment("base"))


def saved(folder: Path, *items: dict[str, Any]) -> Path:
    file = folder / "own.yaml"
    file.write_text(yaml.safe_dump_all(items))
    return file


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A minute of driving."""
    topics = [every("/cmd_vel", TWIST, 0, 60, 20), every("/scan", SCAN, 0, 60, 10), every("/chatter", STRING, 0, 60, 1)]
    return write(tmp_path / "drive", sorted(itertools.chain(*topics), key=lambda one: one.at))


def written(folder: Path) -> dict[str, dict[str, Any]]:
    """The spec of each object, by its kind."""
    items = yaml.safe_load_all((folder / "understudy.yaml").read_text())
    return {item["kind"]: item["spec"] for item in items}


@pytest.mark.parametrize("gate", ["NetworkPolicy", "Mux"])
@pytest.mark.parametrize("readiness", ["Executing", "Uninitialized"])
@pytest.mark.parametrize("robot", [[], ["--robot", "deployment/base"]], ids=["unknown-robot", "robot"])
def test_what_is_written_passes_the_check(
    manifests: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], gate: str, readiness: str, robot: list[str]
) -> None:
    folder = tmp_path / "robot-17"
    arguments = ["deployment/tug", "-f", str(manifests), *OUTPUT, *robot, "--gate", gate, "--readiness", readiness]
    assert main([*arguments, "-n", "fleet", "--write", str(folder)]) == 0
    capsys.readouterr()
    passed = check(["--strict", "-R", str(folder)]) == 0
    replace = {"metadata.name: ROBOT", "].name: CONTAINER"} if not robot else set()
    replace |= {"].image: IMAGE"} if gate == "Mux" else set()
    findings = capsys.readouterr().out
    assert passed == (not replace), findings
    assert all(f"{words} is a placeholder: replace it by" in findings for words in replace)
    assert findings.count("\n") == len(replace), "nothing else"
    found = written(folder)
    assert found["FallbackPool"]["readiness"] == readiness
    assert ("template" in found["RobotWorkload"]) == (gate == "Mux"), "a mux needs pods that Understudy creates"
    assert found["RobotWorkload"]["ros"] == {"domainId": 7}


def test_the_bounds_come_from_the_recording(manifests: Path, bag: Path, tmp_path: Path) -> None:
    folder = tmp_path / "robot-17"
    arguments = ["deployment/tug", "-f", str(manifests), "--bag", str(bag), "--watch", "/scan"]
    assert main([*arguments, "--write", str(folder)]) == 0
    found = written(folder)
    assert found["RobotWorkload"]["outputs"] == [{"topic": "/cmd_vel", "type": TWIST}], "what looks like commands"
    command, scan = (leaf["topic"] for leaf in found["FailurePolicy"]["monitoring"]["yaml"]["parallel"])
    assert (command["name"], command["gap"], scan["name"], scan["gap"]) == ("/cmd_vel", "100ms", "/scan", "200ms")
    assert f"# Bounds learned from {bag}, 60.0 s." in (folder / "understudy.yaml").read_text()


def test_patches_name_only_what_the_application_lacks(manifests: Path, tmp_path: Path) -> None:
    folder = tmp_path / "robot-17"
    arguments = ["deploy/tug", "--robot", "deploy/base", "-f", str(manifests), *OUTPUT, "--write", str(folder)]
    assert main(arguments) == 0
    application, robot = (
        yaml.safe_load((folder / "patches" / f"{name}.yaml").read_text())["spec"]["template"]["spec"]
        for name in ("application", "robot")
    )
    (container,) = application["containers"]
    assert container["name"] == "tug-container"
    assert [one["name"] for one in container["env"]] == [
        "RMW_IMPLEMENTATION",
        "FASTDDS_BUILTIN_TRANSPORTS",
        "ROS_DISCOVERY_SERVER",
    ], "its domain is its own"
    assert robot["containers"][0]["envFrom"] == [{"configMapRef": {"name": "tug-robot-env"}}]
    assert robot["volumes"] == [{"name": "understudy", "configMap": {"name": "tug-robot-profiles"}}]


def test_the_next_commands_are_few_and_complete(
    manifests: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "robot-17"
    arguments = ["deploy/tug", "--robot", "deploy/base", "-f", str(manifests), *OUTPUT, "-n", "fleet"]
    assert main([*arguments, "--write", str(folder)]) == 0
    steps = [shlex.split(line) for line in capsys.readouterr().err.splitlines()[1:]]
    assert [words[:2] for words in steps] == [
        ["understudy", "check"],
        ["kubectl", "apply"],
        ["kubectl", "patch"],
        ["kubectl", "patch"],
        ["kubectl", "wait"],
    ]
    files = [Path(word) for words in steps for word in words if word.startswith(str(folder))]
    assert all(file.exists() for file in files)


def test_the_application_can_be_in_the_cluster(stand: FakeKubectl, capsys: pytest.CaptureFixture[str]) -> None:
    stand.tell([deployment("tug", env={"ROS_DISCOVERY_SERVER": "10.0.0.7:11811"})])
    assert main(["deployment/tug", *OUTPUT]) == 0
    items = list(yaml.safe_load_all(capsys.readouterr().out))
    assert [item["kind"] for item in items] == ["RobotWorkload", "FailurePolicy", "FallbackPool"]
    assert items[0]["spec"]["ros"]["discovery"] == {"mode": "External", "server": "10.0.0.7:11811"}
    assert "get deployments.apps tug -o json" in stand.asked[-1]


@pytest.mark.parametrize(
    ("item", "more", "words"),
    [
        (deployment("tug", replicas=2), [], "has 2 replicas, and one robot is driven by one pod: set replicas to 1"),
        (
            deployment("tug", env={"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}),
            [],
            "uses rmw_cyclonedds_cpp, and only Fast DDS",
        ),
        (deployment("tug", hostNetwork=True), ["--gate", "NetworkPolicy"], "use --gate Mux"),
        (deployment("tug"), ["--image", "registry.example/monitor:1"], "--image is that of a mux"),
        (deployment("other"), [], "deployment/tug is not in the given files, which have deployment/other"),
        (deployment("tug", env={"ROS_DOMAIN_ID": "2"}), [], "RobotWorkload tug: spec.ros.domainId: "),
    ],
)
def test_an_application_that_cannot_be_protected_is_refused_with_the_way_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], item: dict[str, Any], more: list[str], words: str
) -> None:
    assert main(["deployment/tug", "-f", str(saved(tmp_path, item)), *OUTPUT, *more]) == 2
    assert words in capsys.readouterr().err


def test_an_application_in_the_network_of_its_node_gets_a_mux(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = saved(tmp_path, deployment("tug", hostNetwork=True, dnsPolicy="ClusterFirstWithHostNet"))
    assert main(["deployment/tug", "-f", str(file), *OUTPUT]) == 0
    workload, *_ = yaml.safe_load_all(capsys.readouterr().out)
    assert workload["spec"]["gate"] == {"kind": "Mux"}
    assert workload["spec"]["template"]["spec"]["hostNetwork"] is True


def test_the_image_of_the_mux_can_be_given(manifests: Path, tmp_path: Path) -> None:
    folder, image = tmp_path / "robot-17", "registry.example/monitor:1"
    arguments = [
        "deploy/tug",
        "--robot",
        "deploy/base",
        "-f",
        str(manifests),
        *OUTPUT,
        "--gate",
        "Mux",
        "--image",
        image,
    ]
    assert main([*arguments, "--write", str(folder)]) == 0
    assert f" image: {image} " in (folder / "patches" / "robot.yaml").read_text()
    assert check(["--strict", "-R", str(folder)]) == 0


def test_outputs_that_cannot_be_known_are_asked_for(
    manifests: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["deployment/tug", "-f", str(manifests)]
    assert main(asked) == 2
    assert "name with --output each topic with which the application acts on the robot" in capsys.readouterr().err
    assert main([*asked, "--output", "/cmd_vel"]) == 2
    assert "output /cmd_vel has no type: give its type, such as /cmd_vel=" in capsys.readouterr().err
    chain = [*every("/cmd_vel", TWIST, 0, 5, 20), *every("/cmd_vel_nav", TWIST, 0, 5, 20)]
    both = write(tmp_path / "both", sorted(chain, key=lambda one: one.at))
    assert main([*asked, "--bag", str(both)]) == 2
    assert "/cmd_vel, /cmd_vel_nav look like commands: name with --output those" in capsys.readouterr().err
    quiet = write(tmp_path / "quiet", every("/chatter", STRING, 0, 5, 20))
    assert main([*asked, "--bag", str(quiet)]) == 2
    assert re.search(r"quiet, 5\.\d s has /chatter", capsys.readouterr().err)


def test_files_that_exist_are_kept(manifests: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "robot-17"
    (folder / "patches").mkdir(parents=True)
    (folder / "patches" / "robot.yaml").write_text("edited")
    assert main(["deployment/tug", "-f", str(manifests), *OUTPUT, "--write", str(folder)]) == 2
    assert "patches/robot.yaml exists already" in capsys.readouterr().err
    assert [path.name for path in folder.rglob("*.yaml")] == ["robot.yaml"], "nothing else was written"


@pytest.mark.ros
def test_a_live_graph_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rclpy")
    isolate_discovery(monkeypatch)
    from geometry_msgs.msg import Twist

    from understudy.ros.runtime.graph_node import Graph

    graph, ended = Graph("application"), threading.Event()
    publisher = graph.node.create_publisher(Twist, "/cmd_vel", 10)

    def publish() -> None:
        while not ended.wait(0.05):
            publisher.publish(Twist())

    publishing = threading.Thread(target=publish)
    publishing.start()
    try:
        observed = in_graph(3.0, lambda types: [name for name in types if name == "/cmd_vel"])
    finally:
        ended.set()
        publishing.join()
        graph.close()
    assert observed.types["/cmd_vel"] == TWIST
    assert len(observed.arrivals["/cmd_vel"]) >= 20

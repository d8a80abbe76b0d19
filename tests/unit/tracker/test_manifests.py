"""The example's manifests are what the tracker, the API's models and the health tree's loader take, and fit each other and the scene."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from testcluster.images import catalog
from understudy.api import names
from understudy.cli.check.command import check
from understudy.tracker import camera_calibration
from understudy.tracker.configuration import Configuration, load, read

MANIFESTS = Path(__file__).parents[3] / "examples/tracker/manifests"


def objects(file: str) -> list[dict[str, Any]]:
    return [item for item in yaml.safe_load_all((MANIFESTS / file).read_text()) if item]


def configuration() -> Configuration:
    (found,) = [item for item in objects("tracker.yaml") if item["kind"] == "ConfigMap"]
    return load(found["data"]["tracker.yaml"])


def containers() -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Each container with the spec of its pod."""
    specs = [
        item["spec"]["template"]["spec"]
        for file in MANIFESTS.glob("*.yaml")
        for item in objects(file.name)
        if "template" in item.get("spec", {})
    ]
    return [(container, spec) for spec in specs for container in spec["containers"]]


def test_the_manifests_use_the_images_of_this_repository():
    built = {image.name for image in catalog.images()}
    assert {container["image"] for container, _ in containers()} == {
        "localhost/understudy-tracker:dev",
        "localhost/understudy-tracker-example:dev",
    }
    assert {container["image"] for container, _ in containers()} <= built


def test_the_tracker_finds_a_valid_configuration_file():
    (item, deployment) = objects("tracker.yaml")
    (container,) = deployment["spec"]["template"]["spec"]["containers"]
    mounts = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
    (name,) = item["data"]
    assert container["args"] == [f"{mounts['configuration']}/{name}"]
    (marker,) = configuration().markers
    assert marker.base == "/tracker/robot"


def test_the_manifests_pass_the_check_without_findings():
    files = [MANIFESTS / name for name in ("policy.yaml", "workload.yaml")]
    assert check([(file.name, file.read_bytes()) for file in files]).findings == []
    policy, pool = objects("policy.yaml")
    (workload,) = objects("workload.yaml")
    assert workload["spec"]["failurePolicyRef"]["name"] == policy["metadata"]["name"]
    assert policy["spec"]["strategies"][0]["poolRef"]["name"] == pool["metadata"]["name"]
    assert pool["spec"]["workloadSelector"]["matchLabels"].items() <= workload["metadata"]["labels"].items()
    watched = {
        next(iter(leaf[kind].values())): leaf
        for leaf in policy["spec"]["monitoring"]["yaml"]["parallel"]
        for kind in ("topic", "motion")
        if kind in leaf
    }
    (marker,) = configuration().markers
    assert watched[f"{marker.base}/odometry"]["motion"]["commands"] in watched
    assert {output["topic"] for output in workload["spec"]["outputs"]} <= watched.keys()


@pytest.mark.parametrize("file", ["robot.yaml", "tracker.yaml"])
def test_pods_in_the_robot_graph_use_the_configuration_of_the_operator(file: str):
    (workload,) = objects("workload.yaml")
    name = workload["metadata"]["name"]
    spec = objects(file)[-1]["spec"]["template"]["spec"]
    (container,) = spec["containers"]
    assert container["envFrom"] == [{"configMapRef": {"name": names.robot_env(name)}}]
    assert {"name": "profiles", "configMap": {"name": names.robot_profiles(name)}} in spec["volumes"]


@pytest.mark.ros
@pytest.mark.usefixtures("rendering")
def test_the_tracker_has_the_pose_of_the_example_camera():
    from tracker_robot.robot import CALIBRATION, CAMERA, IMAGES, SIZE, START
    from tracker_scene import Pose, Scene

    from understudy.tracker.image_messages import Calibration
    from understudy.tracker.robot_location import Locator

    configured = configuration()
    assert (configured.camera.image, configured.camera.calibration) == (IMAGES, CALIBRATION)
    locator = Locator(configured)
    locator.calibrate(Calibration(np.array(Scene.matrix(SIZE)).reshape(3, 3), np.zeros(5), False, *SIZE))
    scene, random = Scene(START, CAMERA, seed=3, size=SIZE), np.random.default_rng(3)
    missed = 0
    try:
        for index in range(30):
            scene.put(Pose(random.uniform(-0.9, 0.9), random.uniform(-0.7, 0.7), random.uniform(-math.pi, math.pi)))
            found = locator.see(cv2.cvtColor(scene.image(), cv2.COLOR_RGB2GRAY), float(index))
            if not found:
                missed += 1
                continue
            placed, true = found[0].placed, scene.pose
            assert math.hypot(placed.x - true.x, placed.y - true.y) < 0.02
            assert abs(math.remainder(placed.heading - true.heading, math.tau)) < math.radians(5)
    finally:
        scene.close()
    assert missed <= 2


def test_the_tracker_with_a_local_camera_finds_its_files(tmp_path: Path):
    (item, deployment) = objects("device.yaml")
    for name, text in item["data"].items():
        (tmp_path / name).write_text(text)
    found = read(tmp_path / "tracker.yaml")
    device = found.camera.device
    assert device is not None
    assert camera_calibration.read(Path(device.calibration)).width == 640
    spec = deployment["spec"]["template"]["spec"]
    (container,) = spec["containers"]
    (mounted,) = [mount for mount in container["volumeMounts"] if mount["name"] == "camera"]
    (volume,) = [volume for volume in spec["volumes"] if volume["name"] == "camera"]
    assert mounted["mountPath"] == device.path
    assert volume["hostPath"]["type"] == "CharDevice"
    (plain,) = [item for item in objects("tracker.yaml") if item["kind"] == "Deployment"]
    assert container["args"] == plain["spec"]["template"]["spec"]["containers"][0]["args"]

"""Nav2's image starts Nav2 with its own parameters but for those of the robot."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any

import pytest
import yaml

from testcluster.images import catalog, engines
from testcluster.paths import REPOSITORY

FOLDER = REPOSITORY / "examples" / "navigation" / "nav2" / "image"


@pytest.fixture
def archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    archive = tmp_path / "nav2-1.tar.zst"
    archive.write_bytes(b"archive")
    monkeypatch.setenv(catalog.NAV2_ARCHIVE, str(archive))
    return archive


def nav2() -> catalog.Image | None:
    return next((image for image in catalog.images() if image.short == "nav2"), None)


def test_the_image_is_built_only_of_an_archive_that_somebody_names(
    archive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = nav2()
    assert image
    assert (image.parent, image.file.name) == ("localhost/understudy-monitor:dev", "archive.Dockerfile")
    monkeypatch.delenv(catalog.NAV2_ARCHIVE)
    assert nav2() is None


def test_an_archive_that_is_not_there_is_named_with_its_variable(archive: Path) -> None:
    archive.unlink()
    with pytest.raises(ValueError, match=r"UNDERSTUDY_NAV2_ARCHIVE=.*nav2-1.tar.zst: there is no such file"):
        nav2()


def test_another_archive_builds_the_image_again(archive: Path) -> None:
    image = nav2()
    assert image
    before = image.fingerprint()
    archive.write_bytes(b"newer")
    assert image.fingerprint() != before


def test_the_build_gets_the_archive_by_its_folder_and_its_name(archive: Path) -> None:
    image = nav2()
    assert image
    assert engines.archive_options(image) == [
        "--build-context", f"archive={archive.parent}", "--build-arg", "ARCHIVE=nav2-1.tar.zst",
    ]  # fmt: skip
    (operator,) = (image for image in catalog.images() if image.short == "operator")
    assert engines.archive_options(operator) == []


def test_both_images_have_the_same_start(archive: Path) -> None:
    copied = [
        re.findall(r"^COPY (?!--from)(.+)", (FOLDER / name).read_text(), re.MULTILINE)
        for name in ("Dockerfile", "archive.Dockerfile")
    ]
    assert copied[0] == copied[1]
    assert all((FOLDER / name).exists() for name in copied[0][0].split()[:-1])


def test_a_plugin_is_replaced_as_a_whole_and_other_parameters_one_by_one() -> None:
    merged: Any = runpy.run_path(str(FOLDER / "start-nav2"))["merged"]
    nav2 = {
        "controller_server": {"frequency": 20.0, "FollowPath": {"plugin": "mppi", "time_steps": 56}},
        "amcl": {"alpha1": 0.2},
    }
    ours = {"controller_server": {"FollowPath": {"plugin": "pursuit", "lookahead_dist": 0.6}, "tolerance": 0.3}}
    assert merged(nav2, ours) == {
        "controller_server": {
            "frequency": 20.0,
            "tolerance": 0.3,
            "FollowPath": {"plugin": "pursuit", "lookahead_dist": 0.6},
        },
        "amcl": {"alpha1": 0.2},
    }


def test_the_parameters_are_those_of_nodes_that_the_workload_brings_up() -> None:
    (workload,) = yaml.safe_load_all((FOLDER.parent / "workload.yaml").read_text())
    up = set(re.findall(r"'node': '/(\w+)'", str(workload["spec"]["bringUp"])))
    ours = set(yaml.safe_load((FOLDER / "params.yml").read_text()))
    assert ours - {"local_costmap", "global_costmap"} <= up

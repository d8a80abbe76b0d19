"""What the example's image is made of agrees with what it is tested with."""

from __future__ import annotations

import re

import mujoco

from testcluster.images import catalog
from testcluster.paths import REPOSITORY

EXAMPLE = REPOSITORY / "examples" / "tracker"


def image(short: str) -> catalog.Image:
    return next(image for image in catalog.images() if image.short == short)


def test_the_image_has_the_same_versions_as_the_tests() -> None:
    wanted = re.findall(r"^[a-z].*?==[^ ]+", (EXAMPLE / "requirements.txt").read_text(), re.MULTILINE)
    assert f"mujoco-core=={mujoco.__version__}" in wanted


def test_the_image_of_the_tracker_is_a_stage_of_ours_and_caches_slow_steps() -> None:
    own = image("tracker")
    assert (own.target, own.context, own.parent) == ("tracker", REPOSITORY, None)
    assert own.stages == ("tools", "tracker-dependencies")
    dockerfile = (REPOSITORY / "Dockerfile").read_text()
    assert all(f" AS {stage}\n" in dockerfile for stage in ("tracker", *own.stages))


def test_the_image_of_the_example_is_built_on_that_of_the_tracker() -> None:
    example = image("tracker-example")
    assert example.context == EXAMPLE
    assert example.parent == image("tracker").name


def test_the_image_uses_the_same_renderer_as_the_tests() -> None:
    (installed,) = [
        line.split("debian_packages ")[1]
        for line in (REPOSITORY / "scripts" / "lib.sh").read_text().splitlines()
        if "debian_packages libegl1" in line
    ]
    assert f"--no-install-recommends {' '.join(sorted(installed.split()))} " in (EXAMPLE / "Dockerfile").read_text()


def test_copied_files_are_in_the_build_context() -> None:
    sent = {line[1:] for line in (EXAMPLE / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = {line.split()[1] for line in (EXAMPLE / "Dockerfile").read_text().splitlines() if line.startswith("COPY")}
    assert copied == sent
    assert all((EXAMPLE / name).exists() for name in sent)

"""What the example's image is made of agrees with what it is tested with."""

from __future__ import annotations

import re

import mujoco

from testcluster.images import catalog
from testcluster.paths import REPOSITORY

EXAMPLE = REPOSITORY / "examples" / "navigation"


def test_the_image_has_the_same_versions_as_the_tests() -> None:
    wanted = re.findall(r"^[a-z].*?==[^ ]+", (EXAMPLE / "requirements.txt").read_text(), re.MULTILINE)
    assert f"mujoco-core=={mujoco.__version__}" in wanted


def test_the_image_is_built_on_that_of_the_monitor_and_caches_slow_steps() -> None:
    image = next(image for image in catalog.images() if image.short == "navigation")
    assert image.parent == "localhost/understudy-monitor:dev"
    assert image.stages == ("interfaces",)


def test_copied_files_are_in_the_build_context() -> None:
    sent = {line[1:] for line in (EXAMPLE / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = {
        line.split()[1]
        for line in (EXAMPLE / "Dockerfile").read_text().splitlines()
        if line.startswith("COPY") and "--from" not in line
    }
    assert copied == sent
    assert all((EXAMPLE / name).exists() for name in sent)

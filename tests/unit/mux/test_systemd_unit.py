"""The systemd unit of a mux outside of the cluster has the names that the product has."""

from __future__ import annotations

import shutil
import subprocess
from collections import defaultdict
from pathlib import Path

import pytest

from understudy.api import names
from understudy.cli.control.mux_files import MUX_FILE, TOKEN_FILE, UNIT
from understudy.cli.control.profile_files import ENV_FILE
from understudy.controller.pods.ros_environment import PROFILES_DIR
from understudy.main import VERBS

FILE = Path(__file__).parents[3] / "examples/quickstart/manifests/mux" / f"{UNIT}.service"
FOLDER = f"{PROFILES_DIR}/%i"


@pytest.fixture
def settings() -> dict[str, list[str]]:
    """The values of each setting."""
    found: dict[str, list[str]] = defaultdict(list)
    for line in FILE.read_text().splitlines():
        if line and not line.startswith(("#", "[")):
            key, _, value = line.partition("=")
            found[key].append(value)
    return found


def test_it_runs_the_mux_with_the_files_of_robot_profile(settings: dict[str, list[str]]) -> None:
    (command,) = settings["ExecStart"]
    program, verb = command.split()
    assert (Path(program).name, verb in {one.name for one in VERBS}, verb) == ("understudy", True, "mux")
    assert settings["EnvironmentFile"] == [f"{FOLDER}/{ENV_FILE}", f"{FOLDER}/{MUX_FILE}"]
    assert settings["LoadCredential"] == [f"{TOKEN_FILE}:{FOLDER}/{TOKEN_FILE}"]


def test_it_keeps_its_state_in_a_folder_of_its_workload(settings: dict[str, list[str]]) -> None:
    variables = dict(value.split("=", 1) for value in settings["Environment"])
    assert variables == {
        names.MUX_TOKEN_VARIABLE: f"%d/{TOKEN_FILE}",
        names.MUX_STATE_VARIABLE: f"{names.STATE_DIR}/%i",
    }
    assert [f"/var/lib/{folder}" for folder in settings["StateDirectory"]] == [names.STATE_DIR]
    assert f"# Environment={names.ADDRESS_VARIABLE}=" in FILE.read_text()


def test_it_is_started_again_however_often_it_fails(settings: dict[str, list[str]]) -> None:
    assert (settings["Restart"], settings["StartLimitIntervalSec"]) == (["always"], ["0"])


def test_systemd_accepts_it(tmp_path: Path) -> None:
    if (analyze := shutil.which("systemd-analyze")) is None:
        pytest.skip("no systemd here")
    unit = tmp_path / f"{UNIT}robot-17.service"
    unit.write_text(FILE.read_text().replace("/opt/understudy/bin/understudy mux", "/bin/true mux"))
    done = subprocess.run([analyze, "verify", "--man=no", str(unit)], capture_output=True, text=True, check=False)
    about_it = [line for line in done.stderr.splitlines() if UNIT in line]
    assert (done.returncode, about_it) == (0, [])

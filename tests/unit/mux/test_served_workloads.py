"""Which workloads a mux serves, by its environment and its files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from understudy.api import names
from understudy.mux.served_workloads import served_workloads

TYPE = "std_msgs/msg/String"


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    """The folders of two workloads, as Kubernetes mounts them."""
    for workload in ("v", "w"):
        folder = tmp_path / "served" / workload
        (folder / "..data").mkdir(parents=True)
        for name, text in {
            names.NAMESPACE_VARIABLE: "fleet",
            names.WORKLOAD_VARIABLE: workload,
            names.OUTPUTS_VARIABLE: json.dumps([{"topic": f"/{workload}", "type": TYPE}]),
            names.TOKEN: f"of {workload}",
        }.items():
            (folder / name).write_text(text)
    return tmp_path / "served"


def test_each_folder_is_of_one_workload(folders: Path, tmp_path: Path) -> None:
    (folders / "w" / names.ALLOWED_NODES_VARIABLE).write_text('["/joy_teleop"]')
    (folders / "..data").mkdir()
    one, other = served_workloads({names.MUX_FOLDER_VARIABLE: str(folders)}, tmp_path)
    assert (one.namespace, one.name, one.token, one.allowed) == ("fleet", "v", b"of v", [])
    assert (other.name, other.outputs[0].topic, other.allowed) == ("w", "/w", ["/joy_teleop"])
    assert one.control != other.control


def test_folders_that_lack_something_are_refused_with_the_reason(folders: Path, tmp_path: Path) -> None:
    environment = {names.MUX_FOLDER_VARIABLE: str(folders)}
    (folders / "w" / names.TOKEN).unlink()
    with pytest.raises(ValueError, match="w has no file token"):
        served_workloads(environment, tmp_path)
    (folders / "w" / names.TOKEN).write_bytes(b"\xff")
    (folders / "w" / names.WORKLOAD_VARIABLE).write_text("v")
    with pytest.raises(ValueError, match="two folders are of the same workload"):
        served_workloads(environment, tmp_path)
    with pytest.raises(ValueError, match="there is no folder of a workload"):
        served_workloads({names.MUX_FOLDER_VARIABLE: str(folders / "v")}, tmp_path)

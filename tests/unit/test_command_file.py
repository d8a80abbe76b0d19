"""The command as one file: it needs only Python, starts from the user's cache, and fits the manifest for krew."""

from __future__ import annotations

import hashlib
import io
import json
import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
import yaml

from scripts import command_file
from scripts.command_file import EXTRAS, PLATFORMS, PYTHONS, Platform, Refused
from testcluster.paths import REPOSITORY
from understudy import __version__

MANIFESTS = REPOSITORY / "examples" / "quickstart" / "manifests"

IMPORTED = """
import runpy, sys
sys.argv[:] = [{file!r}, *{arguments!r}]
try:
    runpy.run_path({file!r}, run_name="__main__")
except SystemExit:
    pass
import json
print(json.dumps({{name: getattr(module, "__file__", None) or "" for name, module in sys.modules.items()}}), file=sys.stderr)
"""
"""Runs the file, and prints where each module came from."""


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file for this machine and this Python."""
    folder = tmp_path_factory.mktemp("command")
    plain, compiled = command_file.installed_packages()
    return command_file.write(folder, command_file.here(), {**plain, **compiled, **command_file.own_package()})


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The user's cache, which the tests share: only the first start unpacks."""
    return tmp_path_factory.mktemp("cache")


def run(*command: str | Path, cache: Path, **further: str) -> subprocess.CompletedProcess[str]:
    """Run a command in an environment that knows nothing of this repository. Its Python has no packages."""
    environment = {"PATH": os.environ["PATH"], "HOME": str(cache), "XDG_CACHE_HOME": str(cache), **further}
    base = Path(sys.base_prefix) / "bin" / f"python{sys.version_info[0]}.{sys.version_info[1]}"
    return subprocess.run([base, "-s", *command], env=environment, capture_output=True, text=True, timeout=120)


def packages(file: Path) -> zipfile.ZipFile:
    """The packages in a file."""
    with zipfile.ZipFile(file) as outer:
        return zipfile.ZipFile(io.BytesIO(outer.read("packages.zip")))


def test_the_file_starts_and_knows_its_version(built: Path, cache: Path) -> None:
    done = run(built, "version", cache=cache)
    assert (done.returncode, done.stdout) == (0, f"understudy {__version__}\n"), done.stderr


def test_the_help_lists_the_verbs(built: Path, cache: Path) -> None:
    done = run(built, "--help", cache=cache)
    assert done.returncode == 0, done.stderr
    assert "  check " in done.stdout


def test_manifests_are_checked(built: Path, cache: Path) -> None:
    done = run(built, "check", MANIFESTS, cache=cache)
    assert done.returncode == 0, done.stderr
    assert "0 errors" in done.stdout + done.stderr


def test_trees_in_openscenario_are_read(built: Path, cache: Path) -> None:
    (policy, *_) = sorted(
        file
        for file in (REPOSITORY / "examples").rglob("*.yaml")
        if "osc:" in file.read_text() and "kind: FailurePolicy" in file.read_text()
    )
    done = run(built, "check", policy, cache=cache)
    assert "scenario-execution" not in done.stdout + done.stderr
    assert "0 errors" in done.stdout + done.stderr


def test_a_shell_completes_verbs(built: Path, cache: Path, tmp_path: Path) -> None:
    assert "complete" in run(built, "completion", "bash", cache=cache).stdout
    answer = tmp_path / "answer"
    line = "understudy rec"
    asked = {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(answer),
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
    }
    run(built, cache=cache, **asked)
    assert answer.read_text().strip() == "recommend"


def test_kubectl_completes_verbs_by_a_link_to_the_file(built: Path, cache: Path, tmp_path: Path) -> None:
    link = tmp_path / "kubectl_complete-understudy"
    link.symlink_to(built)
    done = run(link, "rec", cache=cache)
    assert done.stdout.splitlines() == ["recommend", ":4"], done.stderr


def test_the_link_of_krew_runs_the_command(built: Path, cache: Path, tmp_path: Path) -> None:
    link = tmp_path / "kubectl-understudy"
    link.symlink_to(built)
    assert run(link, "version", cache=cache).returncode == 0


def test_nothing_is_imported_from_outside_of_the_file(built: Path, cache: Path) -> None:
    program = IMPORTED.format(file=str(built), arguments=["check", str(MANIFESTS)])
    done = run("-c", program, cache=cache)
    modules: dict[str, str] = json.loads(done.stderr.splitlines()[-1])
    assert {"understudy", "pydantic_core"} <= modules.keys()
    assert not {"rclpy", "kopf", "cryptography", "kubernetes", "numpy"} & modules.keys()
    for name in ("understudy", "pydantic", "pydantic_core", "yaml", "py_trees"):
        assert modules[name].startswith(str(cache)), name


def test_a_second_start_unpacks_nothing(built: Path, cache: Path) -> None:
    def unpacked() -> dict[Path, int]:
        return {folder: folder.stat().st_ctime_ns for folder in (cache / "understudy" / "command").iterdir()}

    run(built, "version", cache=cache)
    before = unpacked()
    run(built, "version", cache=cache)
    assert len(before) == 1
    assert unpacked() == before


def test_without_a_private_cache_the_command_runs_from_a_temporary_folder(built: Path, tmp_path: Path) -> None:
    shared = tmp_path / "understudy" / "command"
    shared.mkdir(parents=True)
    shared.chmod(0o777)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    done = run(built, "version", cache=tmp_path, TMPDIR=str(temporary))
    assert done.returncode == 0, done.stderr
    assert list(shared.iterdir()) == []
    assert list(temporary.iterdir()) == [], "it is removed at the end"


def test_a_file_for_another_platform_says_so(built: Path, tmp_path: Path) -> None:
    other = Platform("moon-risc", "none", ("risc",), ".cpython-{}-moon.so")
    foreign = tmp_path / "understudy"
    foreign.write_bytes(command_file.file_of(other, {"pydantic_core/_pydantic_core.cpython-311-moon.so": b""}))
    done = run(foreign, "version", cache=tmp_path, PATH=str(tmp_path))
    assert done.returncode == 1
    assert "this file is for Python 3.11 on moon-risc" in done.stderr
    assert not (tmp_path / "understudy" / "command").exists()


def test_another_python_of_the_path_runs_a_file_that_is_for_its_version(tmp_path: Path) -> None:
    other = tmp_path / "python3.12"
    other.write_text('#!/bin/sh\necho "$@"\n')
    other.chmod(0o755)
    file = tmp_path / "understudy"
    suffix = command_file.here().suffix.format("312")
    file.write_bytes(command_file.file_of(command_file.here(), {f"pydantic_core/_pydantic_core{suffix}": b""}))
    done = run(file, "status", cache=tmp_path, PATH=str(tmp_path))
    expected = f"{file} status\n" if sys.version_info[:2] != (3, 12) else done.stdout
    assert done.stdout == expected, done.stderr


def test_a_file_without_the_compiled_module_is_refused() -> None:
    with pytest.raises(Refused):
        command_file.file_of(PLATFORMS[0], command_file.own_package())


def test_a_file_for_each_version_of_python_is_below_its_limit(built: Path) -> None:
    (compiled,) = (member for member in packages(built).infolist() if member.filename.endswith(".so"))
    assert built.stat().st_size + (len(PYTHONS) - 1) * compiled.compress_size < command_file.MOST_BYTES


def test_the_same_packages_make_the_same_file() -> None:
    members = {"b.py": b"2", "a.py": b"1"}
    assert command_file.archived(members) == command_file.archived(dict(reversed(members.items())))


def test_the_file_has_licences_and_neither_ros_nor_tests(built: Path) -> None:
    names = packages(built).namelist()
    assert not [name for name in names if name.startswith(("rclpy", "kopf", "cryptography", "numpy", "tests/"))]
    assert [name for name in names if name.startswith("pydantic_core") and "LICENSE" in name]


def test_the_pins_have_no_markers_and_all_extras_of_the_file() -> None:
    pins = command_file.pinned()
    assert not [pin for pin in pins.values() if ";" in pin.splitlines()[0]]
    assert all("--hash=sha256:" in pin for pin in pins.values())
    assert {"argcomplete", "scenario-execution", "pydantic-core"} <= pins.keys()
    assert not {"kopf", "cryptography", "setuptools"} & pins.keys()
    assert EXTRAS == ("completion", "osc")


def test_the_manifest_names_the_archive_of_each_platform_with_its_checksum(tmp_path: Path) -> None:
    for platform in PLATFORMS:
        (tmp_path / f"understudy-{platform.name}.tar.gz").write_bytes(platform.name.encode())
    made = yaml.safe_load(command_file.manifest(tmp_path, "https://example.com/understudy"))
    assert made["metadata"]["name"] == "understudy"
    assert made["spec"]["version"] == f"v{__version__}"
    found = {}
    for one in made["spec"]["platforms"]:
        name = "-".join(one["selector"]["matchLabels"][key] for key in ("os", "arch"))
        assert one["uri"] == f"https://example.com/understudy/releases/download/v{__version__}/understudy-{name}.tar.gz"
        assert one["bin"] == command_file.NAME
        found[name] = one["sha256"]
    assert found == {one.name: hashlib.sha256(one.name.encode()).hexdigest() for one in PLATFORMS}


def test_the_archive_for_krew_has_the_file_and_the_licence(built: Path) -> None:
    with tarfile.open(built.with_name(f"{built.name}.tar.gz")) as archive:
        assert {member.name: member.mode for member in archive} == {"understudy": 0o755, "LICENSE": 0o644}


def test_the_release_builds_the_files_and_attaches_them_with_the_manifest() -> None:
    workflow = (REPOSITORY / ".github" / "workflows" / "release.yaml").read_text()
    assert "scripts/command dist --manifest" in workflow
    (create,) = (
        step for step in yaml.safe_load(workflow)["jobs"]["release"]["steps"] if step["name"] == "Create the release"
    )
    assert "dist/*" in create["run"]

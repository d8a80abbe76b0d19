"""The workflows of the public CI use only commands and options that exist, and pin what they fetch."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from testcluster import cli
from testcluster.paths import REPOSITORY
from tests import conftest

WORKFLOWS = sorted((REPOSITORY / ".github" / "workflows").glob("*.yaml"))

STUB_LIBRARY = """\
REPOSITORY=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
CACHE=$REPOSITORY/cache
mkdir -p "$CACHE/log"
_started=0
say() { :; }
fail() { echo "$*" >&2; exit 1; }
python_environment() { PYTHON=$REPOSITORY/python; }
helm_program() { :; }
debian_programs() { :; }
"""
"""The part of scripts/lib.sh that scripts/test needs for end-to-end tests; it installs nothing."""

RECORDER = '#!/bin/sh\necho "${UNDERSTUDY_CLUSTER_PROVIDER:-} $(basename "$0") $*" >>"$(dirname "$0")/calls"\n'


def steps(workflow: Path) -> list[dict[str, Any]]:
    """The steps of all jobs."""
    jobs = yaml.safe_load(workflow.read_text())["jobs"].values()
    return [step for job in jobs for step in job["steps"]]


def commands(workflow: Path, program: str) -> list[list[str]]:
    """The words of each command that runs a program of the repository, without redirections."""
    lines = [line.strip() for step in steps(workflow) for line in step.get("run", "").splitlines()]
    found = [re.split(r" (?:\d?>|\|\|)", line)[0] for line in lines if line.split()[:1] == [program]]
    return [shlex.split(line) for line in found]


def options_of_pytest() -> dict[str, list[str]]:
    """The choices of each option that the tests add to pytest."""
    found: dict[str, list[str]] = {}

    class Parser:
        def getgroup(self, name: str) -> Parser:
            return self

        def addoption(self, option: str, choices: list[str] | None = None, **other: object) -> None:
            found[option] = choices or []

    conftest.pytest_addoption(Parser())  # type: ignore[arg-type]
    return found


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_every_action_is_pinned_to_a_commit_and_every_download_has_a_checksum(workflow: Path) -> None:
    for step in steps(workflow):
        if "uses" in step:
            assert re.fullmatch(r"[\w./-]+@[0-9a-f]{40}", step["uses"]), step["uses"]
        if "curl " in step.get("run", ""):
            assert "sha256sum --check" in step["run"], step["name"]


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_every_script_that_is_used_exists(workflow: Path) -> None:
    text = "\n".join(step.get("run", "") for step in steps(workflow))
    used = set(re.findall(r"scripts/[\w./]+", text))
    assert used
    for script in used:
        assert (REPOSITORY / script).is_file(), script


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_the_commands_of_the_test_cluster_are_accepted_by_its_parser(workflow: Path) -> None:
    for words in commands(workflow, "scripts/cluster"):
        cli.parser().parse_args(words[1:])


def suites() -> list[str]:
    """The suites of scripts/test."""
    found = re.search(r"^(lint \| .*)\)$", (REPOSITORY / "scripts" / "test").read_text(), re.MULTILINE)
    assert found
    return found[1].split(" | ")


def test_the_suites_of_the_checks_exist() -> None:
    [job] = yaml.safe_load((REPOSITORY / ".github" / "workflows" / "checks.yaml").read_text())["jobs"].values()
    assert set(job["strategy"]["matrix"]["suite"]) <= set(suites())


def test_the_suite_and_the_options_of_the_kind_workflow_exist() -> None:
    markers = re.findall(r'^  "(\w+): ', (REPOSITORY / "pyproject.toml").read_text(), re.MULTILINE)
    [(_, suite, *arguments)] = commands(REPOSITORY / ".github" / "workflows" / "kind.yaml", "scripts/test")
    assert suite in suites()
    options = dict(zip(arguments[::2], arguments[1::2], strict=True))
    assert options.pop("--cluster") in options_of_pytest()["--cluster"]
    assert options.pop("-m").removeprefix("not ") in markers
    assert not options, "options that this test does not know"


def test_the_kind_workflow_runs_the_end_to_end_tests_on_the_provider_kind(tmp_path: Path) -> None:
    [command] = commands(REPOSITORY / ".github" / "workflows" / "kind.yaml", "scripts/test")
    scripts = tmp_path / "scripts"
    scripts.mkdir()
    (scripts / "test").write_text((REPOSITORY / "scripts" / "test").read_text())
    (scripts / "lib.sh").write_text(STUB_LIBRARY)
    for program in (scripts / "cluster", scripts / "images", tmp_path / "python"):
        program.write_text(RECORDER)
        program.chmod(0o755)
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    done = subprocess.run(["bash", *command], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (scripts / "calls").read_text().splitlines() == ["kind cluster up", "kind images --load"]
    runs = (tmp_path / "calls").read_text().splitlines()
    assert [re.findall(r"--part (\S+)", run) for run in runs] == [["side-by-side"], ["alone"]]
    for run in runs:
        assert run.startswith("kind python -m pytest ")
        assert " tests/e2e " in run
        assert run.endswith(" --cluster kind -m not long")


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_every_workflow_says_that_it_was_not_run(workflow: Path) -> None:
    [comment, *_] = workflow.read_text().split("\nname:")
    assert "has not been run by the authors" in comment

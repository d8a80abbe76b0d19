"""What a shell is answered that asks, by argcomplete's own protocol."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

import pytest

from scripts.generation import commands
from tests.support import fleet
from tests.support.fake_kubectl import FakeKubectl
from understudy.cli.common import shell_completion
from understudy.cli.completion import command as completion
from understudy.main import main

REPOSITORY = Path(__file__).parents[4]
VERBS = commands.parsers()


def completed(line: str, folder: Path) -> list[str]:
    """What may come at the end of a line."""
    answer = folder / "answer"
    answer.unlink(missing_ok=True)
    asked = {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(answer),
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
    }
    command = [sys.executable, "-m", "understudy"]
    subprocess.run(command, env={**os.environ, **asked}, timeout=60, check=False)
    return answer.read_text().split() if answer.exists() else []


def answered_to_kubectl(*words: str) -> list[str]:
    """What kubectl reads of the program that it asks."""
    command = [
        sys.executable,
        "-c",
        "from understudy.cli.common.shell_completion import complete_for_kubectl; complete_for_kubectl()",
    ]
    done = subprocess.run([*command, *words], capture_output=True, text=True, timeout=60, check=True)
    return done.stdout.splitlines()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("understudy fen", ["fence"]),
        ("understudy mon", []),
        ("understudy vers", ["version"]),
        ("understudy -n fleet fen", ["fence"]),
        ("understudy --context=lab -n fleet inject robot-1 fre", ["freeze"]),
        ("understudy status -l app", ["app=navigation"]),
        ("understudy status --all", ["--all-namespaces"]),
        ("understudy inject robot-1 fre", ["freeze"]),
        ("understudy completion z", ["zsh"]),
        ("understudy explain robot-1", ["robot-17-navigation", "robot-18-navigation", "robot-19-navigation"]),
        ("understudy status robot-17-navigation robot-18", ["robot-18-navigation"]),
        ("understudy status --context l", ["lab"]),
        ("understudy report robot-18", ["robot-18-navigation"]),
        ("understudy recommend --safety H", ["High"]),
        ("understudy monitor --", []),
    ],
)
def test_verbs_options_and_robot_names_are_completed(
    stand: FakeKubectl, tmp_path: Path, line: str, words: list[str]
) -> None:
    assert completed(line, tmp_path) == words


@pytest.mark.parametrize("verb", sorted(set(VERBS) - {"operator"}))
def test_every_verb_is_completed_by_its_own_parser(monkeypatch: pytest.MonkeyPatch, verb: str) -> None:
    answered: list[argparse.ArgumentParser] = []

    def answer(parser: argparse.ArgumentParser) -> None:
        answered.append(parser)
        sys.exit()

    monkeypatch.setattr(shell_completion, "answer_request", answer)
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", argparse.ArgumentParser.parse_args)  # is put back then
    monkeypatch.setattr(sys, "argv", ["understudy"])
    monkeypatch.setenv("_ARGCOMPLETE", "1")
    monkeypatch.setenv("COMP_LINE", line := f"understudy {verb} --")
    monkeypatch.setenv("COMP_POINT", str(len(line)))
    with pytest.raises(SystemExit):
        main()
    assert [parser.format_help() for parser in answered] == [VERBS[verb].format_help()]


def test_file_arguments_are_completed_from_the_folder(
    stand: FakeKubectl, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "policies").mkdir()
    (tmp_path / "policy.yaml").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY / "operator"))
    assert set(completed("understudy check polic", tmp_path)) == {"policies/", "policy.yaml"}
    assert answered_to_kubectl("simulate", "policy.yaml", "--bag", "polici") == ["policies/", ":6"]


def test_names_come_from_the_namespace_on_the_command_line(stand: FakeKubectl, tmp_path: Path) -> None:
    completed("understudy explain -n hall-2 --context lab robot", tmp_path)
    assert stand.asked[-1].startswith("--namespace=hall-2 --context=lab get robotworkloads.understudy.dev")
    completed("understudy -n hall-2 --context lab explain robot", tmp_path)
    assert stand.asked[-1].startswith("--namespace=hall-2 --context=lab get robotworkloads.understudy.dev")


def test_a_cluster_that_does_not_answer_completes_nothing(stand: FakeKubectl, tmp_path: Path) -> None:
    stand.tell(fleet.fleet(), error="Unable to connect to the server")
    assert completed("understudy explain robot", tmp_path) == []


def test_completions_for_kubectl_have_its_format(stand: FakeKubectl) -> None:
    assert answered_to_kubectl("explain", "robot-19") == ["robot-19-navigation", ":4"]
    assert answered_to_kubectl("check", "--str") == ["--strict", ":4"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_shell_gets_its_completion_script(capsys: pytest.CaptureFixture[str], shell: str) -> None:
    assert completion.main([shell]) == 0
    output = capsys.readouterr().out
    assert "_ARGCOMPLETE" in output
    assert "kubectl-understudy" in output

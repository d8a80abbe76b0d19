"""What a shell is answered that asks, by argcomplete's own protocol."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.unit.console import fleet
from tests.unit.console.kubectl import Stand
from understudy.console import completion

REPOSITORY = Path(__file__).parents[3]


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


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("understudy fen", ["fence"]),
        ("understudy mon", []),
        ("understudy status --all", ["--all-namespaces"]),
        ("understudy inject robot-1 fre", ["freeze"]),
        ("understudy completion z", ["zsh"]),
        ("understudy explain robot-1", ["robot-17-navigation", "robot-18-navigation", "robot-19-navigation"]),
        ("understudy status robot-17-navigation robot-18", ["robot-18-navigation"]),
        ("understudy status --context l", ["lab"]),
    ],
)
def test_verbs_options_and_names_are_completed(stand: Stand, tmp_path: Path, line: str, words: list[str]) -> None:
    assert completed(line, tmp_path) == words


def test_names_are_those_of_the_namespace_that_the_line_says(stand: Stand, tmp_path: Path) -> None:
    completed("understudy explain -n hall-2 --context lab robot", tmp_path)
    assert stand.asked[-1].startswith("--namespace=hall-2 --context=lab get robotworkloads.understudy.dev")


def test_a_cluster_that_does_not_answer_completes_nothing(stand: Stand, tmp_path: Path) -> None:
    stand.tell(fleet.fleet(), error="Unable to connect to the server")
    assert completed("understudy explain robot", tmp_path) == []


def test_kubectl_is_answered_in_its_own_way(stand: Stand) -> None:
    command = [sys.executable, "-c", "from understudy.console.completing import for_kubectl; for_kubectl()"]
    done = subprocess.run([*command, "explain", "robot-19"], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines() == ["robot-19-navigation", ":4"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_shell_is_told_how_to_ask(capsys: pytest.CaptureFixture[str], shell: str) -> None:
    assert completion.main([shell]) == 0
    told = capsys.readouterr().out
    assert "_ARGCOMPLETE" in told
    assert "kubectl-understudy" in told

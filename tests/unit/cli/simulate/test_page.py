"""What docs/trying.md shows of the commands is what they print."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.golden import assert_shown
from tests.unit.cli.simulate.patrol import record
from understudy.cli.simulate import learn, simulate

PAGE = Path(__file__).resolve().parents[4] / "docs" / "trying.md"
COMMANDS: dict[str, Callable[[list[str]], int]] = {"simulate": simulate.main, "learn": learn.main}


def test_the_recording_gives_the_results_on_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    record(tmp_path)
    (policy,) = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (tmp_path / "policy.yaml").write_text(policy)
    shown = re.findall(r"```console\n\$ understudy (simulate|learn) (.*?)\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert [command for command, _, _ in shown] == ["simulate", "learn"]
    for command, arguments, expected in shown:
        COMMANDS[command](shlex.split(arguments))
        assert_shown(PAGE, expected, capsys.readouterr().out)


@pytest.mark.parametrize("command", [simulate.main, learn.main])
def test_help_explains_the_exit_status(command: Callable[[list[str]], int], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command(["--help"])
    assert "Exit status: 0 if" in capsys.readouterr().out

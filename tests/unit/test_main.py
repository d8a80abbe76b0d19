"""The command's own help, for who has just installed it."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from types import SimpleNamespace
from typing import NoReturn

import pytest

from understudy import __version__
from understudy import main as command
from understudy.cli.common.cluster_access import kubectl
from understudy.cli.common.text import terminal


def _run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["understudy", *arguments])
    return command.main()


@pytest.mark.parametrize("asked", ["--help", "-h", "help"])
def test_help_lists_each_verb_for_users_on_one_screen(
    asked: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, asked) == 0
    lines = capsys.readouterr().out.splitlines()
    listed = [line.split()[0] for line in lines if line.startswith("  ")]
    inner = {"verify", "tracker"}  # for the chart and for the containers of a tracker
    assert sorted(listed) == sorted(verb.name for verb in command.VERBS if not verb.in_pods and verb.name not in inner)
    assert [line for line in lines if line in ("See", "Act", "Design", "Set up")] == ["See", "Act", "Design", "Set up"]
    assert len(lines) <= 36
    assert max(map(len, lines)) <= 100


def test_a_missing_verb_is_an_error_with_the_help_text(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch) == 2
    captured = capsys.readouterr()
    assert not captured.out
    assert "usage: understudy VERB" in captured.err


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("explan", "unknown verb 'explan'; did you mean 'explain'?"),
        ("frobnicate", "unknown verb 'frobnicate'; understudy --help lists all verbs"),
    ],
)
def test_an_unknown_verb_is_reported_with_a_similar_one(
    typed: str, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, typed) == 2
    assert capsys.readouterr().err == f"understudy: {message}\n"


def test_a_verb_without_its_extra_names_it(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def missing(module: str) -> NoReturn:
        raise ModuleNotFoundError("No module named 'kopf'", name="kopf")

    monkeypatch.setattr(command, "import_frozen", missing)
    assert _run(monkeypatch, "verify") == 1
    assert "kopf, which is not installed; install understudy with the extra operator" in capsys.readouterr().err


@pytest.mark.parametrize(
    "typed",
    [
        ["-n", "fleet", "status", "robot-1"],
        ["--namespace=fleet", "status", "robot-1"],
        ["status", "-n", "fleet", "robot-1"],
        ["-nfleet", "status", "robot-1"],
    ],
)
def test_options_may_be_in_front_of_the_verb(typed: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    parsed: list[argparse.Namespace] = []

    def run(arguments: list[str]) -> int:
        parser = argparse.ArgumentParser()
        kubectl.add_robots(parser)
        kubectl.add_options(parser)
        parsed.append(parser.parse_args(arguments))
        return 0

    monkeypatch.setattr(command, "import_frozen", lambda module: SimpleNamespace(main=run))
    assert _run(monkeypatch, *typed) == 0
    assert [(one.namespace, one.names) for one in parsed] == [("fleet", ["robot-1"])]


@pytest.mark.parametrize("typed", [["--color", "never", "status"], ["status", "--color=never"]])
def test_colours_are_chosen_with_every_verb(typed: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(terminal.COLOR, "")
    monkeypatch.setattr(command, "import_frozen", lambda module: SimpleNamespace(main=lambda arguments: len(arguments)))
    assert _run(monkeypatch, *typed) == 0, "the verb gets no argument"
    assert os.environ[terminal.COLOR] == "never"


def test_an_unknown_choice_of_colours_is_an_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, "status", "--color=blue") == 2
    assert capsys.readouterr().err == "understudy: --color: found 'blue'; give one of auto, always, never\n"


def test_options_without_a_verb_are_an_error_with_the_help_text(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, "-n", "fleet") == 2
    assert "usage: understudy VERB" in capsys.readouterr().err


@pytest.mark.parametrize("asked", ["--version", "version"])
def test_the_version_is_printed(
    asked: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, asked) == 0
    assert capsys.readouterr().out == f"understudy {__version__}\n"


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize(
    "typed", ["--help", "version", "check --help", "check -R examples/quickstart", "completion bash"]
)
def test_output_that_nobody_reads_is_no_error(typed: str, unbuffered: str) -> None:
    """As in ``understudy --help | head -1``, when ``head`` has exited before everything is written."""
    done = _run_unread(["-m", "understudy", *typed.split()], unbuffered)
    assert "Error" not in done.stderr
    assert done.returncode in (0, 141)


def test_another_broken_pipe_is_reported() -> None:
    code = (
        "import sys, types\n"
        "from understudy import main\n"
        "def run(arguments):\n"
        "    raise BrokenPipeError('of a connection')\n"
        "sys.modules['understudy.cli.inspect.status'] = types.SimpleNamespace(main=run)\n"
        "sys.argv = ['understudy', 'status']\n"
        "sys.exit(main.main())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 1
    assert "of a connection" in done.stderr


def _run_unread(arguments: list[str], unbuffered: str) -> subprocess.CompletedProcess[str]:
    """Run Python with a standard output whose reader has exited."""
    reading, writing = os.pipe()
    os.close(reading)
    try:
        return subprocess.run(
            [sys.executable, *arguments],
            stdout=writing,
            stderr=subprocess.PIPE,
            env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
            text=True,
            timeout=60,
            check=False,
        )
    finally:
        os.close(writing)


@pytest.mark.parametrize(("end", "status"), [("return 75", 75), ("raise RuntimeError", 1)])
def test_a_process_in_a_pod_ends_although_a_thread_never_does(end: str, status: int) -> None:
    """As threads of the middleware may: the process of a monitor that had to start again hung until its node was restarted."""
    code = (
        "import sys, threading, types\n"
        "from understudy import main\n"
        "def run(arguments):\n"
        "    threading.Thread(target=threading.Event().wait).start()\n"
        "    print('last words', end='')\n"
        f"    {end}\n"
        "sys.modules['understudy.monitor.process'] = types.SimpleNamespace(main=run)\n"
        "sys.argv = ['understudy', 'monitor']\n"
        "sys.exit(main.main())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=20, check=False)
    assert (done.returncode, done.stdout) == (status, "last words")


def test_imported_modules_are_excluded_from_garbage_collection() -> None:
    code = (
        "import gc\n"
        "from understudy import main\n"
        "main.import_frozen('understudy.agent.process')\n"
        "made = [value for value in vars(main).values() if gc.is_tracked(value)]\n"
        "looked_at = set(map(id, gc.get_objects()))\n"
        "print(gc.isenabled(), bool(made), any(id(value) in looked_at for value in made))\n"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == (
        "True True False\n"
    )

"""The command's own help, for who has just installed it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from understudy import __version__
from understudy import main as command


def _run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["understudy", *arguments])
    return command.main()


@pytest.mark.parametrize("asked", ["--help", "-h", "help"])
def test_help_lists_each_verb_for_users(
    asked: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, asked) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines() if line.startswith("  ")]
    assert sorted(listed) == sorted(verb.name for verb in command.VERBS if not verb.in_pods)


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


def test_the_version_is_printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(monkeypatch, "--version") == 0
    assert capsys.readouterr().out == f"understudy {__version__}\n"


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

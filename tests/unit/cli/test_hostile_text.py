"""Texts of others, such as reasons and messages of a cluster's objects, do not control the user's terminal."""

from __future__ import annotations

import argparse
import io
import subprocess
import sys
import types

import pytest

from tests.support import fleet
from tests.support.fake_kubectl import FakeKubectl
from understudy import main as command
from understudy.api.kinds.switchover_spec import SwitchoverStatus
from understudy.cli.common.cluster_access.kubectl import Kubectl
from understudy.cli.common.cluster_access.pod_session import session
from understudy.cli.common.errors import CommandError, reports_errors
from understudy.cli.common.text import terminal
from understudy.cli.common.text.tree_text import coloured
from understudy.cli.inject import partition

ROBOT = "robot-17-navigation"
HOSTILE = "a\rb\x08\x1b[2J\x1b]0;owned\x07\x9b31m\u202ec"
"""Clears the screen, sets the window's title, turns red in one character, overwrites the line, and reverses the text."""

FOR_PEOPLE = [verb.name for verb in command.VERBS if not verb.in_pods]


class Terminal(io.StringIO):
    """A terminal that records what is written to it."""

    def isatty(self) -> bool:
        """Return that it is a terminal."""
        return True


def kubectl() -> Kubectl:
    return Kubectl(argparse.Namespace(namespace="fleet", context=None, kubeconfig=None))


def harmless(text: str) -> bool:
    return all(character.isprintable() or character in "\n\t" for character in text)


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["understudy", *arguments])
    return command.main()


@pytest.fixture
def hostile(stand: FakeKubectl) -> FakeKubectl:
    item = fleet.well()
    item["spec"]["pause"] = {"reason": f"{HOSTILE}\nfleet/other: fenced", "owner": HOSTILE}
    item["status"]["switchover"] = SwitchoverStatus(
        kind="Failover", request="asked", phase="Preparing", message=HOSTILE, since=fleet.ago(0)
    ).to_wire()
    stand.tell([item])
    return stand


def test_resume_escapes_the_reason_and_the_owner_of_the_pause(
    hostile: FakeKubectl, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(monkeypatch, "resume", ROBOT, "-n", "fleet") == 0
    output = capsys.readouterr().out
    assert harmless(output)
    assert r"a\rb\x08\x1b[2J\x1b]0;owned\x07\x9b31m\u202ec" in output
    assert len(output.splitlines()) == 1, "a reason adds no line of its own"


@pytest.mark.parametrize("verb", ["failover", "failback"])
def test_a_switchover_that_is_under_way_is_escaped(
    verb: str, hostile: FakeKubectl, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(monkeypatch, verb, ROBOT, "-n", "fleet") == 2
    error = capsys.readouterr().err
    assert "is under way" in error
    assert harmless(error)


@pytest.mark.parametrize(
    "verb", ["status", "explain", "timeline", "tree", "pause", "resume", "failover", "fence", "inject", "doctor"]
)
def test_a_message_of_the_api_server_is_escaped(
    verb: str, stand: FakeKubectl, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    stand.tell([], error=f"Error from server: {HOSTILE}")
    more = {"pause": ["--reason", "a"], "inject": ["kill"], "fence": ["--reason", "a", "--yes"]}.get(verb, [])
    name = [] if verb in ("status", "doctor") else [ROBOT]
    run(monkeypatch, verb, *name, *more, "-n", "fleet")
    captured = capsys.readouterr()
    assert harmless(captured.out + captured.err)
    assert r"\x1b[2J" in captured.out + captured.err


def test_the_output_of_a_container_is_escaped(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The owner of a pod's image chooses it."""

    @reports_errors("inject")
    def verb(arguments: list[str]) -> int:
        with subprocess.Popen([sys.executable, "-c", f"print({HOSTILE!r})"], stdout=subprocess.PIPE) as running:
            partition._next_report("pod", running, 20.0)
        return 0

    monkeypatch.setattr(command, "import_frozen", lambda module: types.SimpleNamespace(main=verb))
    assert run(monkeypatch, "inject") == 2
    error = capsys.readouterr().err
    assert error.startswith("understudy inject: pod pod was not cut off: a")
    assert r"\x1b[2J" in error
    assert harmless(error)


def test_a_line_of_others_in_an_error_does_not_look_like_one_of_ours(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    @reports_errors("resume")
    def verb(arguments: list[str]) -> int:
        raise CommandError("refused by a webhook:\nfleet/robot-17: resumed")

    monkeypatch.setattr(command, "import_frozen", lambda module: types.SimpleNamespace(main=verb))
    assert run(monkeypatch, "resume") == 2
    assert capsys.readouterr().err == "understudy resume: refused by a webhook:\n  fleet/robot-17: resumed\n"


def test_the_error_of_a_session_is_escaped(
    stand: FakeKubectl, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    stand.begin_with(f"sys.stderr.write({HOSTILE!r}); sys.exit(1)")

    @reports_errors("doctor")
    def verb(arguments: list[str]) -> int:
        with session(kubectl(), "pod", "container", "program") as found:
            found.ask("anything")
        return 0

    monkeypatch.setattr(command, "import_frozen", lambda module: types.SimpleNamespace(main=verb))
    assert run(monkeypatch, "doctor") == 2
    error = capsys.readouterr().err
    assert "the program in pod pod ended: b" in error
    assert harmless(error)


@pytest.mark.parametrize("verb", FOR_PEOPLE)
@pytest.mark.parametrize("fails", ["", "CommandError", "RuntimeError"])
def test_no_verb_can_print_control_characters(
    verb: str, fails: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever a verb prints, and however it ends: a new one need not think of it."""

    @reports_errors(verb)
    def carried_out(arguments: list[str]) -> int:
        print(HOSTILE, f"\x1b[31m{HOSTILE}", end=HOSTILE)
        print(HOSTILE, file=sys.stderr)
        sys.stdout.writelines([HOSTILE, "\ud800\n"])
        if fails:
            raise CommandError(HOSTILE) if fails == "CommandError" else RuntimeError(HOSTILE)
        return 0

    monkeypatch.setattr(command, "import_frozen", lambda module: types.SimpleNamespace(main=carried_out))
    before = sys.stdout, sys.stderr
    assert run(monkeypatch, verb) == {"": 0, "CommandError": 2, "RuntimeError": 1}[fails]
    assert (sys.stdout, sys.stderr) == before
    captured = capsys.readouterr()
    assert harmless(captured.out)
    assert harmless(captured.err)
    assert captured.out.count(r"\x1b[2J") == 4
    assert r"\ud800" in captured.out


def test_a_terminal_gets_colours_and_nothing_else() -> None:
    out = Terminal()
    with terminal.guarded(out) as guarded:
        print(coloured("ok", "Healthy", colours=terminal.colours(guarded)), "\x1b[5m\x1b[8mhidden", file=guarded)
    assert out.getvalue() == "\x1b[36mok\x1b[0m \\x1b[5m\\x1b[8mhidden\n"
    out = io.StringIO()
    with terminal.guarded(out) as guarded:
        print(coloured("ok", "Healthy", colours=True), file=guarded)
    assert out.getvalue() == "\\x1b[36mok\\x1b[0m\n", "a file gets no colours"


def test_a_screen_is_drawn_with_escaped_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LINES", "10")
    out = Terminal()
    with terminal.guarded(out) as guarded, terminal.screen(guarded):
        terminal.draw(guarded, [HOSTILE, "one\ntwo", coloured("ok", "Failed", colours=True)])
    drawn = out.getvalue()
    assert drawn.startswith(terminal.BEGIN)
    assert drawn.endswith(terminal.END)
    assert r"a\rb\x08\x1b[2J\x1b]0;owned\x07\x9b31m\u202ec" in drawn
    assert "\x1b[1;31mok\x1b[0m" in drawn
    assert "\x1b[2J" not in drawn
    assert r"one\ntwo" in drawn, "a text cannot add a row"


@pytest.mark.parametrize("verb", ["status", "explain", "timeline", "pause", "resume"])
def test_a_deeply_nested_object_does_not_end_a_verb(
    verb: str, stand: FakeKubectl, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The API server stores up to 10,000 levels, and Python's decoder ends at a few hundred."""
    item = fleet.well()
    item["spec"]["template"] = "DEEP"
    stand.begin_with(
        "import io\n"
        "class Deep(io.StringIO):\n"
        "    def write(self, text):\n"
        "        deep = '{\"a\":' * 5000 + '1' + '}' * 5000\n"
        "        return sys.__stdout__.write(text.replace('\"DEEP\"', deep))\n"
        "sys.stdout = Deep()"
    )
    stand.tell([item])
    name = [] if verb == "status" else [ROBOT]
    more = ["--reason", "a"] if verb == "pause" else []
    assert run(monkeypatch, verb, *name, *more, "-n", "fleet") in (0, 1)
    assert "Traceback" not in capsys.readouterr().err


INVALID = ("not JSON", "[" * 100_000, "9" * 5000, "{}", "[]", '{"answer')


@pytest.mark.parametrize("answer", INVALID, ids=["text", "brackets", "digits", "empty", "list", "cut"])
def test_an_invalid_answer_of_a_pod_is_an_error(answer: str, stand: FakeKubectl) -> None:
    """The program runs in a container of somebody else's image."""
    stand.begin_with(f"print({answer!r}, flush=True); time.sleep(1); sys.exit(0)")
    with (
        session(kubectl(), "pod", "container", "program") as found,
        pytest.raises(CommandError, match="pod pod gave an answer that cannot be read"),
    ):
        found.ask("anything")


@pytest.mark.parametrize(
    "report", ["not JSON", "[" * 100_000, "9" * 5000, "[]"], ids=["text", "brackets", "digits", "list"]
)
def test_an_invalid_report_of_a_container_is_an_error(report: str) -> None:
    with (
        subprocess.Popen([sys.executable, "-c", f"print({report!r})"], stdout=subprocess.PIPE) as running,
        pytest.raises(CommandError, match="pod pod was not cut off"),
    ):
        partition._next_report("pod", running, 20.0)

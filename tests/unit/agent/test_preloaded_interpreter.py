"""Modules that a held container imports: the application's own interpreter waits with them, and runs it as if it had been started."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import pytest

from understudy.agent.held_containers import HeldContainers
from understudy.api.protocol import freeze_script, hold_script

HEAVY = """\
import os, time
IMPORTED_BY, IMPORTED_AT = os.getpid(), time.time()
"""

REPORT = """\
import json, os, signal, sys, time
STARTED = time.time()
import heavy
print(json.dumps({
    "pid": os.getpid(), "parent": os.getppid(), "argv": sys.argv[1:], "name": __name__, "path": sys.path[0],
    "variable": os.environ.get("ROBOT"),
    "preloaded": heavy.IMPORTED_AT < STARTED - 0.2, "by": heavy.IMPORTED_BY, "file": __file__, "command": command(),
    "main": sys.modules["__main__"].__dict__ is globals(), "descriptors": sorted(descriptors()),
    "terminates": signal.getsignal(signal.SIGTERM) is signal.SIG_DFL,
    "interrupts": signal.getsignal(signal.SIGINT) is signal.default_int_handler,
}), flush=True)
"""

FUNCTIONS = """\
def command():
    return [word for word in open("/proc/self/cmdline").read().split("\\0") if word]
def descriptors():
    import os
    return [int(fd) for fd in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{fd}")]
"""


class Held:
    """A held container with an application of Python, in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.volume, self.app = folder / "volume", folder / "app"
        for one in (self.volume, self.app):
            one.mkdir()
        self.write("heavy.py", HEAVY)
        self.holds = HeldContainers(self.volume, ["app"])
        self.processes: list[subprocess.Popen[str]] = []

    def write(self, name: str, text: str) -> Path:
        path = self.app / name
        path.write_text(text)
        return path

    def hold(
        self,
        *words: str,
        modules: Sequence[str] = ("heavy",),
        environment: Mapping[str, str] | None = None,
        agent_after: float = 0.0,
    ) -> subprocess.Popen[str]:
        """Hold ``python3 WORDS...``, and wait until its modules are there. The agent prepares the volume some seconds later."""
        if not agent_after:
            self.holds.prepare()
        own = [sys.executable, *words]
        command = freeze_script.fenced_command("app", own, [], scope="all", directory=str(self.volume))
        before = len(command) - len(own)
        preloading = hold_script.preloading("app", own, modules, before=before, directory=str(self.volume))
        held = hold_script.held_command("app", command, [], [], preloading=preloading, directory=str(self.volume))
        process = subprocess.Popen(
            held, cwd=self.app, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            env={**os.environ, **(environment or {})},
        )  # fmt: skip
        self.processes.append(process)
        if agent_after:
            time.sleep(agent_after)
            self.holds.prepare()
        end = time.monotonic() + 20
        while self.holds.missing() and process.poll() is None:
            assert time.monotonic() < end, "it does not wait"
            time.sleep(0.01)
        time.sleep(0.3)  # what is imported from now on is seen to be later
        return process

    def start(self, process: subprocess.Popen[str], **variables: str) -> tuple[str, str]:
        """Claim it; returns what it wrote until its end."""
        self.holds.start({"app": variables})
        return process.communicate(timeout=20)


@pytest.fixture
def held(tmp_path: Path) -> Iterator[Held]:
    one = Held(tmp_path)
    yield one
    for process in one.processes:
        process.kill()
        process.communicate()


def reports(text: str) -> list[dict[str, object]]:
    import json

    return [json.loads(line) for line in text.splitlines() if line.startswith("{")]


def test_the_application_runs_in_the_interpreter_that_waited(held: Held) -> None:
    held.write("robot.py", FUNCTIONS + REPORT)
    process = held.hold("-m", "robot", "--speed", "2 m/s")
    out, errors = held.start(process, ROBOT='it\'s "r1"\n$HOME', **{"my.setting": "1"})
    [found] = reports(out)
    assert (found["pid"], found["by"]) == (process.pid, process.pid)
    assert found["preloaded"]
    assert found["variable"] == 'it\'s "r1"\n$HOME'
    assert (found["argv"], found["name"], found["path"]) == (["--speed", "2 m/s"], "__main__", str(held.app))
    assert found["command"] == [sys.executable, "-m", "robot", "--speed", "2 m/s"]
    assert found["main"]
    assert found["file"] == str(held.app / "robot.py")
    assert found["terminates"]
    assert found["interrupts"]
    assert process.returncode == 0
    assert "preloaded heavy in" in errors


def test_a_container_that_starts_before_its_agent_preloads_too(held: Held) -> None:
    held.write("robot.py", FUNCTIONS + REPORT)
    process = held.hold("-m", "robot", agent_after=0.5)
    out, _ = held.start(process)
    assert [found["preloaded"] for found in reports(out)] == [True]


def test_a_script_runs_too_and_its_exit_status_is_that_of_the_container(held: Held) -> None:
    script = held.write("script.py", f"{FUNCTIONS}{REPORT}sys.exit(3)\n")
    process = held.hold("-u", str(script), "x")
    out, _ = held.start(process)
    [found] = reports(out)
    assert (found["preloaded"], found["argv"], found["path"]) == (True, ["x"], str(held.app))
    assert process.returncode == 3


def test_an_error_of_the_application_is_shown_as_usual(held: Held) -> None:
    held.write("robot.py", "raise RuntimeError('no lidar')\n")
    process = held.hold("-m", "robot")
    _, errors = held.start(process)
    assert "RuntimeError: no lidar" in errors
    assert process.returncode == 1


def test_a_module_that_does_not_import_is_reported_and_the_application_runs(held: Held) -> None:
    held.write("robot.py", FUNCTIONS + REPORT)
    process = held.hold("-m", "robot", modules=["no_such_module", "heavy"])
    out, errors = held.start(process)
    assert "cannot preload no_such_module: ModuleNotFoundError" in errors
    assert [found["preloaded"] for found in reports(out)] == [True]


def test_a_held_interpreter_ends_at_once_when_its_pod_is_deleted(held: Held) -> None:
    process = held.hold("-m", "robot")
    process.send_signal(signal.SIGTERM)
    assert process.wait(5) == 143


@pytest.mark.parametrize(
    ("words", "variables"),
    [
        (["-m", "robot"], {"PYTHONHASHSEED": "3"}),
        (["-m", "robot"], {"LD_LIBRARY_PATH": "/opt/lib"}),
        (["-X", "dev", "-m", "robot"], {}),
    ],
)
def test_what_an_interpreter_reads_at_its_start_needs_one_of_its_own(
    held: Held, words: list[str], variables: dict[str, str]
) -> None:
    held.write("robot.py", FUNCTIONS + REPORT)
    process = held.hold(*words)
    out, _ = held.start(process, ROBOT="r1", **variables)
    [found] = reports(out)
    assert (found["preloaded"], found["variable"], found["pid"]) == (False, "r1", process.pid)


def test_an_application_that_can_be_frozen_is_executed_under_its_script(held: Held) -> None:
    held.write("robot.py", FUNCTIONS + REPORT)
    process = held.hold("-m", "robot")
    os.mkfifo(held.volume / freeze_script.fence_name("app"))
    out, _ = held.start(process)
    [found] = reports(out)
    assert (found["preloaded"], found["parent"]) == (False, process.pid)


LAUNCHER = """\
import subprocess, sys
{before}
children = [subprocess.Popen([sys.executable, "-m", "robot", name]{options}) for name in ("one", "two")]
sys.exit(max(child.wait() for child in children))
"""


def launched(held: Held, before: str = "", options: str = "", **variables: str) -> tuple[int, list[dict[str, object]]]:
    """What further processes report, and the pid of the application that starts them."""
    held.write("robot.py", FUNCTIONS + REPORT)
    held.write("launcher.py", LAUNCHER.format(before=before, options=options))
    process = held.hold("-m", "launcher")
    out, errors = held.start(process, **variables)
    found = reports(out)
    assert process.returncode == 0, errors
    assert sorted(one["argv"] for one in found) == [["one"], ["two"]], errors  # type: ignore[type-var]
    return process.pid, found


def test_further_processes_have_the_modules_and_nothing_of_the_application_that_started_them(held: Held) -> None:
    before = (
        "import os, signal, atexit\nleft = open('/dev/null')\n"
        "signal.signal(signal.SIGTERM, print)\natexit.register(print, 'at exit')"
    )
    pid, found = launched(held, before, ROBOT="r1")
    for one in found:
        assert one["preloaded"]
        assert (one["by"], one["parent"]) == (pid, pid)
        assert one["pid"] != pid
        assert one["command"] == [sys.executable, "-m", "robot", *one["argv"]]  # type: ignore[misc]
        assert (one["variable"], one["name"], one["path"]) == ("r1", "__main__", str(held.app))
        assert (one["terminates"], one["interrupts"], one["main"]) == (True, True, True)
        assert one["descriptors"] == [0, 1, 2], "files of the application that started it are closed"


def test_what_the_starting_application_has_written_is_written_once(held: Held) -> None:
    held.write("robot.py", "print('robot')\n")
    held.write(
        "launcher.py", "import subprocess, sys\nprint('launcher')\nsubprocess.run([sys.executable, 'robot.py'])\n"
    )
    out, _ = held.start(held.hold("-m", "launcher"))
    assert sorted(out.split()) == ["launcher", "robot"]


def test_modules_of_the_starting_application_are_not_those_of_a_further_process(held: Held) -> None:
    held.write("settings.py", "CHANGED = []\n")
    held.write("robot.py", "import settings\nprint('changed', settings.CHANGED)\n")
    held.write(
        "launcher.py",
        "import subprocess, sys, settings\nsettings.CHANGED.append(1)\nsubprocess.run([sys.executable, '-m', 'robot'])\n",
    )
    out, _ = held.start(held.hold("-m", "launcher"))
    assert out == "changed []\n"


def test_a_further_process_has_the_streams_environment_and_session_that_it_was_given(held: Held) -> None:
    held.write(
        "robot.py",
        "import os, sys\n"
        "print(sys.stdin.read(), os.environ['X'], os.environ.get('ROBOT'), os.getsid(0) == os.getpid())\n"
        "print('wrong', file=sys.stderr)\n"
        "sys.exit(7)\n",
    )
    held.write(
        "launcher.py",
        "import os, subprocess, sys\n"
        "done = subprocess.run([sys.executable, '-m', 'robot'], input='in', text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,"
        " start_new_session=True, env={**{k: v for k, v in os.environ.items() if k != 'ROBOT'}, 'X': 'x'})\n"
        "print(done.returncode, done.stdout.split())\n",
    )
    out, _ = held.start(held.hold("-m", "launcher"), ROBOT="r1")
    assert out == "7 ['wrong', 'in', 'x', 'None', 'True']\n"  # what goes to a pipe is written at the end


def test_a_further_process_that_is_killed_or_fails_is_seen_by_who_started_it(held: Held) -> None:
    held.write("robot.py", "import os, sys\nos.kill(os.getpid(), int(sys.argv[1])) if sys.argv[1] != '0' else 1 / 0\n")
    held.write(
        "launcher.py",
        "import subprocess, sys\n"
        "print([subprocess.run([sys.executable, '-m', 'robot', n], stderr=subprocess.DEVNULL).returncode for n in ('9', '15', '0')])\n",
    )
    out, _ = held.start(held.hold("-m", "launcher"))
    assert out == "[-9, -15, 1]\n"


@pytest.mark.parametrize(
    ("before", "options"),
    [
        ("import threading, time; threading.Thread(target=time.sleep, args=(60,), daemon=True).start()", ""),
        ("", ", env={**__import__('os').environ, 'PYTHONHASHSEED': '3'}"),
        ("", ", cwd='.'"),
    ],
)
def test_a_further_process_that_cannot_be_forked_is_executed(held: Held, before: str, options: str) -> None:
    pid, found = launched(held, before, options)
    assert [(one["preloaded"], one["parent"]) for one in found] == [(False, pid)] * 2


@pytest.mark.parametrize("first_line", [f"#!{sys.executable}", f"#!/usr/bin/env {Path(sys.executable).name}"])
def test_a_script_that_names_the_interpreter_is_forked_and_another_program_is_executed(
    held: Held, first_line: str
) -> None:
    script = held.write("node", f"{first_line}\n{FUNCTIONS}{REPORT}")
    script.chmod(0o755)
    held.write(
        "launcher.py", f"import subprocess\nsubprocess.run([{str(script)!r}, 'x'])\nsubprocess.run(['echo', 'other'])\n"
    )
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    out, _ = held.start(held.hold("-m", "launcher", environment={"PATH": path}))
    [found] = reports(out)
    assert (found["preloaded"], found["argv"], found["file"]) == (True, ["x"], str(script))
    assert "other\n" in out


def test_processes_of_asyncio_are_forked_too(held: Held) -> None:
    held.write("robot.py", FUNCTIONS + REPORT)
    held.write(
        "launcher.py",
        "import asyncio, sys\n"
        "async def main():\n"
        "    child = await asyncio.create_subprocess_exec(sys.executable, '-m', 'robot', 'x')\n"
        "    print('ended', await child.wait(), flush=True)\n"
        "asyncio.run(main())\n",
    )
    out, _ = held.start(held.hold("-m", "launcher", modules=["heavy", "asyncio"]))
    assert "ended 0" in out
    assert [one["preloaded"] for one in reports(out)] == [True]


def test_an_agent_that_writes_no_interpreter_s_file_lets_the_container_wait_as_before(held: Held) -> None:
    held.write("robot.py", FUNCTIONS + REPORT)
    prepare: Callable[[], None] = held.holds.prepare

    def without() -> None:
        prepare()
        (held.volume / hold_script.PRELOADED_INTERPRETER).unlink()

    held.holds.prepare = without  # type: ignore[method-assign]
    process = held.hold("-m", "robot")
    out, _ = held.start(process)
    assert [(one["preloaded"], one["pid"]) for one in reports(out)] == [(False, process.pid)]


def test_only_a_command_that_begins_with_python_can_be_preloaded() -> None:
    assert hold_script.preloads(["python3", "-m", "app"])
    assert hold_script.preloads(["/usr/bin/python3.12", "app.py"])
    assert not hold_script.preloads(["ros2", "launch", "x"])
    assert not hold_script.preloads(["/bin/sh", "-c", "python3 app.py"])
    assert not hold_script.preloads([])

"""The hold script under real shells."""

import contextlib
import os
import random
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

from understudy.agent.held_containers import HeldContainers
from understudy.api.protocol import hold_script

SHELLS = [
    pytest.param(
        [shutil.which(name), *arguments],
        id=name,
        marks=pytest.mark.skipif(not shutil.which(name), reason="not installed"),
    )
    for name, *arguments in (["dash"], ["busybox", "sh"], ["bash"])
]
DEADLINE = 5.0  # seconds


@pytest.fixture(params=SHELLS)
def shell(request):
    return request.param


@pytest.fixture
def hold(shell, tmp_path):
    """Start a held command beside an agent; what it prints is in the file ``out``."""
    processes = []

    def start(command, args=(), warm_paths=(), env=None, agent=True):
        if agent:
            HeldContainers(tmp_path, ["app"]).prepare()
        _, *rest = hold_script.held_command("app", command, args, warm_paths, directory=str(tmp_path))
        with (tmp_path / "out").open("a") as out:
            process = subprocess.Popen([*shell, *rest], stdout=out, stderr=subprocess.STDOUT, env=env)
        processes.append(process)
        return process

    yield start
    for process in processes:
        process.kill()
        process.wait()


def wait_until(condition, within=DEADLINE):
    end = time.monotonic() + within
    while not condition():
        assert time.monotonic() < end, "not in time"
        time.sleep(0.005)


def waits(folder: Path) -> bool:
    return not HeldContainers(folder, ["app"]).missing()


def write_env(folder: Path, environment) -> None:
    (folder / ".env").write_text(hold_script.env_file(environment))
    (folder / ".env").rename(folder / hold_script.env_name("app"))


def wake(folder: Path) -> bool:
    """As the agent does it: says whether somebody was waiting."""
    try:
        fd = os.open(folder / hold_script.wake_name("app"), os.O_WRONLY | os.O_NONBLOCK)
    except OSError:
        return False
    with contextlib.suppress(BrokenPipeError):  # its reader has just gone
        os.write(fd, b"\n")
    os.close(fd)
    return True


def cpu_ticks(pid: int) -> int:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


def test_a_held_container_waits_and_then_executes_its_command(hold, tmp_path):
    process = hold(["sh", "-c", 'echo "$GREETING $*"; echo $$', "name"], ["one", "two words"])
    wait_until(lambda: waits(tmp_path))
    assert process.poll() is None
    write_env(tmp_path, {"GREETING": "hello"})
    assert wake(tmp_path)
    assert process.wait(DEADLINE) == 0
    assert (tmp_path / "out").read_text() == f"hello one two words\n{process.pid}\n"


def test_a_held_container_starts_within_half_a_second(hold, tmp_path):
    process = hold(["true"])
    wait_until(lambda: waits(tmp_path))
    write_env(tmp_path, {})
    started_at = time.monotonic()
    wake(tmp_path)
    process.wait(DEADLINE)
    assert time.monotonic() - started_at < 0.5


def test_a_held_container_uses_no_cpu_time(hold, tmp_path):
    process = hold(["true"])
    wait_until(lambda: waits(tmp_path))

    def spent() -> tuple[int, str]:
        status = Path(f"/proc/{process.pid}/status").read_text()
        return cpu_ticks(process.pid), status.split("nonvoluntary")[0].rpartition(":")[2]

    def still() -> bool:
        before = spent()
        time.sleep(0.5)
        return spent() == before

    wait_until(still)  # it says that it waits a moment before it does


@pytest.mark.parametrize("delay", [0, 0.001, 0.002, 0.003, 0.004, 0.008, 0.016])
@pytest.mark.parametrize("prepared", [False, True])
def test_a_start_at_any_moment_is_detected(hold, tmp_path, delay, prepared):
    holds = HeldContainers(tmp_path, ["app"])
    for _ in range(8):
        process = hold(["true"], agent=prepared)
        time.sleep(delay * random.random())
        holds.prepare()
        holds.start({})
        assert process.wait(DEADLINE) == 0
        for name in ("env-app", "wake-app"):
            (tmp_path / name).unlink(missing_ok=True)


def test_a_container_that_starts_after_its_environment_does_not_wait(hold, tmp_path):
    write_env(tmp_path, {"A": "1"})
    assert hold(["sh", "-c", "echo $A"]).wait(DEADLINE) == 0
    assert (tmp_path / "out").read_text() == "1\n"
    assert not waits(tmp_path)


def test_a_wakeup_without_environment_does_not_start_the_command(hold, tmp_path):
    process = hold(["true"])
    wait_until(lambda: waits(tmp_path))
    assert wake(tmp_path)
    assert wake(tmp_path)
    time.sleep(0.2)
    assert process.poll() is None


def test_a_restart_of_the_agent_wakes_no_container(hold, tmp_path):
    process = hold(["true"])
    wait_until(lambda: waits(tmp_path))
    before = cpu_ticks(process.pid)
    for _ in range(20):
        os.close(os.open(tmp_path / "wake-app", os.O_WRONLY | os.O_NONBLOCK))
    time.sleep(0.2)
    assert process.poll() is None
    assert cpu_ticks(process.pid) == before


def test_a_started_container_no_longer_reads_the_fifo(hold, tmp_path):
    hold(["sleep", "60"])
    wait_until(lambda: waits(tmp_path))
    write_env(tmp_path, {})
    assert wake(tmp_path)
    wait_until(lambda: not wake(tmp_path))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_held_container_stops_on_a_signal(hold, tmp_path, number):
    process = hold(["true"])
    wait_until(lambda: waits(tmp_path))
    time.sleep(0.05)
    process.send_signal(number)
    assert process.wait(DEADLINE) == 143


def test_a_warming_container_stops_on_a_signal(hold, tmp_path):
    slow = tmp_path / "bin"
    slow.mkdir()
    (slow / "find").write_text("#!/bin/sh\nexec sleep 5\n")
    (slow / "find").chmod(0o755)
    process = hold(["true"], warm_paths=["/etc"], env={"PATH": f"{slow}:{os.environ['PATH']}"})
    time.sleep(0.2)
    assert not waits(tmp_path)
    process.terminate()
    assert process.wait(2) == 143


def test_the_command_gets_its_signals_back(hold, tmp_path):
    process = hold(["sleep", "60"])
    wait_until(lambda: waits(tmp_path))
    write_env(tmp_path, {})
    wake(tmp_path)
    wait_until(lambda: b"sleep\x0060" in Path(f"/proc/{process.pid}/cmdline").read_bytes()[:9])
    process.terminate()
    assert process.wait(DEADLINE) == -signal.SIGTERM


def test_warm_paths_are_read_and_missing_ones_are_ignored(hold, tmp_path):
    warm = tmp_path / "with space"
    (warm / "deep").mkdir(parents=True)
    (warm / "deep" / "file").write_bytes(b"x" * 100_000)
    os.utime(warm / "deep" / "file", (0, 0))
    process = hold(["true"], warm_paths=["/not/there", str(warm), str(warm / "deep" / "file")])
    wait_until(lambda: waits(tmp_path))
    # Reading is seen by the access time, where the mount keeps it (relatime does, for one older than the change).
    if "noatime" not in Path("/proc/mounts").read_text():
        assert (warm / "deep" / "file").stat().st_atime > 0
    write_env(tmp_path, {})
    wake(tmp_path)
    assert process.wait(DEADLINE) == 0
    assert (tmp_path / "out").read_text() == ""


def test_a_container_that_starts_before_the_agent_waits_for_the_agents_fifo(hold, tmp_path):
    process = hold(["true"], agent=False)
    time.sleep(0.3)
    assert list(tmp_path.iterdir()) == [tmp_path / "out"], "the container writes nothing"
    HeldContainers(tmp_path, ["app"]).prepare()
    wait_until(lambda: waits(tmp_path))
    write_env(tmp_path, {})
    wake(tmp_path)
    assert process.wait(DEADLINE) == 0


def test_values_are_taken_literally(hold, tmp_path):
    environment = {
        "QUOTES": 'it\'s "so"',
        "SHELL_WORDS": "$HOME `date` $(date) \\ * ; & |",
        "LINES": "one\ntwo\n",
        "EMPTY": "",
        "UNICODE": "größe",
        "my.setting-x": "it's $HOME",
    }
    write_env(tmp_path, environment)
    assert hold(["/usr/bin/env", "-0"]).wait(DEADLINE) == 0
    got = dict(entry.split("=", 1) for entry in (tmp_path / "out").read_text().split("\0") if entry)
    assert environment.items() <= got.items()
    assert not [name for name in got if name.startswith("understudy_")]


def test_arguments_may_contain_any_characters(hold, tmp_path):
    write_env(tmp_path, {})
    assert hold(["printf", "%s\n"], ["--", "-x", "$HOME", "", "a b"], ["/etc/hostname"]).wait(DEADLINE) == 0
    assert (tmp_path / "out").read_text() == "--\n-x\n$HOME\n\na b\n"


def test_the_script_has_nothing_that_the_kubelet_expands():
    assert "$(" not in hold_script.HOLD_SCRIPT
    assert "$$" not in hold_script.HOLD_SCRIPT


def test_a_container_without_a_command_is_refused():
    with pytest.raises(ValueError, match="container app: command is missing"):
        hold_script.held_command("app", [], ["--flag"], [])


@pytest.mark.parametrize(("name", "value"), [("", "x"), ("A=B", "x"), ("A", "x\0y")])
def test_invalid_variables_are_refused(name, value):
    with pytest.raises(ValueError, match="environment variable"):
        hold_script.env_file({name: value})

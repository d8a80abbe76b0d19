"""The script that holds an application, run by the shells that are here, with real processes."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from understudy.api.protocol import freeze_script

COUNTING = """
import os, signal, subprocess, sys, time
child = subprocess.Popen(["sleep", "600"], start_new_session=True)
print(os.getpid(), child.pid, flush=True)
while True:
    with open(sys.argv[1], "a") as file:
        file.write(".")
    time.sleep(0.02)
"""
SHELLS = [["/bin/sh"], ["bash", "--posix"], ["busybox", "sh"]]


def within(check: Callable[[], object], seconds: float = 25.0) -> None:
    end = time.monotonic() + seconds
    while not check():
        assert time.monotonic() < end, "in time"
        time.sleep(0.02)


def state(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return "gone"


def caught(pid: int) -> int:
    """The signals that a process has set something for, a bit for each."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(next(line.split()[1] for line in status.splitlines() if line.startswith("SigCgt")), 16)


class Container:
    """A container's process as the kubelet would start it, in a process namespace of its own where ``scope`` is all."""

    def __init__(self, folder: Path, shell: list[str], scope: freeze_script.Scope, *, fifo: bool = True) -> None:
        self.folder, self.shell, self.scope = folder, shell, scope
        self.output = folder / "output"
        self.fifo = folder / freeze_script.fence_name("drive")
        if fifo:
            os.mkfifo(self.fifo, 0o666)
        self.process: subprocess.Popen[str] | None = None

    def start(self, program: str = COUNTING, *, started: bool = True) -> None:
        command = [sys.executable, "-c", program, str(self.output)]
        made = freeze_script.fenced_command("drive", command, [], scope=self.scope, directory=str(self.folder))
        namespace = ["unshare", "--pid", "--fork", "--mount-proc", "--kill-child"] if self.scope == "all" else []
        self.process = subprocess.Popen(
            [*namespace, *self.shell, *made[1:]], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        if started:
            assert self.process.stdout is not None
            assert self.process.stdout.readline()

    def written(self) -> int:
        return self.output.stat().st_size if self.output.exists() else 0

    def goes_on(self) -> None:
        before = self.written()
        within(lambda: self.written() > before + 2)

    def hold(self) -> None:
        (self.folder / freeze_script.HELD_NAME).touch()
        self.wake()

    def release(self) -> None:
        (self.folder / freeze_script.HELD_NAME).unlink()
        self.wake()

    def wake(self) -> None:
        try:
            descriptor = os.open(self.fifo, os.O_WRONLY | os.O_NONBLOCK)
        except OSError:
            return  # nobody reads it yet, and will look when it does
        os.write(descriptor, b"\n")
        os.close(descriptor)

    def descendants(self) -> list[int]:
        assert self.process is not None
        found, parents = [], {self.process.pid}
        rest = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                try:
                    rest.append((int(entry.name), int((entry / "stat").read_text().rpartition(")")[2].split()[1])))
                except (FileNotFoundError, ProcessLookupError):
                    continue
        while more := [pid for pid, parent in rest if parent in parents and pid not in found]:
            found += more
            parents |= set(more)
        return found

    def application(self) -> list[int]:
        """The counting process and its child, as this namespace numbers them."""
        found = []
        for pid in self.descendants():
            try:
                words = Path(f"/proc/{pid}/cmdline").read_bytes()
            except (FileNotFoundError, ProcessLookupError):
                continue
            if words.startswith((sys.executable.encode(), b"sleep\x00600")):
                found.append(pid)
        return found

    def end(self) -> None:
        if self.process is not None:
            for pid in self.descendants():
                try:
                    os.kill(pid, signal.SIGKILL)
                except ProcessLookupError:
                    continue
            self.process.kill()
            self.process.communicate()


def namespaces() -> bool:
    done = subprocess.run(
        ["unshare", "--pid", "--fork", "--mount-proc", "true"], capture_output=True, check=False, timeout=20
    )
    return done.returncode == 0


@pytest.fixture(params=SHELLS, ids=lambda shell: shell[0].rpartition("/")[2])
def container(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Container]:
    shell: list[str] = request.param
    if shutil.which(shell[0]) is None:
        pytest.skip(f"no {shell[0]} here")
    if not shutil.which("unshare") or not namespaces():
        pytest.skip("no process namespace can be made here")
    found = Container(tmp_path, shell, "all")
    yield found
    found.end()


def test_all_processes_stop_and_the_same_processes_continue(container: Container) -> None:
    container.start()
    container.goes_on()
    processes = container.application()
    assert len(processes) == 2
    container.hold()
    within(lambda: all(state(pid) == "T" for pid in processes))
    stopped = container.written()
    time.sleep(0.2)
    assert container.written() == stopped, "nothing comes of a held one"
    container.release()
    container.goes_on()
    assert container.application() == processes, "nothing was begun anew"


def test_an_application_that_starts_while_it_is_held_waits(container: Container) -> None:
    (container.folder / freeze_script.HELD_NAME).touch()
    container.start(started=False)
    time.sleep(0.4)
    assert not container.application()
    container.release()
    container.goes_on()


def test_the_last_of_several_changes_counts(container: Container) -> None:
    container.start()
    container.goes_on()
    for _ in range(3):
        container.hold()
        container.release()
    container.goes_on()
    container.hold()
    within(lambda: all(state(pid) == "T" for pid in container.application()))


def test_a_held_application_can_be_terminated(container: Container) -> None:
    container.start()
    processes = container.application()
    container.hold()
    within(lambda: all(state(pid) == "T" for pid in processes))
    within(lambda: caught(container.descendants()[0]) & 1 << (signal.SIGUSR2 - 1))
    os.kill(container.descendants()[0], signal.SIGTERM)
    within(lambda: all(state(pid) in ("gone", "Z") for pid in processes))
    assert container.process is not None
    container.process.wait(25)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 7), (signal.SIGINT, 8)])
def test_signals_and_the_exit_code_are_forwarded(container: Container, number: signal.Signals, code: int) -> None:
    ending = f"""
import signal, sys, time
signal.signal({int(signal.SIGTERM)}, lambda *_: sys.exit(7))
def interrupted(*_): sys.exit(8)
signal.signal({int(signal.SIGINT)}, interrupted)
print("up", flush=True)
while True: time.sleep(0.05)
"""
    container.start(ending)
    first = container.descendants()[0]
    within(lambda: caught(first) & 1 << (signal.SIGUSR2 - 1))  # the last one that the script asks for
    os.kill(first, number)
    assert container.process is not None
    assert container.process.wait(25) == code


def test_a_command_that_ends_ends_the_container_with_its_exit_code(container: Container) -> None:
    container.start("import sys; print('up', flush=True); sys.exit(3)")
    assert container.process is not None
    assert container.process.wait(25) == 3


def test_without_the_fifo_the_script_replaces_itself_by_the_command(tmp_path: Path) -> None:
    container = Container(tmp_path, ["/bin/sh"], "own", fifo=False)
    container.start()
    try:
        assert container.process is not None
        assert Path(f"/proc/{container.process.pid}/cmdline").read_bytes().startswith(sys.executable.encode())
    finally:
        container.end()


def test_in_a_shared_process_namespace_only_own_control_groups_stop(tmp_path: Path) -> None:
    groups = own_group(tmp_path)
    if groups is None:
        pytest.skip("no control group can be made here")
    container = Container(tmp_path, [sys.executable, "-c", ENTERING, str(groups), "/bin/sh"], "own")
    try:
        container.start()
        container.goes_on()
        processes = container.application()
        assert len(processes) == 2
        container.hold()
        within(lambda: all(state(pid) == "T" for pid in processes))
        assert state(os.getpid()) != "T", "this process is in other ones"
        container.release()
        container.goes_on()
        assert container.application() == processes
    finally:
        container.end()
        within(lambda: removed(groups))


ENTERING = """
import os, sys
open(sys.argv[1] + "/cgroup.procs", "w").write(str(os.getpid()))
os.execv(sys.argv[2], sys.argv[2:])
"""


def own_group(tmp_path: Path) -> Path | None:
    """A control group to put a container's processes into, where this user may make one."""
    for root in (Path("/sys/fs/cgroup/pids"), Path("/sys/fs/cgroup")):
        if (root / "cgroup.procs").exists():
            found = root / f"understudy-{tmp_path.name}-{os.getpid()}"
            try:
                found.mkdir()
            except OSError:
                continue
            return found
    return None


def removed(group: Path) -> bool:
    try:
        group.rmdir()
    except OSError:
        return False
    return True


def test_an_empty_command_is_refused() -> None:
    with pytest.raises(ValueError, match="container drive: command is missing"):
        freeze_script.fenced_command("drive", [], ["--fast"], scope="all")


def test_the_script_has_nothing_that_the_kubelet_expands() -> None:
    assert "$(" not in freeze_script.FENCE_SCRIPT
    assert "$$" not in freeze_script.FENCE_SCRIPT

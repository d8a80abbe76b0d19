"""Control groups hold, freeze and end processes, in both of the kernel's versions of them."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from testcluster.local import cgroups, processes

pytestmark = [
    pytest.mark.local_only,
    pytest.mark.skipif(os.geteuid() != 0, reason="needs root"),
]
GROUP = f"understudy.test-{os.getpid()}"


def mounts(version: str) -> list[Path]:
    lines = [line.split() for line in Path("/proc/mounts").read_text().splitlines()]
    return [Path(mount) for _, mount, kind, *_ in lines if kind == version]


@pytest.fixture(params=["as the machine is", "version 2 alone"])
def trees(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The machine's trees; and the tree of version 2 alone, which hybrid machines have without controllers."""
    if request.param == "version 2 alone":
        second = mounts("cgroup2")
        if not second:
            pytest.skip("this kernel has no control groups of version 2 mounted")
        monkeypatch.setattr(cgroups, "_trees", lambda: ([], second[0]))
    yield
    cgroups.kill(GROUP)
    cgroups.remove(GROUP)


@pytest.fixture
def counting(trees: None, tmp_path: Path) -> Path:
    """A process in a group below the group, which adds to a file for as long as it runs."""
    cgroups.create(f"{GROUP}/below")
    log = tmp_path / "count"
    processes.start(f"{GROUP}/below", ["sh", "-c", "while :; do echo; sleep 0.02; done"], log)
    deadline = time.monotonic() + 10
    while not (log.exists() and log.stat().st_size):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return log


def grows(log: Path) -> bool:
    before = log.stat().st_size
    time.sleep(0.4)
    return log.stat().st_size > before


def test_a_process_is_found_in_the_groups_above_it(counting: Path) -> None:
    pid = processes.find(GROUP, "sh", "-c")
    assert pid is not None
    assert pid in cgroups.pids(GROUP)
    assert os.getpid() not in cgroups.pids(GROUP)


def test_a_frozen_control_group_stops_and_continues(counting: Path) -> None:
    assert grows(counting)
    cgroups.freeze(GROUP, True)
    assert cgroups.frozen(GROUP)
    time.sleep(0.1)
    assert not grows(counting)
    cgroups.freeze(GROUP, False)
    assert not cgroups.frozen(GROUP)
    assert grows(counting)


def test_a_frozen_control_group_can_be_terminated(counting: Path) -> None:
    cgroups.freeze(GROUP, True)
    cgroups.kill(GROUP)
    assert not cgroups.pids(GROUP)


def test_nothing_stays_of_a_group_that_was_removed(counting: Path) -> None:
    with pytest.raises(TimeoutError, match="cannot be removed; processes in it"):
        cgroups.remove(GROUP, timeout=0.3)
    cgroups.kill(GROUP)
    cgroups.remove(GROUP)
    assert not any((tree / GROUP).exists() for tree in [*mounts("cgroup"), *mounts("cgroup2")])


def test_a_group_that_is_not_there_is_no_error() -> None:
    assert cgroups.pids("understudy.nothing") == set()
    assert not cgroups.frozen("understudy.nothing")
    cgroups.freeze("understudy.nothing", True)
    cgroups.kill("understudy.nothing")
    cgroups.remove("understudy.nothing")

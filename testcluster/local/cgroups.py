"""Control groups as the register of the cluster's processes: those in its group belong to it, and no others.

Both versions are supported. Version 1 has a tree per controller, so every operation is done in each; version 2 has one
tree.
"""

import os
import signal
import time
from functools import cache
from pathlib import Path

_SKIPPED = ("perf_event", "net_cls", "net_prio", "rdma", "misc")


@cache
def _trees() -> tuple[list[Path], Path | None]:
    """Return the mount points of version 1 controllers, and that of version 2."""
    first: list[Path] = []
    second: Path | None = None
    for line in Path("/proc/mounts").read_text().splitlines():
        _, mount, kind, options, *_ = line.split()
        if kind == "cgroup" and not any(name in options.split(",") for name in _SKIPPED):
            first.append(Path(mount))
        elif kind == "cgroup2":
            second = Path(mount)
    return first, second


def _unified() -> bool:
    """Return whether version 2 has the controllers. On a hybrid machine it is mounted without controllers."""
    first, second = _trees()
    return second is not None and not any(
        (tree / "cpu.shares").exists() or (tree / "memory.limit_in_bytes").exists() for tree in first
    )


def _mounts() -> list[Path]:
    first, second = _trees()
    if _unified():
        assert second is not None
        return [second]
    return first


def create(group: str) -> None:
    """Make a group (a path below the root) with all its parents, with every controller enabled."""
    for tree in _mounts():
        path = tree
        for part in group.split("/"):
            if _unified():
                offered = (path / "cgroup.controllers").read_text().split()
                for controller in offered:
                    # One by one: a controller that cannot be delegated here (for example cpu beside real-time
                    # processes) would fail the whole write.
                    try:
                        (path / "cgroup.subtree_control").write_text(f"+{controller}")
                    except OSError:
                        continue
            path = path / part
            path.mkdir(exist_ok=True)
            if (path / "cpuset.cpus").exists() and not _unified():
                # A version 1 cpuset accepts no process before its processors and memory nodes are set.
                for name in ("cpuset.cpus", "cpuset.mems"):
                    if not (path / name).read_text().strip():
                        (path / name).write_text((path.parent / name).read_text())


def weigh(group: str, times: int) -> None:
    """Give a group this many times the usual weight for processors."""
    for tree in _mounts():
        for name, usual in (("cpu.shares", 1024), ("cpu.weight", 100)):
            if (tree / group / name).exists():
                (tree / group / name).write_text(str(usual * times))


def processors(group: str) -> Path | None:
    """Return the folder with a group's share of the processors; None unless that has a tree of its own (version 1)."""
    return next((tree / group for tree in _mounts() if (tree / group / "cpu.shares").exists()), None)


def join(group: str) -> None:
    """Move the calling process into a group. It runs between fork and exec, so it only opens and writes files."""
    me = str(os.getpid())
    for tree in _mounts():
        with open(tree / group / "cgroup.procs", "w") as procs:
            procs.write(me)


def _folders(group: str) -> list[Path]:
    """Return the folders of a group and of groups below it in every tree, the deepest first."""
    first, second = _trees()
    found = []
    for tree in [*first, *([second] if second else [])]:
        if (tree / group).is_dir():
            found += [Path(path) for path, _, _ in os.walk(tree / group, topdown=False)]
    return found


def pids(group: str) -> set[int]:
    """Return the processes in a group and in all groups below it."""
    found: set[int] = set()
    for path in _folders(group):
        try:
            found.update(int(line) for line in (path / "cgroup.procs").read_text().split())
        except OSError:
            continue
    # A process of a process-id namespace outside of ours has the id 0. None is expected, but killing 0 would kill this
    # process.
    return found - {0}


def freeze(group: str, frozen: bool) -> None:
    """Freeze every process of a group and of those below it, or let them continue.

    A missing group is no error.
    """
    for tree in _mounts():
        path = tree / group
        if (path / "freezer.state").exists():
            (path / "freezer.state").write_text("FROZEN" if frozen else "THAWED")
        elif _unified() and (path / "cgroup.freeze").exists():
            (path / "cgroup.freeze").write_text("1" if frozen else "0")


def frozen(group: str) -> bool:
    """Return whether a group is frozen."""
    for tree in _mounts():
        path = tree / group
        if (path / "freezer.state").exists():
            return (path / "freezer.state").read_text().strip() != "THAWED"
        if _unified() and (path / "cgroup.freeze").exists():
            return (path / "cgroup.freeze").read_text().strip() == "1"
    return False


def kill(group: str, timeout: float = 20) -> None:
    """Kill every process of a group and of those below it, and wait until all are gone.

    Raises:
        TimeoutError: some still exist after the given seconds.
    """
    freeze(group, False)
    deadline = time.monotonic() + timeout
    while left := pids(group):
        for pid in left:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        if time.monotonic() > deadline:
            raise TimeoutError(f"control group {group}: processes {sorted(left)} outlive SIGKILL by {timeout:g} s")
        time.sleep(0.05)


def remove(group: str, timeout: float = 5) -> None:
    """Remove a group and all groups below it, none of which may contain a process.

    Raises:
        TimeoutError: a folder is still busy after the given seconds.
    """
    deadline = time.monotonic() + timeout
    while folders := _folders(group):
        for path in folders:
            try:
                path.rmdir()
            except OSError:
                continue
        if time.monotonic() > deadline and _folders(group):
            raise TimeoutError(
                f"control group {group}: {_folders(group)[0]} cannot be removed; processes in it: {sorted(pids(group))}"
            )
        time.sleep(0.02)

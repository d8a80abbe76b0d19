"""Limits of the kernel that several nodes on one machine reach: raised for a cluster, put back with the last one."""

import json
from pathlib import Path

from testcluster import atomic
from testcluster.paths import cache
from testcluster.progress import Progress

# Every kubelet and container runtime watches some dozen folders, and the kernel counts them all as one user's. Most
# distributions allow 128; the kubelet ends with "too many open files" when there are no more.
_LIMITS = {"fs/inotify/max_user_instances": 1024, "fs/inotify/max_user_watches": 262144}


def _path(limit: str) -> Path:
    return Path("/proc/sys") / limit


def _former() -> Path:
    return cache() / "clusters" / "former-limits.json"


def ensure(progress: Progress) -> None:
    """Raises those limits that are too low, and remembers what they were."""
    for limit, wanted in _LIMITS.items():
        value = int(_path(limit).read_text())
        if value >= wanted:
            continue
        kept: dict[str, int] = json.loads(_former().read_text()) if _former().exists() else {}
        atomic.write(_former(), json.dumps({limit: value, **kept}) + "\n")
        try:
            _path(limit).write_text(str(wanted))
        except OSError as error:
            progress(f"{_path(limit)} is {value}, not {wanted} ({error}): nodes may fail with `too many open files`")


def restore() -> None:
    """Puts back what was raised, unless somebody changed it since."""
    if not _former().exists():
        return
    for limit, value in json.loads(_former().read_text()).items():
        if int(_path(limit).read_text()) == _LIMITS.get(limit):
            _path(limit).write_text(str(value))
    _former().unlink()

"""Kernel limits that several nodes on one machine reach. They are raised for a cluster, and restored after the last
one."""

import json
from pathlib import Path

from testcluster import atomic
from testcluster.paths import cache
from testcluster.progress import Progress

# Every kubelet and container runtime watches dozens of folders, and the kernel counts them all for one user. Most
# distributions allow 128. If there are no more, the kubelet ends with "too many open files".
_LIMITS = {"fs/inotify/max_user_instances": 1024, "fs/inotify/max_user_watches": 262144}


def _path(limit: str) -> Path:
    return Path("/proc/sys") / limit


def _former() -> Path:
    return cache() / "clusters" / "former-limits.json"


def ensure(progress: Progress) -> None:
    """Raise the limits that are too low, and save their former values."""
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
    """Restore the limits that were raised, unless somebody has changed them since."""
    if not _former().exists():
        return
    for limit, value in json.loads(_former().read_text()).items():
        if int(_path(limit).read_text()) == _LIMITS.get(limit):
            _path(limit).write_text(str(value))
    _former().unlink()

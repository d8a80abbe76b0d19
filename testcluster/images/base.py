"""A base image made from Debian packages, for machines that cannot reach a container registry."""

import hashlib
import os
import re
import shutil
import tempfile
from pathlib import Path

from testcluster import atomic, packages
from testcluster.paths import cache
from testcluster.progress import Progress
from testcluster.shell import run, run_logged

NAME = "localhost/understudy-base:dev"
_SUITE = "bookworm"
_PACKAGES = "python3,python3-venv,ca-certificates"
# Documentation, translations and package lists: no program that runs needs them, and they are more than half of the
# size.
_UNNEEDED = (
    "usr/share/doc",
    "usr/share/man",
    "usr/share/locale",
    "usr/share/info",
    "var/lib/apt/lists",
    "var/cache/apt",
    "var/cache/debconf",
    "var/log",
)


def key() -> str:
    """Return a hash over the inputs of the base image."""
    return hashlib.sha256("\n".join((_SUITE, _PACKAGES, *_UNNEEDED, os.uname().machine)).encode()).hexdigest()[:12]


def _mirror() -> str | None:
    """Return the mirror of this machine's own Debian packages; None for debootstrap's default."""
    if not packages.find("apt-get"):
        return None
    sites = run("apt-get", "indextargets", "--format", "$(ORIGIN)|$(SITE)|$(CODENAME)", check=False)
    for line in sites.splitlines():
        origin, site, codename = line.split("|", 2)
        if origin == "Debian" and codename == _SUITE and re.match(r"https?://", site):
            return site
    return None


def _proxy() -> dict[str, str]:
    """Return apt's proxy as the variable that debootstrap reads."""
    if not packages.find("apt-config"):
        return {}
    found = re.search(r'Acquire::http::Proxy "(.+)";', run("apt-config", "dump", "Acquire::http::Proxy", check=False))
    return {"http_proxy": found[1]} if found and "http_proxy" not in os.environ else {}


def archive(progress: Progress) -> Path:
    """Return the tar archive of the base image's files, and make it if it is not in the cache.

    Raises:
        CommandFailed, MissingPrograms: debootstrap is missing or failed.
    """
    destination = cache() / "images" / f"base-{key()}.tar"
    if destination.exists():
        return destination
    packages.ensure(
        {"debootstrap": "debootstrap", "/usr/share/keyrings/debian-archive-keyring.gpg": "debian-archive-keyring"},
        progress,
    )
    with progress.step("making a base image from Debian packages (about a minute, once)"):
        # The name is of this run alone, because debootstrap of an interrupted run may still be at work in its own
        # folder.
        root = Path(tempfile.mkdtemp(prefix="understudy-base-", dir=destination.parent))
        try:
            _install(root)
            with atomic.file(destination) as packed:
                run("tar", "--directory", root, "--sort=name", "--mtime=@0", "--numeric-owner", "-cf", packed, ".")
        finally:
            _remove(root)
        for left in destination.parent.glob("understudy-base-*"):
            _remove(left)
    return destination


def _install(root: Path) -> None:
    mirror = _mirror()
    command = ["debootstrap", "--variant=minbase", f"--include={_PACKAGES}", _SUITE, str(root)]
    run_logged(["nice", *command, *([mirror] if mirror else [])], cache() / "log" / "debootstrap.log", env=_proxy())
    root.chmod(0o755)
    for name in _UNNEEDED:
        for path in (root / name).glob("*"):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()


def _remove(root: Path) -> None:
    """Remove a system that was being installed, unless something is still mounted in it (debootstrap mounts /proc)."""
    for line in reversed(Path("/proc/self/mounts").read_text().splitlines()):
        mount = Path(line.split()[1])
        if root in mount.parents:
            run("umount", mount, check=False)
            if mount.is_mount():
                return
    shutil.rmtree(root, ignore_errors=True)

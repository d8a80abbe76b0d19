"""A base image made from Debian packages, for machines that can reach no container registry."""

import hashlib
import os
import re
import shutil
from pathlib import Path

from testcluster import packages
from testcluster.paths import cache
from testcluster.progress import Progress
from testcluster.shell import run, run_logged

NAME = "localhost/understudy-base:dev"
_SUITE = "bookworm"
_PACKAGES = "python3,python3-venv,ca-certificates"
# Documentation, translations and package lists: nothing that runs needs them, and they are more than half of the size.
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
    """A hash over what decides the base image."""
    return hashlib.sha256("\n".join((_SUITE, _PACKAGES, *_UNNEEDED, os.uname().machine)).encode()).hexdigest()[:12]


def _mirror() -> str | None:
    """Where this machine takes its own Debian packages from, or None for debootstrap's own default."""
    if not packages.find("apt-get"):
        return None
    sites = run("apt-get", "indextargets", "--format", "$(ORIGIN)|$(SITE)|$(CODENAME)", check=False)
    for line in sites.splitlines():
        origin, site, codename = line.split("|", 2)
        if origin == "Debian" and codename == _SUITE and re.match(r"https?://", site):
            return site
    return None


def _proxy() -> dict[str, str]:
    """apt's proxy as the variable that debootstrap reads."""
    if not packages.find("apt-config"):
        return {}
    found = re.search(r'Acquire::http::Proxy "(.+)";', run("apt-config", "dump", "Acquire::http::Proxy", check=False))
    return {"http_proxy": found[1]} if found and "http_proxy" not in os.environ else {}


def archive(progress: Progress) -> Path:
    """The base image's files as a tar archive, made unless it is in the cache.

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
    work = destination.with_suffix(".partial")
    root = work / "root"
    with progress.step("making a base image from Debian packages (about a minute, once)"):
        if (root / "proc").is_mount():
            # An interrupted debootstrap may have left it.
            run("umount", root / "proc")
        shutil.rmtree(work, ignore_errors=True)
        root.mkdir(parents=True)
        mirror = _mirror()
        command: list[str | Path] = [
            "debootstrap",
            "--variant=minbase",
            f"--include={_PACKAGES}",
            _SUITE,
            root,
            *([mirror] if mirror else []),
        ]
        run_logged(["nice", *command], cache() / "log" / "debootstrap.log", env=_proxy())
        for name in _UNNEEDED:
            for path in (root / name).glob("*"):
                shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        packed = work / "base.tar"
        run("tar", "--directory", root, "--sort=name", "--mtime=@0", "--numeric-owner", "-cf", packed, ".")
        packed.rename(destination)
        shutil.rmtree(work)
    return destination

"""Installs missing programs with the distribution's own package manager."""

import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from testcluster.paths import cache
from testcluster.progress import Progress
from testcluster.shell import run_logged

SBIN = "/usr/local/sbin:/usr/sbin:/sbin"


class MissingPrograms(RuntimeError):
    """Programs are missing and cannot be installed here."""


def find(program: str) -> str | None:
    """Return the path of a program; an absolute path is returned if it exists."""
    if program.startswith("/"):
        return program if Path(program).exists() else None
    return shutil.which(program, path=os.environ.get("PATH", "") + ":" + SBIN)


def ensure(programs: Mapping[str, str], progress: Progress) -> None:
    """Install the packages of programs that are missing.

    The check looks for programs, not for packages, so programs from elsewhere (for example Docker's containerd) are
    kept.

    Args:
        programs: the name of a program (or an absolute path), and the Debian package that brings it.

    Raises:
        MissingPrograms: apt-get is not there, this is not root, or the installation did not bring the program.
    """
    missing = {name: package for name, package in programs.items() if not find(name)}
    if not missing:
        return
    install(sorted(set(missing.values())), f"these programs are missing: {', '.join(sorted(missing))}", progress)
    still = sorted(name for name in missing if not find(name))
    if still:
        brought = " ".join(sorted(set(missing.values())))
        raise MissingPrograms(f"apt-get installed {brought}, and these are still missing: {', '.join(still)}")


def install(names: Sequence[str], why: str, progress: Progress) -> None:
    """Install Debian packages.

    Args:
        why: what is missing, for the message if this cannot be done.

    Raises:
        MissingPrograms: apt-get is not there, or this is not root.
        CommandFailed: apt-get failed.
    """
    if os.geteuid() != 0 or not find("apt-get"):
        raise MissingPrograms(f"{why}; on Debian, `apt-get install {' '.join(names)}` as root brings them")
    quiet = {"DEBIAN_FRONTEND": "noninteractive"}
    with progress.step(f"installing {' '.join(names)}"):
        log = cache() / "log" / "apt.log"
        run_logged(["apt-get", "update", "-q"], log, env=quiet)
        run_logged(["apt-get", "install", "-q", "-y", "--no-install-recommends", *names], log, env=quiet)

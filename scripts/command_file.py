"""The command `scripts/command`: builds the command as one file, which needs nothing but Python.

All packages of the command run as plain Python, except pydantic-core. A file is for one platform, and has the module of
pydantic-core for each version of Python. The packages have the versions and hashes of constraints.txt.

A file is a zip archive behind a line that names the interpreter, as the standard library's zipapp writes it, with two
members: the program that starts first (command_start.py), and an archive of the packages. So Python reads a short list
of members at each start, and the packages only at the first one.
"""

import argparse
import gzip
import hashlib
import io
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib import metadata
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

from testcluster.paths import REPOSITORY

sys.path.insert(0, str(REPOSITORY / "docker"))

import requirements

EXTRAS = ("completion", "osc")
"""The extras that the command in one file has. `bags` and `plots` are too large: numpy alone has 20 MB."""

COMPILED = "pydantic-core"
"""The one package that does not run as plain Python."""

FROM_SOURCE = ("antlr4-python3-runtime",)
"""Packages without wheels. They are plain Python."""

BUILD_ONLY = ("setuptools",)
"""Listed as needed by scenario-execution, of which only the parser is used."""

PYTHONS = ("3.11", "3.12", "3.13", "3.14")
NAME = "understudy"
MOST_BYTES = 15_000_000

_LICENCE = re.compile(
    r"\.dist-info/(METADATA|entry_points\.txt|(licenses/.*)?(LICEN[CS]E|COPYING|NOTICE|AUTHORS)[^/]*)$"
)
_TIME = (1980, 1, 1, 0, 0, 0)
"""Of all members, so that the same packages make the same file."""

Members = dict[str, bytes]


class Refused(RuntimeError):
    """The file cannot be built."""


@dataclass(frozen=True)
class Platform:
    """A platform, by the names of krew, of pip, and of Python.

    Attributes:
        name: such as `linux-amd64`.
        wheels: the tag of its wheels.
        machines: what Python calls its processor.
        suffix: how the names of compiled modules end, with {} for the digits of the version.
    """

    name: str
    wheels: str
    machines: tuple[str, ...]
    suffix: str


PLATFORMS = (
    Platform("linux-amd64", "manylinux_2_17_x86_64", ("x86_64",), ".cpython-{}-x86_64-linux-gnu.so"),
    Platform("linux-arm64", "manylinux_2_17_aarch64", ("aarch64",), ".cpython-{}-aarch64-linux-gnu.so"),
    Platform("darwin-amd64", "macosx_10_12_x86_64", ("x86_64",), ".cpython-{}-darwin.so"),
    Platform("darwin-arm64", "macosx_11_0_arm64", ("arm64",), ".cpython-{}-darwin.so"),
)


def pinned() -> dict[str, str]:
    """Return the pins of all packages of the file. Markers are left out: they name the platform of the scripts."""
    asked = requirements.requirements(REPOSITORY, list(EXTRAS))
    found = requirements.pins(asked.replace("\\\n    --hash", " \\\n    --hash"))
    return {
        name: re.sub(r"^(\S+?) *;.*? *\\\n", r"\1 \\\n", pin) for name, pin in found.items() if name not in BUILD_ONLY
    }


def version(pin: str) -> str:
    """Return the version in a pin."""
    found = re.match(r"[^=]+==([^\s\\]+)", pin)
    assert found
    return found[1]


def is_kept(name: str) -> bool:
    """Return whether a file of a package becomes a member: its modules, its licence, and what describes it to Python."""
    if re.search(r"(^|/)(__pycache__|tests?|bin)/|^\.\./", name):
        return False
    return name.endswith(".py") or bool(_LICENCE.search(name))


def own_package() -> Members:
    """Return the files of our package."""
    folder = REPOSITORY / "operator"
    files = sorted(file for file in (folder / NAME).rglob("*") if file.is_file() and "__pycache__" not in file.parts)
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def installed_packages() -> tuple[Members, Members]:
    """Return the plain files of the packages that are installed here, and the compiled module for this Python.

    Raises:
        Refused: another version is installed than constraints.txt has.
    """
    plain: Members = {}
    compiled: Members = {}
    for name, pin in pinned().items():
        package = metadata.distribution(name)
        if package.version != version(pin):
            raise Refused(f"{name} {package.version} is installed, and constraints.txt has {version(pin)}")
        for file in package.files or ():
            if is_kept(str(file)):
                plain[str(file)] = Path(str(package.locate_file(file))).read_bytes()
            elif name == COMPILED and str(file).endswith(EXTENSION_SUFFIXES[0]):
                compiled[str(file)] = Path(str(package.locate_file(file))).read_bytes()
    return plain, compiled


def downloaded_packages(platforms: Iterable[Platform], folder: Path) -> tuple[Members, dict[str, Members]]:
    """Fetch the packages with pip. Return their plain files, and the compiled modules by platform."""
    known = pinned()
    wheels = [name for name in known if name not in (*FROM_SOURCE, COMPILED)]
    # The plain files of a wheel are the same on each platform.
    _download(folder, "plain", [known[name] for name in wheels], PLATFORMS[0], PYTHONS[0])
    build = folder / "build.txt"
    build.write_text(requirements.requirements(REPOSITORY, [], build=True))
    _pip("install", "--require-hashes", "--requirement", build, "--target", folder / "tools")
    listed = folder / "source.txt"
    listed.write_text(_file([known[name] for name in FROM_SOURCE]))
    options = ["--no-deps", "--no-build-isolation", "--use-pep517", "--require-hashes", "--requirement", listed]
    _pip("wheel", *options, "--wheel-dir", folder / "plain", path=folder / "tools")
    compiled: dict[str, Members] = {}
    for platform in platforms:
        for python in PYTHONS:
            _download(folder, platform.name, [known[COMPILED]], platform, python)
        found = _members((folder / platform.name).glob("*.whl"), lambda name: name.endswith(".so"))
        compiled[platform.name] = found
    one = next((folder / next(iter(compiled))).glob("*.whl"))
    return _members([*(folder / "plain").glob("*.whl"), one], is_kept), compiled


def _download(folder: Path, name: str, pins: list[str], platform: Platform, python: str) -> None:
    listed = folder / f"{name}.txt"
    listed.write_text(_file(pins))
    digits = python.replace(".", "")
    kind = ["--platform", platform.wheels, "--python-version", python, "--implementation", "cp"]
    kind += ["--abi", f"cp{digits}", "--abi", "abi3", "--abi", "none"]
    options = ["--no-deps", "--only-binary", ":all:", "--require-hashes", "--requirement", listed]
    _pip("download", *options, *kind, "--dest", folder / name)


def _file(pins: Iterable[str]) -> str:
    return (
        "\n".join((requirements.HASHES, *(line for pin in pins for line in requirements.without_comments(pin)))) + "\n"
    )


def _pip(verb: str, *options: object, path: Path | None = None) -> None:
    environment = {**os.environ, "PYTHONPATH": str(path)} if path else None
    command = [sys.executable, "-m", "pip", verb, "--quiet", "--disable-pip-version-check", *map(str, options)]
    subprocess.run(command, check=True, env=environment)


def _members(wheels: Iterable[Path], kept: Callable[[str], object]) -> Members:
    found: Members = {}
    for wheel in sorted(wheels):
        with zipfile.ZipFile(wheel) as archive:
            found |= {name: archive.read(name) for name in archive.namelist() if kept(name)}
    return found


def archived(members: Mapping[str, bytes], method: int = zipfile.ZIP_DEFLATED, first: bytes = b"") -> bytes:
    """Return a zip archive of these members behind a first line, in order, without the time at which it was made."""
    out = io.BytesIO(first)
    out.seek(len(first))
    with zipfile.ZipFile(out, "w", method, compresslevel=9) as archive:
        for name in sorted(members):
            member = zipfile.ZipInfo(name, _TIME)
            member.compress_type = method
            member.external_attr = 0o644 << 16
            archive.writestr(member, members[name])
    return out.getvalue()


def file_of(platform: Platform, packages: Mapping[str, bytes]) -> bytes:
    """Return the file for a platform. Raises Refused if it is too large, or for no version of Python."""
    inner = archived(packages)
    suffixes = {python: platform.suffix.format(python.replace(".", "")) for python in PYTHONS}
    pythons = [one for one, suffix in suffixes.items() if any(name.endswith(suffix) for name in packages)]
    if not pythons:
        raise Refused(f"no compiled module of {COMPILED} is for {platform.name}")
    words = {
        "DIGEST": hashlib.sha256(inner).hexdigest(),
        "SUFFIXES": " ".join(suffixes[one] for one in pythons),
        "MACHINES": " ".join(platform.machines),
        "PLATFORM": platform.name,
        "PYTHONS": " ".join(pythons),
    }
    start = filled((REPOSITORY / "scripts" / "command_start.py").read_text(), words)
    # Stored, because the packages are compressed already.
    made = archived(
        {"__main__.py": start.encode(), "packages.zip": inner}, zipfile.ZIP_STORED, b"#!/usr/bin/env python3\n"
    )
    if len(made) >= MOST_BYTES:
        raise Refused(f"the file for {platform.name} has {len(made)} bytes; it may have {MOST_BYTES}")
    return made


def filled(text: str, words: Mapping[str, str]) -> str:
    """Return a text with these words in the places of @NAME@. Raises KeyError for a place without a word."""
    return re.sub(r"@([A-Z0-9_]+)@", lambda place: words[place[1]], text)


def for_krew(made: bytes) -> bytes:
    """Return the archive that krew unpacks: the file and the licence."""
    out = io.BytesIO()
    with gzip.GzipFile(fileobj=out, mode="wb", mtime=0) as packed, tarfile.open(fileobj=packed, mode="w") as archive:
        for name, content, mode in ((NAME, made, 0o755), ("LICENSE", (REPOSITORY / "LICENSE").read_bytes(), 0o644)):
            member = tarfile.TarInfo(name)
            member.size, member.mode = len(content), mode
            archive.addfile(member, io.BytesIO(content))
    return out.getvalue()


def manifest(folder: Path, repository: str) -> str:
    """Return the manifest for krew of the archives in a folder."""
    found = re.search(
        r'^__version__ = "(.*)"$', (REPOSITORY / "operator" / NAME / "__init__.py").read_text(), re.MULTILINE
    )
    assert found
    words = {"VERSION": found[1], "REPOSITORY": repository, "PYTHONS": f"{PYTHONS[0]} to {PYTHONS[-1]}"}
    for platform in PLATFORMS:
        content = (folder / f"{NAME}-{platform.name}.tar.gz").read_bytes()
        words[f"SHA256_{platform.name.upper().replace('-', '_')}"] = hashlib.sha256(content).hexdigest()
    text = (REPOSITORY / "scripts" / "krew.yaml").read_text()
    return filled(text.partition("\n")[2], words)


def here() -> Platform:
    """Return this machine's platform. Raises Refused if the command is not built for it."""
    found = [
        one
        for one in PLATFORMS
        if EXTENSION_SUFFIXES[0] == one.suffix.format(sysconfig.get_config_var("py_version_nodot"))
    ]
    machine = sysconfig.get_platform().rpartition("-")[2]
    for one in found:
        if machine in one.machines:
            return one
    raise Refused(f"there is no file for {sysconfig.get_platform()}")


def write(folder: Path, platform: Platform, packages: Mapping[str, bytes]) -> Path:
    """Write the file of a platform, and its archive for krew. Return the file."""
    made = file_of(platform, packages)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{NAME}-{platform.name}"
    file.write_bytes(made)
    file.chmod(0o755)
    (folder / f"{file.name}.tar.gz").write_bytes(for_krew(made))
    return file


def main() -> int:
    """Build the files."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, prog="scripts/command"
    )
    parser.add_argument("folder", type=Path, help="where the files are written")
    parser.add_argument("--platform", action="append", choices=[one.name for one in PLATFORMS], help="by default all")
    parser.add_argument(
        "--installed",
        action="store_true",
        help="from the packages of this Python, for it and this platform only; fetches nothing",
    )
    parser.add_argument(
        "--manifest", metavar="URL", help="write the manifest for krew too, for releases of this repository"
    )
    options = parser.parse_args()
    try:
        if options.installed:
            plain, compiled = installed_packages()
            built = {here().name: compiled}
        else:
            wanted = [one for one in PLATFORMS if one.name in (options.platform or [one.name])]
            with tempfile.TemporaryDirectory(prefix="understudy-command-") as folder:
                plain, built = downloaded_packages(wanted, Path(folder))
        for platform in PLATFORMS:
            if platform.name in built:
                file = write(options.folder, platform, {**plain, **built[platform.name], **own_package()})
                print(f"{file}  {file.stat().st_size / 1e6:.1f} MB")
        if options.manifest:
            (options.folder / f"{NAME}.yaml").write_text(manifest(options.folder, options.manifest.rstrip("/")))
    except (Refused, subprocess.CalledProcessError) as error:
        print(f"scripts/command: {error}", file=sys.stderr)
        return 1
    return 0

"""Prints what pip installs, as a file of requirements: exact versions, each with the hashes of its files.

    requirements.py FOLDER [EXTRA...]      what the project needs, and these extras of it
    requirements.py FOLDER --group GROUP   a dependency group of the project
    requirements.py FOLDER --build         what the project and packages without wheels are built with

FOLDER contains pyproject.toml and constraints.txt. The versions and hashes are those of constraints.txt, in which the
comments `# via` say which package needs which. pip installs nothing else from such a file.

A few packages have no wheel, so pip builds them. By default it would fetch the tools for that without hashes: install
the requirements of --build before, and give pip --no-build-isolation.
"""

import argparse
import re
import sys
import tomllib
from pathlib import Path

HASHES = "--require-hashes"
"""The option with which pip refuses a package that is not in the list, or does not have one of the hashes."""

_PIN = re.compile(r"^(?P<name>[a-z0-9-]+)==(?:.*\\\n)(?P<rest>(?:    .*\n)+)", re.MULTILINE)
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def normal(name: str) -> str:
    """Return the form of a package's name in which names are compared."""
    return re.sub(r"[-_.]+", "-", name).lower()


def named(requirement: str) -> str:
    """Return the name of the package that a requirement names."""
    found = _NAME.match(requirement)
    if not found:
        raise ValueError(f"{requirement!r} does not begin with the name of a package")
    return normal(found[0])


def pins(constraints: str) -> dict[str, str]:
    """Return the text of each package in constraints: its version, its hashes, and which packages need it."""
    return {found["name"]: found[0] for found in _PIN.finditer(constraints)}


def needed_by(pin: str) -> set[str]:
    """Return the packages that need a package, according to the comment below it."""
    comments = re.findall(r"^    # +(?:via +)?(\S+)", pin, re.MULTILINE)
    return {normal(name) for name in comments if name != "via"}


def closure(roots: set[str], known: dict[str, str]) -> list[str]:
    """Return the names of these packages and of all that they need, in order.

    Raises:
        ValueError: constraints.txt does not have one of the packages.
    """
    missing = roots - known.keys()
    if missing:
        raise ValueError(f"constraints.txt does not have {', '.join(sorted(missing))}: run scripts/constraints")
    needs: dict[str, set[str]] = {}
    for name, pin in known.items():
        for parent in needed_by(pin):
            needs.setdefault(parent, set()).add(name)
    found: set[str] = set()
    left = set(roots)
    while left:
        found |= left
        left = {name for parent in left for name in needs.get(parent, ())} - found
    return sorted(found)


def listed(described: dict, extras: list[str], group: str | None, build: bool) -> list[str]:
    """Return the requirements that a pyproject.toml lists."""
    if build:
        return described["build-system"]["requires"]
    if group:
        return described["dependency-groups"][group]
    project = described["project"]
    return [*project["dependencies"], *(text for extra in extras for text in project["optional-dependencies"][extra])]


def requirements(folder: Path, extras: list[str], group: str | None = None, build: bool = False) -> str:
    """Return the text of the file of requirements."""
    described = tomllib.loads((folder / "pyproject.toml").read_text())
    known = pins((folder / "constraints.txt").read_text())
    roots = {named(text) for text in listed(described, extras, group, build)}
    lines = [line for name in closure(roots, known) for line in without_comments(known[name])]
    return "\n".join((HASHES, *lines)) + "\n"


def without_comments(pin: str) -> list[str]:
    """Return the lines of a package in constraints without the packages that need it."""
    return [line for line in pin.splitlines() if not line.lstrip().startswith("#")]


def renewed(text: str, known: dict[str, str]) -> str:
    """Return a file of requirements with the present versions and hashes of the packages that it lists.

    The comment at its beginning stays.
    """
    comment = [line for line in text.splitlines() if line.startswith("#")]
    names = sorted({named(line) for line in text.splitlines() if _NAME.match(line)})
    return "\n".join((*comment, HASHES, *(line for name in names for line in without_comments(known[name])))) + "\n"


def main() -> int:
    """Print the requirements."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("extra", nargs="*")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--group")
    which.add_argument("--build", action="store_true")
    options = parser.parse_args()
    try:
        text = requirements(options.folder, options.extra, options.group, options.build)
    except (KeyError, ValueError) as error:
        print(f"requirements.py: {error}", file=sys.stderr)
        return 1
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())

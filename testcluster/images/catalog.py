"""The images of this repository: where each is described, and its inputs."""

import hashlib
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from testcluster.paths import REPOSITORY


@dataclass(frozen=True)
class Source:
    """The source of images: this repository as it is now, or as it was at a commit (`commits.lay_out`).

    Attributes:
        folder: contains a Dockerfile and the examples.
        tag: the tag of the images that are built from it.
    """

    folder: Path = REPOSITORY
    tag: str = "dev"


PRESENT = Source()

NAV2_ARCHIVE = "UNDERSTUDY_NAV2_ARCHIVE"
"""The variable that names an archive of Nav2, of which an image is made. Debian packages of Nav2 need an image of ROS."""

_NAV2 = Path("examples/navigation/nav2/image/archive.Dockerfile")


@dataclass(frozen=True)
class Image:
    """An image that is built from a Dockerfile here.

    Attributes:
        name: its full name with its tag; the `localhost/` in front keeps nodes from asking a registry for it.
        context: the folder that is sent to the builder, with the Dockerfile in it.
        target: the stage of the Dockerfile, None for the last one.
        inputs: the parts of the context that decide the result, relative to it.
        stages: stages that take long and seldom change; the builder keeps them.
        parent: the name of the image of this repository that it is built on, None if it is built on an operating system with Python.
        dockerfile: the name of the Dockerfile in the context.
        archive: a file that is no part of the repository; the Dockerfile finds it as `${ARCHIVE}` in the build context `archive`.
    """

    name: str
    context: Path
    target: str | None
    inputs: tuple[str, ...]
    stages: tuple[str, ...] = ()
    parent: str | None = None
    dockerfile: str = "Dockerfile"
    archive: Path | None = None

    @property
    def file(self) -> Path:
        """The Dockerfile."""
        return self.context / self.dockerfile

    @property
    def short(self) -> str:
        """The name without registry and tag, for messages and for the command line."""
        return self.name.removeprefix("localhost/understudy-").rpartition(":")[0]

    @property
    def tag(self) -> str:
        """The tag, which the images of one source share."""
        return self.name.rpartition(":")[2]

    def fingerprint(self, *extra: str) -> str:
        """Return a hash over all inputs of the image, and over ``extra`` inputs."""
        digest = hashlib.sha256("\n".join((self.name, self.target or "", *extra)).encode())
        for path in self._files():
            mode = "x" if path.stat().st_mode & 0o100 else "-"
            digest.update(f"\n{mode} {path.relative_to(self.context)}\n".encode() + path.read_bytes())
        if self.archive:
            digest.update(self.archive.read_bytes())
        return digest.hexdigest()

    def _files(self) -> Iterator[Path]:
        for name in self.inputs:
            top = self.context / name
            for path in sorted(top.rglob("*")) if top.is_dir() else [top]:
                if (
                    path.is_file()
                    and "__pycache__" not in path.parts
                    and not any(part.endswith(".egg-info") for part in path.parts)
                ):
                    yield path


_OWN = (
    "Dockerfile",
    ".dockerignore",
    "docker",
    "pyproject.toml",
    "constraints.txt",
    "README.md",
    "LICENSE",
    "operator",
)


_TARGETS = ("operator", "monitor", "tracker")
"""The stages of our own Dockerfile that are images."""


def _name(short: str, source: Source) -> str:
    return f"localhost/understudy-{short}:{source.tag}"


def _example(folder: str, source: Source) -> str:
    """Return the name of an example's image: that of its folder, unless one of our own images has it."""
    return _name(f"{folder}-example" if folder in _TARGETS else folder, source)


def images(source: Source = PRESENT) -> list[Image]:
    """Return all images of a source, in build order."""
    found = [
        Image(_name(target, source), source.folder, target, _OWN, ("tools", f"{target}-dependencies"))
        for target in _TARGETS
    ]
    found += [
        _of(dockerfile, _example(dockerfile.parent.name, source), source)
        for dockerfile in sorted((source.folder / "examples").glob("*/Dockerfile"))
    ]
    nav2 = source.folder / _NAV2
    if (archive := nav2_archive()) and nav2.exists():
        found.append(_of(nav2, _name("nav2", source), source, archive))
    return found


def _of(dockerfile: Path, name: str, source: Source, archive: Path | None = None) -> Image:
    parent = re.fullmatch(r"understudy/(.+)", base_argument(dockerfile))
    return Image(
        name,
        dockerfile.parent,
        None,
        (".",),
        # Only the result of these stages is copied.
        tuple(re.findall(r"^FROM \S+ AS (\S+)", dockerfile.read_text(), re.MULTILINE)),
        parent=_name(parent[1], source) if parent else None,
        dockerfile=dockerfile.name,
        archive=archive,
    )


def nav2_archive() -> Path | None:
    """Return the archive of a Nav2 that UNDERSTUDY_NAV2_ARCHIVE names; None without it.

    Raises:
        ValueError: there is no such file.
    """
    named = os.environ.get(NAV2_ARCHIVE)
    if not named:
        return None
    archive = Path(named).absolute()
    if not archive.is_file():
        raise ValueError(
            f"{NAV2_ARCHIVE}={named}: there is no such file; without the variable, no image of Nav2 is built"
        )
    return archive


def with_parents(wanted: Iterable[Image], source: Source = PRESENT) -> list[Image]:
    """Return the wanted images of a source and their parents, each after its parent."""
    known = {image.name: image for image in images(source)}
    ordered: dict[str, Image] = {}

    def visit(image: Image) -> None:
        if image.parent:
            visit(known[image.parent])
        ordered[image.name] = image

    for image in wanted:
        visit(image)
    return list(ordered.values())


def base_argument(dockerfile: Path) -> str:
    """Return the base image that a Dockerfile names as its default: `understudy/NAME` means an image of this
    repository.

    Raises:
        ValueError: the Dockerfile has no such line.
    """
    found = re.search(r"^ARG BASE_IMAGE=(\S+)", dockerfile.read_text(), re.MULTILINE)
    if not found:
        raise ValueError(f"{dockerfile}: no line `ARG BASE_IMAGE=...`; it decides what the image is built on")
    return found[1]

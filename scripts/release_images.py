"""The command `scripts/release`: builds the images of a release with Docker, and pushes them.

An image of a release is built from a commit, and on a base image that is named by its digest. Both are recorded in its
labels, so that anybody can find out later what the image consists of.
"""

import argparse
import json
import re
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from testcluster.images import pip
from testcluster.images.catalog import base_argument, images
from testcluster.paths import REPOSITORY
from testcluster.shell import CommandFailed, run

IMAGES = ("operator", "monitor", "tracker")
"""The targets of the Dockerfile."""

CHART = ("operator", "monitor")
"""Those that the chart's values name."""

_LABEL = "org.opencontainers.image."
_DIGEST = r"sha256:[0-9a-f]{64}"


class Refused(RuntimeError):
    """This cannot become a release."""


@dataclass(frozen=True)
class Base:
    """The base image of a release.

    Attributes:
        name: the name that the digest was found by.
        digest: what exactly it is, such as `sha256:4f53…`.
    """

    name: str
    digest: str

    @property
    def reference(self) -> str:
        """The name that no other image can have later."""
        return f"{self.name}@{self.digest}"


def given(reference: str) -> Base:
    """Return the base image that a user named.

    Raises:
        Refused: the name has no digest.
    """
    found = re.fullmatch(rf"([^@]+)@({_DIGEST})", reference)
    if not found:
        raise Refused(f"--base {reference}: a release needs the digest of its base image: NAME@sha256:DIGEST")
    return Base(found[1], found[2])


def digest(name: str) -> str:
    """Return the digest that the registry has for an image now.

    Raises:
        Refused: the registry cannot be reached, or does not say.
    """
    try:
        found = run("docker", "buildx", "imagetools", "inspect", name, "--format", "{{.Manifest.Digest}}").strip()
    except CommandFailed as error:
        raise Refused(f"the digest of {name} cannot be found out: {error}") from None
    if not re.fullmatch(_DIGEST, found):
        raise Refused(f"the digest of {name} cannot be found out: the registry said {found!r}")
    return found


def commit() -> str:
    """Return the commit of the files that the images are made of.

    Raises:
        Refused: they have changes.
    """
    git = ("git", "-C", REPOSITORY)
    inputs = {name for image in images() if image.short in IMAGES for name in image.inputs}
    changed = run(*git, "status", "--porcelain", "--", *sorted(inputs)).strip()
    if changed:
        raise Refused(f"a release is built from a commit, and these files have changes:\n{changed}")
    return run(*git, "rev-parse", "HEAD").strip()


def version() -> str:
    """Return the version of the package."""
    text = (REPOSITORY / "operator" / "understudy" / "__init__.py").read_text()
    found = re.search(r'^__version__ = "(.+)"$', text, re.MULTILINE)
    assert found
    return found[1]


def labels(base: Base, revision: str) -> dict[str, str]:
    """Return the labels of an image: the names that the OCI image specification gives them."""
    values = {"base.name": base.name, "base.digest": base.digest, "revision": revision, "version": version()}
    return {_LABEL + name: value for name, value in values.items()}


def build(target: str, name: str, base: Base, described: dict[str, str]) -> None:
    """Build an image, and check its labels.

    Raises:
        Refused: the image does not have them.
        CommandFailed: Docker failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        secrets = [f"id={secret},src={path}" for secret, path in pip.secrets(Path(folder)).items()]
        run(
            *("docker", "build", "--target", target, "--tag", name, "--build-arg", f"BASE_IMAGE={base.reference}"),
            *(word for secret in secrets for word in ("--secret", secret)),
            *(word for label, value in described.items() for word in ("--label", f"{label}={value}")),
            REPOSITORY,
            env={"DOCKER_BUILDKIT": "1"},
        )
    check(name, described)


def check(name: str, described: dict[str, str]) -> None:
    """Check that an image has these labels.

    Raises:
        Refused: it does not.
    """
    found = json.loads(run("docker", "image", "inspect", "--format", "{{json .Config.Labels}}", name)) or {}
    wrong = sorted(label for label, value in described.items() if found.get(label) != value)
    if wrong:
        raise Refused(f"{name} does not have the right {', '.join(wrong)}")


def push(name: str) -> str:
    """Push an image, and return the digest that it has in the registry.

    Raises:
        Refused: Docker did not print it.
        CommandFailed: Docker failed.
    """
    found = re.search(rf"digest: ({_DIGEST})", run("docker", "push", name))
    if not found:
        raise Refused(f"`docker push {name}` did not print the digest of the image")
    return found[1]


def values(registry: str, digests: Mapping[str, str]) -> str:
    """Return the chart's values that name images by their digests."""
    named = [f"  {target}: {{repository: {registry}/{target}, digest: {digests[target]!r}}}" for target in CHART]
    return "\n".join(["images:", *named]) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Run the command, and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="scripts/release",
        description="Builds the images of a release with Docker, pushes them, and prints the chart's values with their digests.",
    )
    parser.add_argument("registry", help="where the images are pushed to, such as registry.example/understudy")
    parser.add_argument(
        "--base",
        metavar="NAME@DIGEST",
        help="the base image; default: that of the Dockerfile, with the digest that its registry has for it now",
    )
    options = parser.parse_args(arguments)
    try:
        revision = commit()
        name = base_argument(REPOSITORY / "Dockerfile")
        base = given(options.base) if options.base else Base(name, digest(name))
        print(f"# built on {base.reference} from commit {revision}")
        names = {target: f"{options.registry}/{target}:{version()}" for target in IMAGES}
        for target in IMAGES:
            build(target, names[target], base, labels(base, revision))
        digests = {target: push(names[target]) for target in IMAGES}
    except (Refused, CommandFailed) as error:
        print(f"scripts/release: {error}", file=sys.stderr)
        return 1
    print(values(options.registry, digests), end="")
    print(f"# the tracker: {names['tracker']}@{digests['tracker']}")
    return 0

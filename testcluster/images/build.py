"""The command `scripts/images`: builds the images whose inputs changed, and loads them into a cluster."""

import argparse
import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from testcluster import atomic, locks
from testcluster.images import commits, engines, pip
from testcluster.images.catalog import NAV2_ARCHIVE, PRESENT, Image, images, with_parents
from testcluster.images.engines import Engine
from testcluster.paths import cache
from testcluster.progress import Progress
from testcluster.shell import CommandFailed


@dataclass
class _Built:
    """Records what was built from which inputs, so that nothing is built twice."""

    path: Path

    def of(self, engine: Engine, image: Image) -> dict[str, str]:
        return self._all().get(f"{engine.name} {image.name}", {})

    def record(self, engine: Engine, image: Image, fingerprint: str, identity: str) -> None:
        kept = {**self._all(), f"{engine.name} {image.name}": {"inputs": fingerprint, "image": identity}}
        atomic.write(self.path, json.dumps(kept, indent=1) + "\n")

    def _all(self) -> dict[str, dict[str, str]]:
        try:
            kept: dict[str, dict[str, str]] = json.loads(self.path.read_text())
        except (FileNotFoundError, json.JSONDecodeError):
            return {}
        return kept


def build(engine: Engine, wanted: list[Image], progress: Progress, force: bool = False) -> list[Image]:
    """Build the images whose inputs changed since their last build, and return them.

    Raises:
        CommandFailed: with the end of the build's output.
    """
    built = _Built(cache() / "images" / "built.json")
    system = engine.base_image(progress)
    secrets_folder = cache() / "images" / "secrets"
    changed = []
    try:
        secrets = pip.secrets(secrets_folder)
        for image in wanted:
            base = image.parent or system
            fingerprint = image.fingerprint(base, engine.identity(base) or "")
            former = built.of(engine, image)
            if not force and former.get("inputs") == fingerprint and former.get("image") == engine.identity(image.name):
                progress(f"{image.name}: nothing it is made of has changed")
                continue
            with progress.step(f"{image.name}: building with {engine.name} on {base}"):
                engine.build(image, base, secrets, cache() / "log" / f"image-{image.short}.log")
            identity = engine.identity(image.name)
            assert identity, f"{engine.name} built {image.name} and does not have it"
            built.record(engine, image, fingerprint, identity)
            changed.append(image)
    finally:
        # It may contain an index's password.
        shutil.rmtree(secrets_folder, ignore_errors=True)
    return changed


def main(arguments: list[str] | None = None) -> int:
    """Run the command, and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="scripts/images", description="Builds the images whose inputs changed, and loads them into a cluster."
    )
    try:
        here = ", ".join(image.short for image in images())
    except ValueError as error:
        parser.error(str(error))
    parser.add_argument(
        "image",
        nargs="*",
        help=f"images to build ({here}); default: all. {NAV2_ARCHIVE} names an archive of which nav2 is made",
    )
    parser.add_argument("--load", action="store_true", help="load them into the cluster")
    parser.add_argument("--force", action="store_true", help="build even if nothing has changed")
    parser.add_argument(
        "--engine", choices=["buildah", "docker"], help="the builder; default: Docker if it works, else buildah"
    )
    parser.add_argument(
        "--commit",
        metavar="COMMIT",
        help="build the images from this commit; their tag is the first twelve digits of its hash instead of dev",
    )
    from testcluster import cli

    cli.add_selection(parser)
    options = parser.parse_args(arguments)
    try:
        source = commits.lay_out(options.commit) if options.commit else PRESENT
    except commits.NoSuchCommit as error:
        parser.error(str(error))
    known = {image.short: image for image in images(source)}
    unknown = sorted(set(options.image) - set(known))
    if unknown:
        nav2 = f"; nav2 is made of an archive that {NAV2_ARCHIVE} names" if "nav2" in unknown else ""
        parser.error(f"no image {', '.join(unknown)}; there are {', '.join(known)}{nav2}")
    wanted = [known[name] for name in options.image] or list(known.values())
    progress = Progress()
    try:
        provider = cli.select(options.provider, options.name, progress)
        engine = engines.choose(options.engine or provider.engine, progress)
        with locks.held("images", progress):
            build(engine, with_parents(wanted, source), progress, options.force)
        if options.load:
            provider.load_images([image.name for image in wanted])
    except (CommandFailed, RuntimeError, TimeoutError, ValueError) as error:
        print(f"scripts/images: {error}", file=sys.stderr)
        return 1
    return 0

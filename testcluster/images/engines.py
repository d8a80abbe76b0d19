"""The programs that build images: buildah (which needs no daemon) and Docker."""

import json
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path

from testcluster import packages
from testcluster.images import base
from testcluster.images.catalog import Image, base_argument
from testcluster.paths import REPOSITORY, cache
from testcluster.progress import Progress
from testcluster.shell import CommandFailed, run, run_logged, succeeds


def wanted_base() -> str:
    """Return the operating system with Python to build on: UNDERSTUDY_BASE_IMAGE, or the default of the project's
    Dockerfile."""
    return os.environ.get("UNDERSTUDY_BASE_IMAGE") or base_argument(REPOSITORY / "Dockerfile")


def _stage(name: str, image: Image) -> str:
    """Return the name that keeps a stage of an image in the builder's cache when the rest is cleared.

    It has the image's tag, so that stages of an earlier commit do not replace those of the present one.
    """
    return f"localhost/understudy-stage-{name}:{image.tag}"


def archive_options(image: Image) -> list[str]:
    """Return the options that give the build the image's archive, which both programs have."""
    if image.archive is None:
        return []
    return ["--build-context", f"archive={image.archive.parent}", "--build-arg", f"ARCHIVE={image.archive.name}"]


class Engine(ABC):
    """A program that builds images and keeps them by name."""

    name: str

    @abstractmethod
    def base_image(self, progress: Progress) -> str:
        """Return a base image that can be used here. Fetches or makes it if necessary."""

    @abstractmethod
    def build(self, image: Image, base_image: str, secrets: Mapping[str, Path], log: Path) -> None:
        """Build an image. Raises CommandFailed with the end of the log."""

    @abstractmethod
    def identity(self, name: str) -> str | None:
        """Return the content hash of an image's configuration (`sha256:...`); None if there is no image of that name."""

    @abstractmethod
    def export(self, name: str, archive: Path) -> None:
        """Write an image to a file in the format of `docker save`."""


class Buildah(Engine):
    """buildah as root, with a store of its own in the cache."""

    name = "buildah"

    def __init__(self, progress: Progress) -> None:
        packages.ensure({"buildah": "buildah", "runc": "runc"}, progress)
        self._store = cache() / "images" / "buildah"
        self._store.mkdir(parents=True, exist_ok=True)
        self._driver = self._choose_driver()

    def _command(self, *arguments: str | Path, driver: str | None = None) -> list[str | Path]:
        return [
            "buildah",
            "--root",
            self._store / "root",
            "--runroot",
            self._store / "run",
            "--storage-driver",
            driver or self._driver,
            *arguments,
        ]

    def _choose_driver(self) -> str:
        kept = self._store / "driver"
        if kept.exists():
            return kept.read_text().strip()
        # `overlay` is much faster and smaller, but cannot be mounted in some containers.
        driver = "overlay" if succeeds(*self._command("images", driver="overlay")) else "vfs"
        kept.write_text(driver + "\n")
        return driver

    def base_image(self, progress: Progress) -> str:
        wanted = wanted_base()
        made = f"{base.NAME.rpartition(':')[0]}:{base.key()}"
        # A base image that the user named is never replaced by another.
        named = "UNDERSTUDY_BASE_IMAGE" in os.environ
        for name in [wanted] if named else [made, wanted]:
            if self.identity(name):
                return name
        progress(f"fetching {wanted}")
        try:
            run(*self._command("pull", "--quiet", wanted), timeout=300)
            return wanted
        except CommandFailed as error:
            if named:
                raise
            progress(f"it cannot be fetched here: {(error.output.strip() or str(error)).splitlines()[-1].strip()}")
        archive = base.archive(progress)
        container = run(*self._command("from", "scratch")).strip()
        try:
            run(*self._command("add", container, archive, "/"))
            run(*self._command("config", "--cmd", "/bin/sh", container))
            run(*self._command("commit", "--quiet", container, made))
        finally:
            run(*self._command("rm", container), check=False)
        return made

    def build(self, image: Image, base_image: str, secrets: Mapping[str, Path], log: Path) -> None:
        bases = {"BASE_IMAGE": base_image, **self._stand_in(image)}
        self._bud(image, image.target, image.name, bases, secrets, log)
        for stage in image.stages:
            # All of the stage is in the builder's cache now.
            self._bud(image, stage, _stage(stage, image), bases, secrets, log.with_suffix(".stages.log"))
        # Images of earlier versions would pile up with every change.
        run(*self._command("rmi", "--prune"), check=False)

    def _stand_in(self, image: Image) -> dict[str, str]:
        """Return the build argument for the parent without its own code, if that exists and the Dockerfile accepts it.

        Images that are built on it need not be built again after every change of the code.
        """
        if not image.parent or "ARG DEPENDENCIES_IMAGE" not in image.file.read_text():
            return {}
        short = image.parent.removeprefix("localhost/understudy-").rpartition(":")[0]
        name = _stage(f"{short}-dependencies", image)
        return {"DEPENDENCIES_IMAGE": name} if self.identity(name) else {}

    def _bud(
        self,
        image: Image,
        target: str | None,
        name: str,
        arguments: Mapping[str, str],
        secrets: Mapping[str, Path],
        log: Path,
    ) -> None:
        run_logged(
            [
                "nice",
                *self._command("bud", "--isolation", "chroot", "--layers", "--pull-never"),
                *(["--target", target] if target else []),
                *(word for secret, path in secrets.items() for word in ("--secret", f"id={secret},src={path}")),
                *(word for key, value in arguments.items() for word in ("--build-arg", f"{key}={value}")),
                *archive_options(image),
                "--file",
                image.file,
                "--tag",
                name,
                image.context,
            ],
            log,
        )

    def identity(self, name: str) -> str | None:
        try:
            return "sha256:" + str(json.loads(run(*self._command("inspect", "--type", "image", name)))["FromImageID"])
        except CommandFailed:
            return None

    def export(self, name: str, archive: Path) -> None:
        archive.unlink(missing_ok=True)
        run(*self._command("push", "--quiet", name, f"docker-archive:{archive}:{name}"))


class Docker(Engine):
    """Docker with BuildKit."""

    name = "docker"

    def base_image(self, progress: Progress) -> str:
        return wanted_base()

    def build(self, image: Image, base_image: str, secrets: Mapping[str, Path], log: Path) -> None:
        run_logged(
            [
                "docker",
                "build",
                *(["--target", image.target] if image.target else []),
                *(word for name, path in secrets.items() for word in ("--secret", f"id={name},src={path}")),
                "--build-arg",
                f"BASE_IMAGE={base_image}",
                *archive_options(image),
                "--file",
                image.file,
                "--tag",
                image.name,
                image.context,
            ],
            log,
            env={"DOCKER_BUILDKIT": "1"},
        )

    def identity(self, name: str) -> str | None:
        try:
            return run("docker", "image", "inspect", "--format", "{{.Id}}", name).strip()
        except CommandFailed:
            return None

    def export(self, name: str, archive: Path) -> None:
        run("docker", "save", "--output", archive, name)


def docker_works() -> bool:
    """Return whether there is a Docker whose daemon answers."""
    return succeeds("docker", "version", "--format", "{{.Server.Version}}")


def choose(wanted: str | None, progress: Progress) -> Engine:
    """Return the engine of a name. The default is Docker if it works here, else buildah."""
    if wanted == "docker" or (wanted is None and docker_works()):
        return Docker()
    return Buildah(progress)

"""Stores images as layers, each only once, so that a node receives only the layers that it lacks.

A builder exports an image as one file with all its layers, most of which every earlier version had too. The store keeps
the layers side by side by their content hashes, and puts an archive for a node together from the layers that the node
lacks.
"""

import hashlib
import io
import json
import os
import tarfile
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from testcluster import atomic
from testcluster.paths import cache

_MANIFEST = "application/vnd.docker.distribution.manifest.v2+json"
_CONFIG = "application/vnd.docker.container.image.v1+json"
_LAYER = "application/vnd.docker.image.rootfs.diff.tar"


class NotAnImage(ValueError):
    """A file is not an archive in the format of `docker save`."""


@dataclass(frozen=True)
class Reference:
    """An image in the store.

    Attributes:
        digest: the content hash of its manifest, with `sha256:` in front.
        size: the length of its manifest in bytes.
        config: the content hash of its configuration, which builders call the image's id.
    """

    name: str
    digest: str
    size: int
    config: str


def _folder() -> Path:
    return cache() / "images" / "store"


def _blob(digest: str) -> Path:
    return _folder() / "blobs" / digest.removeprefix("sha256:")


def _reference_file(name: str) -> Path:
    return _folder() / "references" / (name.replace("/", "_") + ".json")


def _put(data: bytes) -> str:
    digest = "sha256:" + hashlib.sha256(data).hexdigest()
    if not _blob(digest).exists():
        atomic.write(_blob(digest), data)
    return digest


def _put_layer(archive: tarfile.TarFile, member: str, expected: str) -> None:
    """Copy a layer out of an image archive, unless the store has it, and check its hash."""
    path = _blob(expected)
    if path.exists():
        return
    source = archive.extractfile(member)
    if source is None:
        raise NotAnImage(f"layer {member} is not a file")
    with atomic.file(path) as partial:
        digest = hashlib.sha256()
        with partial.open("wb") as out:
            while chunk := source.read(1 << 20):
                digest.update(chunk)
                out.write(chunk)
        if f"sha256:{digest.hexdigest()}" != expected:
            raise NotAnImage(
                f"layer {member} has the hash sha256:{digest.hexdigest()}; the image's configuration says {expected}"
            )


def add(path: Path) -> list[Reference]:
    """Add the images of an archive to the store.

    Raises:
        NotAnImage: the file has another format, names no image, or its contents do not match.
    """
    try:
        with tarfile.open(path) as archive:
            try:
                listed = archive.extractfile("manifest.json")
            except KeyError:
                raise NotAnImage(
                    f"{path}: it has no manifest.json, so it is no archive in the format of `docker save`"
                ) from None
            assert listed is not None
            references = [_add(archive, entry, name) for entry in json.load(listed) for name in entry["RepoTags"] or ()]
    except tarfile.TarError as error:
        raise NotAnImage(f"{path}: {error}") from None
    if not references:
        raise NotAnImage(f"{path}: the images in it have no names; export them by name")
    return references


def _add(archive: tarfile.TarFile, entry: dict[str, object], name: str) -> Reference:
    file = archive.extractfile(str(entry["Config"]))
    assert file is not None
    config = file.read()
    members = entry["Layers"]
    assert isinstance(members, list)
    digests = json.loads(config)["rootfs"]["diff_ids"]
    for member, digest in zip(members, digests, strict=True):
        _put_layer(archive, member, digest)
    configuration = _put(config)
    manifest = json.dumps(
        {
            "schemaVersion": 2,
            "mediaType": _MANIFEST,
            "config": {"mediaType": _CONFIG, "digest": configuration, "size": len(config)},
            "layers": [
                {"mediaType": _LAYER, "digest": digest, "size": _blob(digest).stat().st_size} for digest in digests
            ],
        }
    ).encode()
    reference = Reference(name, _put(manifest), len(manifest), configuration)
    atomic.write(_reference_file(name), json.dumps(asdict(reference)) + "\n")
    return reference


def references() -> list[Reference]:
    """Return all images in the store."""
    return [Reference(**json.loads(path.read_text())) for path in sorted((_folder() / "references").glob("*.json"))]


def get(name: str) -> Reference | None:
    """Return the image of a name; None if there is none."""
    return next((reference for reference in references() if reference.name == name), None)


def _parts(reference: Reference) -> Iterator[str]:
    manifest = json.loads(_blob(reference.digest).read_bytes())
    yield reference.digest
    yield manifest["config"]["digest"]
    yield from (layer["digest"] for layer in manifest["layers"])


def forget(reference: Reference) -> None:
    """Remove an image; the next `prune` removes its layers."""
    _reference_file(reference.name).unlink(missing_ok=True)


def prune() -> None:
    """Remove layers that no image of the store has any more."""
    wanted = {part.removeprefix("sha256:") for reference in references() for part in _parts(reference)}
    for path in (_folder() / "blobs").glob("*"):
        if path.name not in wanted and not atomic.is_partial(path):
            path.unlink()


@contextmanager
def archive(wanted: Collection[Reference], present: Collection[str]) -> Iterator[Path]:
    """Write an archive of some images in the OCI layout, without the parts that are present already.

    Args:
        present: content hashes (`sha256:...`) that the reader of the archive has.
    """
    folder = _folder() / "archives"
    folder.mkdir(parents=True, exist_ok=True)
    # Each call has its own file, because nodes that lack the same parts are loaded at the same time.
    handle, name = tempfile.mkstemp(suffix=".tar", dir=folder)
    os.close(handle)
    path = Path(name)
    index = {
        "schemaVersion": 2,
        "manifests": [
            {
                "mediaType": _MANIFEST,
                "digest": reference.digest,
                "size": reference.size,
                "annotations": {"io.containerd.image.name": reference.name},
            }
            for reference in wanted
        ],
    }
    parts = sorted({part for reference in wanted for part in _parts(reference)} - set(present))
    try:
        with tarfile.open(path, "w") as tar:
            for member, data in (("oci-layout", {"imageLayoutVersion": "1.0.0"}), ("index.json", index)):
                content = json.dumps(data).encode()
                entry = tarfile.TarInfo(member)
                entry.size = len(content)
                tar.addfile(entry, io.BytesIO(content))
            for part in parts:
                blob = _blob(part)
                entry = tarfile.TarInfo(f"blobs/sha256/{blob.name}")
                entry.size = blob.stat().st_size
                with blob.open("rb") as source:
                    tar.addfile(entry, source)
        yield path
    finally:
        path.unlink(missing_ok=True)

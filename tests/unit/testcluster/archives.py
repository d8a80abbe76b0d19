"""Image archives, for tests."""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
from pathlib import Path


def digest(data: bytes) -> str:
    return "sha256:" + hashlib.sha256(data).hexdigest()


def archive(
    path: Path, layers: list[bytes], name: str | None = "localhost/thing:dev", digests: list[str] | None = None
) -> Path:
    """An image as `docker save` writes it."""
    config = json.dumps(
        {"rootfs": {"type": "layers", "diff_ids": digests or [digest(layer) for layer in layers]}}
    ).encode()
    members = {f"{number}.tar": layer for number, layer in enumerate(layers)}
    listing = [{"Config": "config.json", "RepoTags": [name] if name else None, "Layers": list(members)}]
    with tarfile.open(path, "w") as tar:
        for member, data in {**members, "config.json": config, "manifest.json": json.dumps(listing).encode()}.items():
            entry = tarfile.TarInfo(member)
            entry.size = len(data)
            tar.addfile(entry, io.BytesIO(data))
    return path


def contents(path: Path) -> dict[str, bytes]:
    with tarfile.open(path) as tar:
        return {member.name: tar.extractfile(member).read() for member in tar}  # type: ignore[union-attr]


def blobs(path: Path) -> set[str]:
    return {"sha256:" + name.rpartition("/")[2] for name in contents(path) if name.startswith("blobs/")}

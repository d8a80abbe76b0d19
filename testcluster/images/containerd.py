"""Bringing images from the store to a containerd, whole or as far as it lacks them."""

from collections.abc import Sequence
from pathlib import Path

from testcluster.images import store
from testcluster.images.store import Reference
from testcluster.shell import run

_NAMESPACE = ("-n", "k8s.io")


def present(ctr: Sequence[str | Path]) -> dict[str, str]:
    """The images that a containerd has: name and content hash."""
    rows = [line.split() for line in run(*ctr, *_NAMESPACE, "images", "list").splitlines()[1:]]
    return {row[0]: row[2] for row in rows if len(row) > 2}


def load(ctr: Sequence[str | Path], wanted: Sequence[Reference]) -> list[Reference]:
    """Brings images to a containerd; returns those that it did not have.

    Args:
        ctr: the words that run containerd's client against it.
    """
    has = present(ctr)
    missing = [reference for reference in wanted if has.get(reference.name) != reference.digest]
    if missing:
        blobs = run(*ctr, *_NAMESPACE, "content", "list", "--quiet").split()
        with store.archive(missing, blobs) as archive:
            run(*ctr, *_NAMESPACE, "images", "import", archive)
    return missing

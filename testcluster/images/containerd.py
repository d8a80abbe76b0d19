"""Brings images from the store to a containerd, with only those parts that it lacks."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from testcluster.images import store
from testcluster.images.store import Reference
from testcluster.shell import CommandFailed, run

_NAMESPACE = ("-n", "k8s.io")

_FORMER = "-former"
"""Suffix of the name under which an image is kept while its successor is imported."""


def present(ctr: Sequence[str | Path]) -> dict[str, str]:
    """Return the images of a containerd: name and content hash."""
    rows = [line.split() for line in run(*ctr, *_NAMESPACE, "images", "list").splitlines()[1:]]
    return {row[0]: row[2] for row in rows if len(row) > 2}


def load(ctr: Sequence[str | Path], wanted: Sequence[Reference]) -> list[Reference]:
    """Bring images to a containerd, and return those that it did not have.

    Args:
        ctr: the command line of containerd's client for it.
    """
    has = present(ctr)
    missing = [reference for reference in wanted if has.get(reference.name) != reference.digest]
    if missing:
        with _kept(ctr, [reference.name for reference in missing if reference.name in has]):
            try:
                _import(ctr, missing, run(*ctr, *_NAMESPACE, "content", "list", "--quiet").split())
            except CommandFailed:
                # The garbage collection may have removed listed parts, for example after a start.
                _import(ctr, missing, [])
    return missing


def _import(ctr: Sequence[str | Path], wanted: Sequence[Reference], parts: Collection[str]) -> None:
    with store.archive(wanted, parts) as archive:
        run(*ctr, *_NAMESPACE, "images", "import", archive)


@contextmanager
def _kept(ctr: Sequence[str | Path], images: Sequence[str]) -> Iterator[None]:
    """Keep images under a second name. If the name of an image is given to another one, containerd would collect it at
    once, with the layers on which its successor is based.
    """
    for name in images:
        run(*ctr, *_NAMESPACE, "images", "tag", "--force", name, name + _FORMER)
    try:
        yield
    finally:
        for name in images:
            run(*ctr, *_NAMESPACE, "images", "remove", name + _FORMER)

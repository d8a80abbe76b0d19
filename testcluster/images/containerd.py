"""Bringing images from the store to a containerd, whole or as far as it lacks them."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from testcluster.images import store
from testcluster.images.store import Reference
from testcluster.shell import CommandFailed, run

_NAMESPACE = ("-n", "k8s.io")

_FORMER = "-former"
"""Suffix of the name that an image keeps while its successor is imported."""


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
        with _kept(ctr, [reference.name for reference in missing if reference.name in has]):
            try:
                _import(ctr, missing, run(*ctr, *_NAMESPACE, "content", "list", "--quiet").split())
            except CommandFailed:
                # What was listed may have been garbage that was collected since, as after a start.
                _import(ctr, missing, [])
    return missing


def _import(ctr: Sequence[str | Path], wanted: Sequence[Reference], parts: Collection[str]) -> None:
    with store.archive(wanted, parts) as archive:
        run(*ctr, *_NAMESPACE, "images", "import", archive)


@contextmanager
def _kept(ctr: Sequence[str | Path], images: Sequence[str]) -> Iterator[None]:
    """Keeps images under a second name: an image whose name is given to another is garbage at once, with the layers that
    its successor is just being built on.
    """
    for name in images:
        run(*ctr, *_NAMESPACE, "images", "tag", "--force", name, name + _FORMER)
    try:
        yield
    finally:
        for name in images:
            run(*ctr, *_NAMESPACE, "images", "remove", name + _FORMER)

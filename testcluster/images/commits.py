"""Lays out earlier commits of this repository beside it, so that their images are built like the present ones."""

from testcluster import atomic
from testcluster.images.catalog import Source
from testcluster.paths import REPOSITORY, cache
from testcluster.shell import CommandFailed, run

_DIGITS = 12
"""Length of a commit's hash in names."""


class NoSuchCommit(LookupError):
    """This repository does not have the commit: its name is wrong, or the repository was cloned without its history, or
    is no clone."""


def lay_out(commit: str) -> Source:
    """Return the files of a commit from the cache, in which each commit is laid out once.

    Args:
        commit: a hash, or another name that git accepts.

    Raises:
        NoSuchCommit: it is not in this repository.
    """
    git = ("git", "-C", REPOSITORY)
    try:
        full = run(*git, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{commit}^{{commit}}").strip()
    except CommandFailed:
        raise NoSuchCommit(
            f"commit {commit}: {REPOSITORY} doesn't have it; a clone without history gets it by git fetch --unshallow"
        ) from None
    short = full[:_DIGITS]
    folder = cache() / "images" / "commits" / short
    if not folder.exists():
        with atomic.folder(folder) as partial:
            archive = partial / "archive.tar"
            run(*git, "archive", "--format=tar", f"--output={archive}", full)
            run("tar", "-x", "-f", archive, "-C", partial)
            archive.unlink()
    return Source(folder, short)

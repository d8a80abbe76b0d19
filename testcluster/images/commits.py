"""Earlier states of this repository, laid out beside it, so that their images are built as those of the present are."""

from testcluster import atomic
from testcluster.images.catalog import Source
from testcluster.paths import REPOSITORY, cache
from testcluster.shell import CommandFailed, run

_DIGITS = 12
"""Of a commit's hash, in names."""


class NoSuchCommit(LookupError):
    """This repository doesn't have the commit: the name is wrong, or it was cloned without its history, or isn't a clone."""


def lay_out(commit: str) -> Source:
    """The files of a commit, in the cache, where each commit is laid out once.

    Args:
        commit: a hash, or whatever else git knows it by.

    Raises:
        NoSuchCommit: it isn't in this repository.
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

"""The files that pictures are drawn into."""

from __future__ import annotations

from pathlib import Path

from understudy.cli.common.errors import CommandError

FORMS = (".png", ".svg", ".pdf")


def usable(file: str) -> None:
    """Whether a picture can be drawn into this file. Raises CommandError before anything long is done for it."""
    path = Path(file)
    if path.suffix.lower() not in FORMS:
        raise CommandError(f"--plot: found {file!r:.200}; its name must end in {', '.join(FORMS)}")
    if not path.absolute().parent.is_dir():
        raise CommandError(f"--plot: there is no folder {path.parent}; make it, or give another file")
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise CommandError(
            f"--plot: pictures are drawn with matplotlib, which isn't here ({error}): install understudy with its extra plots: "
            "pip install '.[plots]' in its repository"
        ) from error

"""Checks of the file that ``--plot`` names."""

from __future__ import annotations

from pathlib import Path

from understudy.cli.common.errors import CommandError

FORMS = (".png", ".svg", ".pdf")


def check_plot_file(file: str) -> None:
    """Check that a plot can be written to this file, before the long computation. Raises CommandError."""
    path = Path(file)
    if path.suffix.lower() not in FORMS:
        raise CommandError(f"--plot: found {file!r:.200}; its name must end in {', '.join(FORMS)}")
    if not path.absolute().parent.is_dir():
        raise CommandError(f"--plot: the folder {path.parent} does not exist; create it, or give another file")
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise CommandError(
            f"--plot: plots need matplotlib, which is not installed ({error}); install understudy with the extra plots: "
            "pip install '.[plots]' in its repository"
        ) from error

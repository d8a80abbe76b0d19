"""Plots for ``--plot``: checks of the file that it names, their common style, and writing the file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from understudy.cli.common import palette
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


def axes(
    width: float, height: float, *, grid: str = "both", hidden: tuple[str, ...] = ("top", "right"), dpi: float = 150
) -> Any:
    """Return the axes of a new plot in the common style; the size is in inches."""
    from matplotlib.figure import Figure

    made: Any = Figure(figsize=(width, height), dpi=dpi, layout="constrained").subplots()
    made.grid(axis=grid, color=palette.GRID, linewidth=0.6)
    made.set_axisbelow(True)
    for side in hidden:
        made.spines[side].set_visible(False)
    return made


def save(axes: Any, file: str) -> None:
    """Write a plot. Raises CommandError."""
    try:
        axes.figure.savefig(file)
    except OSError as error:
        raise CommandError(f"--plot: {file} cannot be written: {error.strerror}; give another file") from error

"""The colours of all pictures, pages and dashboards, which people with any kind of colour vision tell apart.

They are those of Masataka Okabe and Kei Ito, "Color Universal Design" (2008), with greys. A page, a picture or a dashboard that
cannot import this module has the same ones, and a test compares them. Uses the standard library only, because the demo imports it too.
"""

from __future__ import annotations

ORANGE, SKY, GREEN, YELLOW = "#e69f00", "#56b4e9", "#009e73", "#f0e442"
BLUE, VERMILLION, PURPLE = "#0072b2", "#d55e00", "#cc79a7"

INK, FAINT, RULE, GRID, GREY = "#2b2b2b", "#555555", "#999999", "#dddddd", "#5c5c5c"
"""Of texts and marks, of notes, of lines beside the data, of the grid, and of what is unknown."""

PARTS = {"detection": ORANGE, "cluster": BLUE, "startup": GREEN, "reinitialization": PURPLE}
"""The four parts of a recovery time."""

STATES = {
    "Healthy": GREEN,
    "Degraded": YELLOW,
    "Recovering": ORANGE,
    "Failed": VERMILLION,
    "Starting": SKY,
    "Unknown": GREY,
}
"""The health of a robot, and the states of a leaf."""

SERIES = (BLUE, ORANGE, GREEN, PURPLE, VERMILLION, SKY, GREY)
"""Of lines and layers that only their legend names, in this order."""

CHOSEN, ALLOWED, LIMIT, LEFT_OUT = BLUE, GREEN, VERMILLION, RULE
"""What is recommended, what meets the requirements, a limit or a failure, and what was not chosen."""

ON_LIGHT = {"good": "#007a5a", "warn": "#8a6d00", "bad": "#8c1f00"}
ON_DARK = {"good": "#2fc49a", "warn": "#f0d442", "bad": "#ff7f4a"}
"""Of words on a page, light or dark: the same hues, with enough contrast to read them."""

TERMINAL = {"Healthy": "36", "Starting": "33", "Degraded": "33", "Recovering": "33", "Failed": "1;31"}
"""The codes of the terminal's own colours: cyan rather than green, which many cannot tell from red."""

TERMINAL_FAINT = "2"


def pale(colour: str, share: float = 0.35) -> str:
    """Return a colour on white, of which it has this share."""
    return "#" + "".join(f"{round(255 - (255 - int(colour[at : at + 2], 16)) * share):02x}" for at in (1, 3, 5))

"""The pages of the documentation for users."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
PAGES = [
    REPOSITORY / "README.md",
    REPOSITORY / "CONTRIBUTING.md",
    REPOSITORY / "charts" / "understudy" / "README.md",
    REPOSITORY / "testcluster" / "README.md",
    *sorted((REPOSITORY / "docs").rglob("*.md")),
    *sorted((REPOSITORY / "examples").rglob("README.md")),
]


def page_name(page: Path) -> str:
    """Return the name of a page in test ids."""
    return str(page.relative_to(REPOSITORY))


def typed(page: Path) -> Iterator[str]:
    """Yield each command line that a page shows for a shell; continued lines are joined."""
    for kind, text in re.findall(r"^ *```(sh|console)\n(.*?)```", page.read_text(), re.DOTALL | re.MULTILINE):
        for line in map(str.strip, text.replace("\\\n", " ").splitlines()):
            if kind == "sh":
                yield line
            elif line.startswith("$ "):
                yield line.removeprefix("$ ")

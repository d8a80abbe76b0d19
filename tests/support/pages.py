"""The pages that people read."""

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
    """What a test calls it."""
    return str(page.relative_to(REPOSITORY))


def typed(page: Path) -> Iterator[str]:
    """Each line that a page shows to be typed into a shell; one that goes on in the next is one."""
    for kind, text in re.findall(r"^ *```(sh|console)\n(.*?)```", page.read_text(), re.DOTALL | re.MULTILINE):
        for line in map(str.strip, text.replace("\\\n", " ").splitlines()):
            if kind == "sh":
                yield line
            elif line.startswith("$ "):
                yield line.removeprefix("$ ")

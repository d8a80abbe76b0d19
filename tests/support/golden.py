"""Compares the outputs that a page of the documentation shows with the real ones.

After an intended change of wording, ``UPDATE_GOLDEN=1`` makes the tests write the real outputs into the pages.
"""

from __future__ import annotations

import os
from pathlib import Path


def assert_shown(page: Path, shown: str, printed: str) -> None:
    """Assert that ``page`` shows what was printed, or update the page."""
    if os.environ.get("UPDATE_GOLDEN"):
        page.write_text(page.read_text().replace(shown, printed, 1))
    else:
        assert printed == shown

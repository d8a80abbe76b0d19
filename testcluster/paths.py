"""The folders for files.

Everything that is made at run time is in one cache folder, so that it is easy to find and to remove.
"""

import hashlib
import os
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent


def cache() -> Path:
    """Return the project's cache folder, and make it if it is missing."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    path = Path(base).resolve() / "understudy"
    path.mkdir(parents=True, exist_ok=True)
    return path


def mark() -> str:
    """Return a few characters that distinguish this cache from that of another user or checkout, for names that the
    machine shares."""
    return hashlib.sha256(str(cache()).encode()).hexdigest()[:6]

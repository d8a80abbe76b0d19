"""Where things are kept.

Everything made at run time lives under one cache folder, so that it is easy to find and to remove.
"""

import hashlib
import os
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent


def cache() -> Path:
    """The project's cache folder, made if missing."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    path = Path(base).resolve() / "understudy"
    path.mkdir(parents=True, exist_ok=True)
    return path


def mark() -> str:
    """A few characters that tell this cache from another user's or another checkout's, for names that the machine shares."""
    return hashlib.sha256(str(cache()).encode()).hexdigest()[:6]

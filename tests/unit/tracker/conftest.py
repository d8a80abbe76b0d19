"""What renders images, where it is."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import unavailable

SOURCES = Path(__file__).parents[3] / "examples/tracker/src"


@pytest.fixture(scope="session")
def rendering() -> None:
    """Whether images can be rendered here. Tried in a process of its own: what is missing may end it."""
    tried = subprocess.run(
        [sys.executable, "-c", "from tracker_scene import Scene; print(Scene().image().shape)"],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env={**os.environ, "PYTHONPATH": str(SOURCES)},
    )
    if "(480, 640, 3)" not in tried.stdout:
        unavailable(
            "nothing can be rendered here: scripts/test installs libegl1, libopengl0 and libgl1-mesa-dri\n"
            f"{tried.stderr[-2000:]}"
        )

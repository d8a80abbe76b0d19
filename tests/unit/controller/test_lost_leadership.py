"""An operator that loses leadership becomes a candidate again at once, as a new program in the same container."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

OPERATOR = """
import os, pathlib, sys
from understudy.controller.runtime import process

began = pathlib.Path(sys.argv[1])

async def run(*_):
    with began.open("a") as file:
        file.write(f"{os.getpid()}\\n")
    return process.LOST if len(began.read_text().split()) == 1 else 0

process.run = run
process.default_access = lambda: None
sys.exit(process.main(["--monitor-image", "none"]))
"""


def test_an_operator_that_loses_leadership_starts_again_in_the_same_container(tmp_path: Path) -> None:
    began = tmp_path / "began"
    done = subprocess.run([sys.executable, "-c", OPERATOR, str(began)], capture_output=True, text=True, timeout=60)
    first, second = began.read_text().split()
    assert (done.returncode, first == second) == (0, True), done.stderr

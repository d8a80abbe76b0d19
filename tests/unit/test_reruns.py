"""Tests on a cluster that fail are run once more, unless ``--reruns`` says otherwise."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("suite", ["cluster", "e2e"])
@pytest.mark.parametrize(("arguments", "count"), [([], 1), (["--reruns", "0"], 0), (["--reruns=2"], 2)])
def test_the_number_of_reruns_can_be_given(suite: str, arguments: list[str], count: int, tmp_path: Path) -> None:
    folder = tmp_path / "tests" / suite
    folder.mkdir(parents=True)
    (folder / "conftest.py").write_text(f"from tests.{suite}.conftest import pytest_collection_modifyitems\n")
    (folder / "test_it.py").write_text("def test_it():\n    assert False\n")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "--rootdir", str(tmp_path), "-p", "no:cacheprovider", *arguments, str(folder)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(REPOSITORY), *sys.path])},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    last = done.stdout.splitlines()[-1]
    assert (f"{count} rerun" in last) if count else ("rerun" not in last)

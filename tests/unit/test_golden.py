"""The golden files hold what the tests compare, and nothing else."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support import golden

TESTS = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("path", sorted(golden.FOLDER.iterdir()), ids=lambda path: path.stem)
def test_every_text_belongs_to_a_test(path: Path) -> None:
    tests = {
        f"{file.stem}::{name}"
        for file in TESTS.rglob("test_*.py")
        for name in re.findall(r"def (test_\w+)\(", file.read_text())
    }
    assert {name.partition("[")[0] for name in golden.texts(path)} <= tests, "remove what no test compares"

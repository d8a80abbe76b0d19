"""Compares texts of the product with the expected wording: in ``tests/golden``, and in pages of the documentation.

A test asserts on reasons, fields and numbers. The sentences around them are in one file per surface, such as
``tests/golden/explain.yaml``, under the test's file and name. After an intended change of wording, ``UPDATE_GOLDEN=1``
makes the tests write the product's present texts. A review reads the difference in these files.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterable
from pathlib import Path

import yaml

FOLDER = Path(__file__).resolve().parent.parent / "golden"

_test = ""
_compared: dict[str, int] = {}
"""How many texts of each surface the running test has compared so far."""


def begin(test: str) -> None:
    """Forget what the previous test has compared (``tests/conftest.py`` calls this before each test)."""
    global _test
    _test = test
    _compared.clear()


def assert_golden(surface: str, actual: str | Iterable[str], *facts: str) -> None:
    """Assert that the next text of this test is the one in the surface's file, or write it there.

    A text can be given as several lines. ``facts`` are what the text must contain whatever its wording: reasons,
    fields, names, numbers.
    """
    text = actual if isinstance(actual, str) else "\n".join(actual)
    for fact in facts:
        assert fact in text
    number = _compared.get(surface, 0)
    _compared[surface] = number + 1
    path = FOLDER / f"{surface}.yaml"
    if os.environ.get("UPDATE_GOLDEN"):
        _write(path, number, text)
        return
    kept = texts(path).get(_test, [])
    expected = kept[number] if number < len(kept) else None
    assert text == expected, f"not as in {path.name}; if this wording is intended: UPDATE_GOLDEN=1"


def texts(path: Path) -> dict[str, list[str]]:
    """Return the texts of a golden file by the name of their test."""
    return (yaml.load(path.read_text(), yaml.CSafeLoader) if path.exists() else None) or {}


def _write(path: Path, number: int, text: str) -> None:
    path.parent.mkdir(exist_ok=True)
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # Several test processes may write at the same time.
        kept = texts(path)
        kept[_test] = [*kept.get(_test, [])[:number], text]
        path.write_text(yaml.dump(kept, Dumper=_Dumper, allow_unicode=True, width=10**6))


class _Dumper(yaml.SafeDumper):
    """Writes a text of several lines as a block."""

    def represent_text(self, text: str) -> yaml.ScalarNode:
        return self.represent_scalar("tag:yaml.org,2002:str", text, style="|" if "\n" in text else None)


_Dumper.add_representer(str, _Dumper.represent_text)


def assert_shown(page: Path, shown: str, printed: str) -> None:
    """Assert that ``page`` shows what was printed, or update the page."""
    if os.environ.get("UPDATE_GOLDEN"):
        page.write_text(page.read_text().replace(shown, printed, 1))
    else:
        assert printed == shown

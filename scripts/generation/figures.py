"""Writes the figures of the benches into the pages, from ``bench/results``.

A page has three kinds of places for them:

- a figure in a sentence, followed by its source: ``10.2<!-- figure: monitor; CPU; p50 -->``. It keeps its number of decimals. There may be
  several (``1.7 / 2.8<!-- figure: monitor; CPU; p50 p95 -->``), in another unit (``p50 in s``), and a percentage
  (``navigation; executing: mean CPU of stacks; % above restart: mean CPU of stacks``, of the means).
- a table, between ``<!-- table NAME: written by … -->`` and ``<!-- end of table NAME -->`` (``scripts/generation/tables.py``).
- the result files of the figures in sentences, between ``SOURCES_BEGIN`` and ``SOURCES_END``. A page with such figures must have it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

RESULTS = Path("bench/results")

SOURCES_BEGIN = "<!-- result files: written by scripts/generate from bench/results -->"
SOURCES_END = "<!-- end of result files -->"

_NUMBER = r"-?\d[\d,]*(?:\.\d+)?"
_FIGURE = re.compile(
    rf"(?P<text>{_NUMBER}(?: / {_NUMBER})*)<!-- figure: (?P<file>[^;]+); (?P<name>[^;]+); (?P<of>[^;]+?) -->"
)
_ANY = "<!-- figure:"
_FACTORS = {("ms", "s"): 0.001, ("s", "ms"): 1000.0, ("m", "mm"): 1000.0}
_SEPARATED_FROM = 10_000


def pages(root: Path) -> Iterator[Path]:
    """Yield the pages in which there are figures, relative to ``root``."""
    for path in sorted([*root.glob("*.md"), *root.glob("docs/**/*.md"), *root.glob("examples/**/*.md")]):
        text = path.read_text()
        if _ANY in text or "<!-- table " in text or SOURCES_BEGIN in text:
            yield path.relative_to(root)


def in_sentences(page: str, results: Path) -> str:
    """Return the page with the figures of its sentences, and their files, as they are in the results.

    Raises ValueError if a figure is not in its file, or a marker cannot be read.
    """
    if page.count(_ANY) != len(found := list(_FIGURE.finditer(page))):
        read = {match.end() for match in found}
        ends = [page.index("-->", begin.start()) + 3 for begin in re.finditer(_ANY, page)]
        lost = next(page[page.rindex(_ANY, 0, end) : end] for end in ends if end not in read)
        raise ValueError(f"{lost}: write NUMBER<!-- figure: FILE; FIGURE; p50 -->")
    page = _FIGURE.sub(lambda match: _again(match, results), page)
    if not found:
        return page
    if SOURCES_BEGIN not in page or SOURCES_END not in page:
        raise ValueError(f"a page with figures must have the two lines {SOURCES_BEGIN!r} and {SOURCES_END!r}")
    files = sources(results, {match["file"] for match in found})
    before, _, rest = page.partition(SOURCES_BEGIN)
    return f"{before}{SOURCES_BEGIN}\n{files}\n{SOURCES_END}{rest.partition(SOURCES_END)[2]}"


def sources(results: Path, names: Iterable[str]) -> str:
    """Return the result files with their dates and commits, and whether these differ, as one line of Markdown."""
    runs = {name: read(results / f"{name}.json") for name in sorted(names)}
    listed = ", ".join(
        f"`{name}.json` ({run['date'][:10]}, commit {short(run['commit'])})" for name, run in runs.items() if run
    )
    mixed = len({run["commit"] for run in runs.values() if run}) > 1
    return f"From `bench/results`: {listed}.{' These files are of different commits.' if mixed else ''}"


def short(commit: str) -> str:
    """Return eight digits of a commit, and whether files differed from it."""
    digits, dash, dirty = commit.partition("-")
    return f"{digits[:8]}{dash}{dirty}"


def read(file: Path) -> Mapping[str, Any]:
    """Return a result file; empty if there is none."""
    found: Mapping[str, Any] = json.loads(file.read_text()) if file.is_file() else {}
    return found


def figure(result: Mapping[str, Any], name: str) -> Mapping[str, Any] | None:
    """Return a figure or baseline of a result file, with its unit and statistics."""
    found: Mapping[str, Any] | None = {**result.get("figures", {}), **result.get("baselines", {})}.get(name)
    return found


def statistics(figure: Mapping[str, Any], of: str) -> list[float]:
    """Return statistics of a figure, such as ``p50 p95`` or ``mean in s``; ``sum`` and
    ``min`` are those of all values."""
    names, _, unit = of.partition(" in ")
    factor = _FACTORS[figure["unit"], unit] if unit else 1
    known = {**figure, "sum": sum(figure["values"]), "min": min(figure["values"])}
    return [factor * known[name] for name in names.split()]


def written(value: float, decimals: int) -> str:
    """Return a number with so many decimals, or 0 if it is exactly that."""
    separator = "," if abs(value) >= _SEPARATED_FROM else ""
    return f"{value:{separator}.{decimals}f}" if value else "0"


def _again(match: re.Match[str], results: Path) -> str:
    """Return a figure of a sentence as it is in its result file, with as many decimals as it had, and its marker."""
    text, marker = match["text"], match[0].removeprefix(match["text"])
    result = read(results / f"{match['file']}.json")
    try:
        found = _figure(result, match["name"])
        if match["of"].startswith(above := "% above "):
            other = _figure(result, match["of"].removeprefix(above))
            values = [100 * (found["mean"] / other["mean"] - 1)]
        else:
            values = statistics(found, match["of"])
    except KeyError as error:
        raise ValueError(f"{marker}: {error} is not in {match['file']}.json") from None
    decimals = [len(number.partition(".")[2]) for number in text.split(" / ")]
    if len(decimals) != len(values):
        raise ValueError(f"{text}{marker}: {len(values)} numbers, with ' / ' between them, are needed")
    return " / ".join(map(written, values, decimals)) + marker


def _figure(result: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    found = figure(result, name)
    if found is None:
        raise KeyError(name)
    return found

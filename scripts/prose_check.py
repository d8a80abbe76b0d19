"""Extracts English text from the project's files, runs Vale on it, and prints the findings with file and line.

`scripts/prose` is the command. Vale reads Markdown itself. From other files this module extracts two kinds of text: comments and
docstrings, and messages, which are what users read: string literals in Python, descriptions in the CRDs and the chart.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import re
import subprocess
import sys
import tempfile
import tokenize
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

REPOSITORY = Path(__file__).resolve().parent.parent
READ = (
    *(
        "README.md",
        "CONTRIBUTING.md",
        "CHANGELOG.md",
        "docs",
        "charts/understudy",
        "crds",
        "operator",
        "scripts",
        "tests",
    ),
    *("bench", "examples", "demo", "testcluster"),
)
"""The files and folders that are read if no path is given."""

_GENERATED = ("charts/understudy/files/crds", "docs/reference")
"""Copies of texts that are checked at their source."""

_WITHOUT_USERS = ("tests", "bench", "testcluster", "scripts")
"""Folders whose messages only developers read: only comments and docstrings are checked."""

_CODE = re.compile(r"(`{1,2})[^`]+\1")
_ROLE = re.compile(r":[a-z]+:(?=`)")
_PROSE = re.compile(r"[A-Za-z][a-z'-]+,? [a-z'-]+,? [a-z'-]+")
"""Three words: shorter strings are names, keys and formats."""


@dataclass(frozen=True)
class Text:
    """Lines of English, each with its line number in the file."""

    kind: str
    """``comments`` or ``messages``."""
    lines: tuple[tuple[int, str], ...]


@dataclass(frozen=True)
class Finding:
    """One finding of Vale."""

    path: str
    line: int
    severity: str
    rule: str
    message: str


def main(arguments: list[str] | None = None) -> int:
    """Prints the findings and returns the exit status: 1 if there is an error."""
    parser = argparse.ArgumentParser(prog="scripts/prose", description="Checks the English of the project's files.")
    parser.add_argument("--warnings", action="store_true", help="show warnings and suggestions too")
    parser.add_argument("paths", nargs="*", metavar="PATH", help="files and folders; all of the project if absent")
    given = parser.parse_args(arguments)
    paths = [Path(path).resolve() for path in given.paths] or [REPOSITORY / path for path in READ]
    findings = check(files(path for path in paths if path.exists()))
    for one in findings:
        if given.warnings or one.severity == "error":
            print(f"{one.path}:{one.line}: {one.message} ({one.severity}, {one.rule})")
    return any(one.severity == "error" for one in findings)


def _in(path: str, folders: Iterable[str]) -> bool:
    return any(path == folder or path.startswith(f"{folder}/") for folder in folders)


def files(paths: Iterable[Path]) -> list[Path]:
    """The files under version control, and new ones, at and below the paths."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "--", *map(str, paths)],
        cwd=REPOSITORY, capture_output=True, text=True, check=True,
    )  # fmt: skip
    found = [REPOSITORY / line for line in listed.stdout.splitlines() if not _in(line, _GENERATED)]
    return [path for path in found if path.is_file()]


def check(paths: Iterable[Path]) -> list[Finding]:
    """What Vale finds in the files."""
    with tempfile.TemporaryDirectory() as folder:
        sources: dict[str, tuple[str, list[int]]] = {}
        for path in paths:
            relative = str(path.relative_to(REPOSITORY))
            for kind, lines in _by_kind(relative, path):
                name = f"{relative}.{kind}"
                (Path(folder) / name).parent.mkdir(parents=True, exist_ok=True)
                (Path(folder) / name).write_text("".join(f"{line}\n" for _, line in lines))
                sources[name] = (relative, [number for number, _ in lines])
        done = subprocess.run(
            ["vale", "--config", str(REPOSITORY / ".vale.ini"), "--output=JSON", "--no-exit", "."],
            cwd=folder, capture_output=True, text=True,
        )  # fmt: skip
    try:
        found: dict[str, list[dict[str, Any]]] = json.loads(done.stdout)
    except json.JSONDecodeError:
        raise SystemExit(f"vale: {done.stdout}{done.stderr}") from None
    result = []
    for name, alerts in found.items():
        relative, numbers = sources[name]
        for alert in alerts:
            line = numbers[min(alert["Line"], len(numbers)) - 1]
            result.append(Finding(relative, line, alert["Severity"], alert["Check"], alert["Message"]))
    return sorted(set(result), key=lambda one: (one.path, one.line, one.rule, one.message))


def _by_kind(relative: str, path: Path) -> Iterator[tuple[str, list[tuple[int, str]]]]:
    """Yield the texts of a file for Vale: the ending of a file name, and lines with their numbers in the original."""
    if path.suffix == ".md":
        yield "text.md", list(enumerate(path.read_text().splitlines(), 1))
        return
    for kind in ("comments",) if _in(relative, _WITHOUT_USERS) else ("comments", "messages"):
        lines: list[tuple[int, str]] = []
        for text in texts(relative, path):
            if text.kind == kind:
                # An empty line, so that no sentence continues in the next text.
                lines += [(number, _CODE.sub("Code", _ROLE.sub("", line)).strip()) for number, line in text.lines]
                lines.append((text.lines[-1][0], ""))
        if lines:
            yield f"{kind}.txt", lines


def texts(relative: str, path: Path) -> Iterator[Text]:
    """Yield the English texts in a file."""
    if path.suffix == ".py" or _first_line(path).endswith("python3"):
        yield from python_texts(path.read_text())
    elif relative.startswith(("crds/", "charts/understudy/files/")) and path.suffix == ".yaml":
        yield from yaml_texts(path.read_text())
    elif path.suffix == ".json" and relative.startswith("charts/"):
        yield from _matching("messages", path.read_text(), r'"description": "(.*)"')
    elif path.name == "NOTES.txt":
        yield from (
            Text("messages", ((number, line),)) for number, line in enumerate(path.read_text().splitlines(), 1) if line
        )
    elif path.suffix in (".yaml", ".yml", ".tpl") or _first_line(path).endswith(("sh", "bash")):
        yield from _matching("comments", path.read_text(), r"(?:^|\s)#+ (.*)|^\s*\{\{-? */\*(.*?)(?:\*/.*)?$")
        yield from _matching("messages", path.read_text(), r"^\s*(?:summary|description|message): (.*)")


def _first_line(path: Path) -> str:
    if path.suffix:
        return ""
    with path.open(errors="replace") as file:
        line = file.readline().strip()
    return line if line.startswith("#!") else ""


def _matching(kind: str, source: str, pattern: str) -> Iterator[Text]:
    """Yield the first group of each line that matches; consecutive lines are one text."""
    together: list[tuple[int, str]] = []
    for number, line in enumerate(source.splitlines(), 1):
        found = re.search(pattern, line)
        if found:
            together.append((number, next((group for group in found.groups() if group), "")))
        elif together:
            yield Text(kind, tuple(together))
            together = []
    if together:
        yield Text(kind, tuple(together))


def yaml_texts(source: str) -> Iterator[Text]:
    """Yield descriptions, summaries and messages in a YAML document: a CustomResourceDefinition, or alerts."""

    def walk(node: yaml.Node) -> Iterator[Text]:
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                if key.value in ("description", "message", "summary") and isinstance(value, yaml.ScalarNode):
                    yield Text("messages", ((value.start_mark.line + 1, value.value),))
                else:
                    yield from walk(value)
        elif isinstance(node, yaml.SequenceNode):
            for child in node.value:
                yield from walk(child)

    root = yaml.compose(source, Loader=yaml.CSafeLoader)
    if root is not None:
        yield from walk(root)


def python_texts(source: str) -> Iterator[Text]:
    """Yield comments, docstrings (also of attributes) and those string literals that are sentences."""
    yield from _comments(source)
    tree = ast.parse(source)
    seen: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            seen.add(id(node.value))
            lines = node.value.value.splitlines()
            yield Text("comments", tuple(enumerate(lines, node.lineno)) or ((node.lineno, ""),))
        elif isinstance(node, ast.JoinedStr):
            seen.update(id(part) for part in node.values)
            yield from _message(node.lineno, "".join(_written(part) for part in node.values))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in seen:
            yield from _message(node.lineno, node.value)


def _written(part: ast.expr) -> str:
    return part.value if isinstance(part, ast.Constant) and isinstance(part.value, str) else "X"


def _message(line: int, text: str) -> Iterator[Text]:
    if _PROSE.search(text) and not text.lstrip().startswith(("#!", "{", "<")):
        yield Text("messages", tuple((line, part) for part in text.splitlines()))


def _comments(source: str) -> Iterator[Text]:
    together: list[tuple[int, str]] = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type != tokenize.COMMENT or re.match(r"#!|# *(fmt|noqa|type|shellcheck|ruff|pragma)\b", token.string):
            continue
        number, line = token.start[0], token.string.lstrip("# ")
        if together and together[-1][0] + 1 != number:
            yield Text("comments", tuple(together))
            together = []
        together.append((number, line))
    if together:
        yield Text("comments", tuple(together))


if __name__ == "__main__":
    sys.exit(main())

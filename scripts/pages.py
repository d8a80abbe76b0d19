"""Builds the documentation as a site from the unchanged pages of the repository.

The pages link to each other, to examples and to sources by paths in the repository. So the pages are copied for MkDocs with the
same paths, together with all files that they link to. A link to a missing file is an error.
"""

from __future__ import annotations

import argparse
import os
import posixpath
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
START = ("README.md", "docs/README.md", "docs/site.css", "docs/iframe-worker.js")
LINK = re.compile(r"(\]\()([^)\s#]+)")
CODE = re.compile(r"`[^`]+`")


def main() -> int:
    """Build or show the site; the exit status is MkDocs's."""
    parser = argparse.ArgumentParser(prog="scripts/site", description=__doc__.partition("\n")[0])
    parser.add_argument(
        "folder", type=Path, nargs="?", default=REPOSITORY / "build" / "site", help="the folder to write the site to"
    )
    parser.add_argument(
        "--serve", action="store_true", help="serve the site at http://127.0.0.1:8000 instead, until Ctrl-C"
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as pages:
        lay_out(REPOSITORY, Path(pages))
        done = mkdocs(
            Path(pages), ["serve"] if arguments.serve else ["build", "--site-dir", str(arguments.folder.resolve())]
        )
    if done == 0 and not arguments.serve:
        print(f"the site is in {arguments.folder}: open {arguments.folder / 'index.html'}")
    return done


def mkdocs(pages: Path, command: list[str]) -> int:
    """Run MkDocs on the copied pages, and return its exit status."""
    return subprocess.run(
        [sys.executable, "-m", "mkdocs", *command, "--strict", "--config-file", str(REPOSITORY / "mkdocs.yml")],
        # The theme warns of a successor of MkDocs, which is not used here. MkDocs refuses to edit pages of no repository.
        env={
            **os.environ,
            "PAGES": str(pages),
            "EDIT_URI": "edit/main/" if os.environ.get("REPOSITORY_URL") else "",
            "NO_MKDOCS_2_WARNING": "1",
        },
    ).returncode


def lay_out(repository: Path, folder: Path) -> list[str]:
    """Copy the first pages and all files that links lead to from there, at the same paths; return these paths.

    A link to a folder leads to its README.md. If the folder has none, it leads to a list of its files, which is written here.
    """
    waiting, found = [*START], set[str]()
    while waiting:
        path = waiting.pop()
        if path in found:
            continue
        found.add(path)
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.endswith("/index.md"):
            text = _listing(repository / path.removesuffix("/index.md"))
        elif path.endswith(".md"):
            text = (repository / path).read_text()
        else:
            shutil.copyfile(repository / path, target)
            continue
        text = _with_bars(_with_pages(repository / posixpath.dirname(path), text))
        target.write_text(text)
        for _, link in LINK.findall(text):
            if "://" not in link:
                waiting.append(posixpath.normpath(posixpath.join(posixpath.dirname(path), link)))
    return sorted(found)


def _with_pages(base: Path, text: str) -> str:
    """Return the text of a page in the folder ``base``, with its links to folders replaced by links to pages."""

    def page(link: re.Match[str]) -> str:
        folder = base / link[2]
        if "://" in link[2] or not folder.is_dir():
            return link[0]
        return link[1] + posixpath.join(link[2], "README.md" if (folder / "README.md").is_file() else "index.md")

    return LINK.sub(page, text)


def _with_bars(text: str) -> str:
    """Return the text without the backslash before a bar in code in tables: other renderers need it, MkDocs shows it."""
    return "\n".join(
        CODE.sub(lambda code: code[0].replace(r"\|", "|"), line) if line.startswith("|") else line
        for line in text.split("\n")
    )


def _listing(folder: Path) -> str:
    files = sorted(file.name for file in folder.iterdir() if file.is_file())
    return "\n".join([f"# {folder.name}", "", *(f"- [{name}]({name})" for name in files), ""])


if __name__ == "__main__":
    sys.exit(main())

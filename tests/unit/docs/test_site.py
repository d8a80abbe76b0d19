"""The site: whatever pages link to is in it, and no link leads nowhere."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from scripts import pages

REPOSITORY = Path(__file__).parents[3]


def test_the_site_contains_every_page_without_broken_links(tmp_path: Path) -> None:
    found = pages.lay_out(REPOSITORY, tmp_path / "pages")
    every = {str(page.relative_to(REPOSITORY)) for page in (REPOSITORY / "docs").rglob("*.md")}
    assert every <= set(found)
    assert pages.mkdocs(tmp_path / "pages", ["build", "--site-dir", str(tmp_path / "site")]) == 0, (
        "see the warnings above"
    )
    assert "failurepolicy-what-you-say-spec" in (tmp_path / "site/docs/reference/api.html").read_text()


def test_search_works_from_files_and_no_page_loads_foreign_scripts(
    tmp_path: Path,
) -> None:
    site = tmp_path / "site"
    pages.lay_out(REPOSITORY, tmp_path / "pages")
    assert pages.mkdocs(tmp_path / "pages", ["build", "--quiet", "--site-dir", str(site)]) == 0
    for page in site.rglob("*.html"):
        assert not re.search(r"<(?:script|img|iframe)\b[^>]*\bsrc=.?(?:https?:)?//", page.read_text()), page
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("there is no Chromium")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", f"--user-data-dir={tmp_path}"]
    page = f"{(site / 'docs/sizing.html').as_uri()}?q=Erlang"
    document = subprocess.run(
        [browser, *options, "--virtual-time-budget=8000", "--dump-dom", page],
        env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"}, capture_output=True, text=True, timeout=120, check=True,
    ).stdout  # fmt: skip
    assert re.search(r'class="md-search-result__meta">\s*[1-9][0-9]* matching document', document)


def test_a_broken_link_is_an_error(tmp_path: Path) -> None:
    pages.lay_out(REPOSITORY, tmp_path / "pages")
    with (tmp_path / "pages/docs/trees.md").open("a") as page:
        page.write("\n[there is no such heading](reference/api.md#no-such-heading)\n")
    assert pages.mkdocs(tmp_path / "pages", ["build", "--site-dir", str(tmp_path / "site")]) == 1


def test_a_link_to_a_folder_resolves_to_its_page_or_to_a_list_of_its_files(tmp_path: Path) -> None:
    source = tmp_path / "repository"
    for path, text in {
        "README.md": "[all](docs/README.md) [one](one) [two](two#here)",
        "docs/README.md": "[up](../README.md)",
        "docs/site.css": "",
        "docs/iframe-worker.js": "",
        "one/README.md": "# One",
        "two/a.yaml": "a: 1",
    }.items():
        (source / path).parent.mkdir(parents=True, exist_ok=True)
        (source / path).write_text(text)
    found = pages.lay_out(source, tmp_path / "pages")
    assert found == [
        "README.md", "docs/README.md", "docs/iframe-worker.js", "docs/site.css", "one/README.md", "two/a.yaml", "two/index.md"
    ]  # fmt: skip
    assert (tmp_path / "pages/README.md").read_text() == (
        "[all](docs/README.md) [one](one/README.md) [two](two/index.md#here)"
    )
    assert (tmp_path / "pages/two/index.md").read_text() == "# two\n\n- [a.yaml](a.yaml)\n"


def test_an_escaped_bar_in_code_in_a_table_is_shown_without_backslash(tmp_path: Path) -> None:
    source = tmp_path / "source"
    (source / "docs").mkdir(parents=True)
    (source / "docs" / "README.md").write_text("")
    (source / "docs" / "site.css").write_text("")
    (source / "docs" / "iframe-worker.js").write_text("")
    text = "| a | b |\n| --- | --- |\n| `-o text\\|json` | one \\| two |\n\n`grep 'a\\|b'`\n"
    (source / "README.md").write_text(text)
    pages.lay_out(source, tmp_path / "pages")
    assert (tmp_path / "pages" / "README.md").read_text() == text.replace("text\\|json", "text|json")

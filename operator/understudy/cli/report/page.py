"""Builds the report as one self-contained HTML file. Pure."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping
from functools import cache
from importlib import resources

import understudy
from understudy.cli.common.text.wording import clock
from understudy.cli.report import sections
from understudy.cli.report.drawing.html_markup import Markup, element
from understudy.cli.report.recovery_records import Findings


def page(findings: Findings, sheets: Mapping[str, str], *, where: str, made: float) -> str:
    """Return the whole file. ``sheets`` are the CSV files to download from it, and ``where`` names the selected robots."""
    period = findings.period
    title = f"Recoveries of {where}"
    body = element(
        "main",
        element(
            "header",
            element("h1", title),
            element(
                "p",
                f"{clock(period.begin)} to {clock(period.end)}, from the records in the robots' status",
                class_="faint",
            ),
        ),
        *sections.known(findings),
        sections.tiles(findings),
        *sections.robots(findings),
        *sections.strategies(findings),
        *sections.over_time(findings),
        *sections.gaps(findings),
        *sections.reserved(findings),
        *sections.failures(findings),
        *sections.recoveries(findings),
        _downloads(sheets),
        element(
            "footer",
            f"Written by understudy {understudy.__version__} report at {clock(made)}. It loads nothing from a network.",
        ),
    )
    script, style = _read("sorting.js"), _read("page.css")
    head = element(
        "head",
        element("meta", charset="utf-8"),
        # If a text were ever interpreted as markup, nothing in it would run, and nothing would be sent.
        element(
            "meta",
            http_equiv="Content-Security-Policy",
            content="; ".join(
                ("default-src 'none'", f"script-src '{_hash(script)}'", f"style-src '{_hash(style)}'", "img-src data:")
            ),
        ),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", title),
        element("link", rel="icon", href="data:,"),
        element("style", Markup(style)),
    )
    return f"<!doctype html>\n{element('html', head, element('body', body, element('script', Markup(script))), lang='en')}\n"


def _downloads(sheets: Mapping[str, str]) -> Markup:
    links = [
        element(
            "li", element("a", name, download=name, href=f"data:text/csv;charset=utf-8;base64,{_base64(text.encode())}")
        )
        for name, text in sheets.items()
    ]
    return element(
        "section",
        element("h2", "Data"),
        element("p", "All data as CSV, contained in this file. Times are in seconds."),
        element("ul", *links),
        class_="downloads",
    )


@cache
def _read(name: str) -> str:
    return resources.files("understudy.cli.report").joinpath(name).read_text()


def _hash(text: str) -> str:
    return f"sha256-{_base64(hashlib.sha256(text.encode()).digest())}"


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")

"""HTML and SVG in which every text is escaped: what names, reasons and messages hold is chosen by others."""

from __future__ import annotations

import html

from understudy.cli.common.tree_text import plain


class Markup(str):
    """Text that is markup already."""

    __slots__ = ()


_VOID = frozenset({"br", "meta", "link", "input"})


def element(tag: str, *children: str | None, **attributes: str | float | None) -> Markup:
    """An element. Children that aren't :class:`Markup` are escaped; those and attributes that are None are left out.

    Of an attribute's name a trailing underscore is dropped (``class_``), and the others are dashes.
    """
    told = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{_escaped(_figure(value))}"'
        for name, value in attributes.items()
        if value is not None
    )
    inside = joined(*children)
    return Markup(f"<{tag}{told}>" if tag in _VOID else f"<{tag}{told}>{inside}</{tag}>")


def joined(*children: str | None) -> Markup:
    """One after the other."""
    return Markup("".join(c if isinstance(c, Markup) else _escaped(c) for c in children if c is not None))


def _figure(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:.6g}"


def _escaped(text: str) -> str:
    return html.escape(plain(text), quote=True)

"""Builds HTML and SVG and escapes every text, because names, reasons and messages come from others."""

from __future__ import annotations

import html

from understudy.api.plain_text import plain


class Markup(str):
    """A text that is markup already and is not escaped."""

    __slots__ = ()


_VOID = frozenset({"br", "meta", "link", "input"})


def element(tag: str, *children: str | None, **attributes: str | float | None) -> Markup:
    """Build an element. Children other than :class:`Markup` are escaped; children and attributes that are None are omitted.

    In names of attributes, a trailing underscore is dropped (``class_``), and others become dashes.
    """
    written = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{_escaped(_figure(value))}"'
        for name, value in attributes.items()
        if value is not None
    )
    inside = joined(*children)
    return Markup(f"<{tag}{written}>" if tag in _VOID else f"<{tag}{written}>{inside}</{tag}>")


def joined(*children: str | None) -> Markup:
    """Concatenate children."""
    return Markup("".join(c if isinstance(c, Markup) else _escaped(c) for c in children if c is not None))


def _figure(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:.6g}"


def _escaped(text: str) -> str:
    return html.escape(plain(text), quote=True)

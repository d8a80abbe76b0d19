"""Reads an HTML page as a browser does: elements, tables and text."""

from __future__ import annotations

from html.parser import HTMLParser

VOID = ("meta", "link", "br")


class Read(HTMLParser):
    """A page as a browser reads it."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.tables: dict[str, list[list[tuple[str, str | None]]]] = {}
        """By caption, the rows of cells: the shown text, and the sort value."""
        self.texts: list[str] = []
        self._open: list[str] = []
        self._caption = ""
        self.feed(text)
        self.close()
        assert self._open == [], "every element is closed"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)
        if tag == "caption":
            self._caption = ""
        if tag == "tr" and "tbody" in self._open:
            self.tables.setdefault(self._caption, []).append([])
        if tag in ("td", "th") and "tbody" in self._open:
            self.tables[self._caption][-1].append(("", dict(attrs).get("data-value")))

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)
        if self._open and self._open[-1] == "caption":
            self._caption += data
        if "tbody" in self._open and self._open[-1] in ("td", "th"):
            shown, value = self.tables[self._caption][-1][-1]
            self.tables[self._caption][-1][-1] = (shown + data, value)

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]

    def table(self, beginning: str) -> list[list[tuple[str, str | None]]]:
        (found,) = (rows for caption, rows in self.tables.items() if caption.startswith(beginning))
        return found

    def texts_with(self, *facts: str) -> list[str]:
        """Return the texts that contain one of these facts."""
        return [text for text in self.texts if any(fact in text for fact in facts)]

    @property
    def text(self) -> str:
        return " ".join(self.texts)


def value(cell: tuple[str, str | None]) -> float:
    assert cell[1] is not None, cell
    return float(cell[1])

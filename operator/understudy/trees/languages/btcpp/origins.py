"""The origin of a node that is an XML element."""

from __future__ import annotations

from understudy.trees.languages.btcpp.xml_elements import Element
from understudy.trees.languages.text.source_map import Origin


def origin(element: Element, uses: tuple[int, ...] = ()) -> Origin:
    """Return the origin of an element; ``uses`` are the lines of the <SubTree> nodes that use it."""
    identity = f' ID="{repr(element.attributes["ID"])[1:-1]:.60}"' if "ID" in element.attributes else ""
    return Origin(f"<{element.tag:.60}{identity}>", element.line, element.column, uses)

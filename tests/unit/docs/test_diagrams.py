"""The diagrams are drawn from what the code says, whole, and within their edges."""

from __future__ import annotations

from collections.abc import Callable
from xml.etree import ElementTree

import pytest

from scripts.generation import diagrams
from tests.support.pages import PAGES

SVG = "{http://www.w3.org/2000/svg}"
DRAWN = {
    "architecture.svg": diagrams.architecture,
    "failover-steps.svg": diagrams.failover,
    "pipeline.svg": diagrams.pipeline,
}


@pytest.mark.parametrize("draw", DRAWN.values(), ids=DRAWN)
def test_diagrams_stay_within_their_frame_and_have_a_text_alternative(draw: Callable[[], str]) -> None:
    root = ElementTree.fromstring(draw())
    width, height = map(float, root.attrib["viewBox"].split()[2:])
    for box in root.iter(f"{SVG}rect"):
        x, y, w, h = (float(box.get(name, 0)) for name in ("x", "y", "width", "height"))
        assert 0 <= x <= x + w <= width
        assert 0 <= y <= y + h <= height
    for words in root.iter(f"{SVG}text"):
        long = 0.6 * float(words.attrib["font-size"]) * len(words.text or "")
        start = float(words.attrib["x"]) - (long / 2 if words.attrib["text-anchor"] == "middle" else 0)
        assert -5 <= start <= start + long <= width + 5, words.text
        assert float(words.attrib["y"]) <= height
    for name in ("title", "desc"):
        assert len(root.findtext(f"{SVG}{name}") or "") > 20


@pytest.mark.parametrize("name", DRAWN)
def test_each_diagram_is_on_a_page(name: str) -> None:
    assert any(f"images/{name})" in page.read_text() for page in PAGES)


def test_every_arrow_head_is_defined() -> None:
    for draw in DRAWN.values():
        root = ElementTree.fromstring(draw())
        there = {f"url(#{head.attrib['id']})" for head in root.iter(f"{SVG}marker")}
        assert {line.attrib["marker-end"] for line in root.iter(f"{SVG}path") if "marker-end" in line.attrib} == there


def test_a_missing_module_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(diagrams.MODULES, "judge", ("monitor/judge/gone",))
    with pytest.raises(ValueError, match="monitor/judge/gone"):
        diagrams.pipeline()


def test_a_failure_passes_through_at_most_fifteen_modules() -> None:
    assert sum(len(modules) for stage, modules in diagrams.MODULES.items() if stage != "report") <= 15


def test_a_strategy_that_is_missing_in_the_diagram_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    # Not by delitem: it would come back at the end of the dict, and later diagrams of this process would have another order.
    monkeypatch.setattr(diagrams, "STEPS", {name: one for name, one in diagrams.STEPS.items() if name != "Initialized"})
    with pytest.raises(ValueError, match="others than the diagram's"):
        diagrams.failover()

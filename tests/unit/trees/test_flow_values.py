"""Values with fields that are written as texts."""

from __future__ import annotations

from typing import Any

import pytest

from understudy.trees.languages.text.flow_values import DEEPEST, LONGEST, structure_of


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{data: hello}", {"data": "hello"}),
        ('json:{"data": "hello"}', {"data": "hello"}),
        (' json: {"a": [1, 2.5, true, null, "x"]} ', {"a": [1, 2.5, True, None, "x"]}),
        ("{x: 1.0, y: 2.0, n: 3, on: 4, 5: 6}", {"x": 1.0, "y": 2.0, "n": 3, "on": 4, "5": 6}),
        ("{header: {frame_id: map, stamp: now}}", {"header": {"frame_id": "map", "stamp": "now"}}),
        ("[/a, /b]", ["/a", "/b"]),
        ("map_url: /maps/shop.yaml", {"map_url": "/maps/shop.yaml"}),
        ("2", 2),
        ("2.5", 2.5),
        ("[1e-5, -2E3, 1.5e+2]", [1e-5, -2000.0, 150.0]),
        ("true", True),
        ("fast", "fast"),
        ('"2"', "2"),
        ("", None),
        ("2026-11-22", "2026-11-22"),
    ],
)
def test_a_text_is_parsed_as_a_structure(text: str, expected: Any) -> None:
    found = structure_of(text)
    assert (type(found), found) == (type(expected), expected)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("json:{", "found '{', which is not JSON: Expecting property name enclosed in double quotes at character 2; write it as in"),
        ("{x: ", "which is not YAML: while parsing a flow node"),
        ('json:{"x": 1, "x": 2}', "'x' is given twice; remove one of them"),
        ("{x: 1, x: 2}", "'x' is given twice; remove one of them"),
        ("json:NaN", "found NaN; give a number"),
        ("json:[1e999]", "found inf; give a number"),
        ("[.inf]", "found .inf; give a number"),
        ("[&a 1, *a]", r"has an alias \(\*\) in it; write out what it stands for"),
        ("!!python/object:os.system x", "found the tag !!python/object:os.system; remove it"),
        ("{x: !!binary aGk=}", "found the tag !!binary; remove it"),
        ("{[1]: 2}", "has a key that is not a text; write a text before the ':'"),
        ("a: 1\n---\nb: 2", "which is not YAML: expected a single document"),
        ("\0", "found the character .* which YAML does not take; remove it"),
        ("x" * (LONGEST + 1), f"has {LONGEST + 1} characters; it may have {LONGEST}"),
        ("[" * 9000, "is nested too deeply"),
        ("json:" + "[" * 9000, "is nested too deeply"),
        ("[" * (DEEPEST + 2) + "]" * (DEEPEST + 2), f"is nested too deeply; it may be {DEEPEST} deep"),
    ],
)  # fmt: skip
def test_an_invalid_text_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        structure_of(text)

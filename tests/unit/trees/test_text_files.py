"""A health tree that is a text by itself means what it would in the policy, and its problems have lines and columns."""

from __future__ import annotations

import textwrap
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.api.base import LONGEST_TEXT
from understudy.trees.languages.text_files import load_text
from understudy.trees.source.positions import TextOffset
from understudy.trees.source.problems import TreeError

GOOD = """\
# what drives the robot
parallel:
- topic: {name: /cmd_vel, gap: 500ms}
- name: sensors
  parallel:
  - topic:
      name: /scan
      rate: "> 8 Hz"
"""


def load(text: str, form: str = "yaml", **more: Any) -> Any:
    return load_text(form, text, path="health", grace=30.0, **more)


def refused(text: str, form: str = "yaml", **more: Any) -> list[str]:
    with pytest.raises(TreeError) as caught:
        load(text, form, **more)
    return [str(problem) for problem in caught.value.problems]


def test_a_yaml_file_loads_as_the_tree_of_a_policy() -> None:
    assert load(GOOD) == yaml.safe_load(GOOD)
    assert load("topic: {name: /scan, gap: 5e-1s}".replace("5e-1s", "1s")) == {"topic": {"name": "/scan", "gap": "1s"}}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (GOOD.replace("500ms", "500 parsecs"), "health, line 3, column 27: parallel[0].topic.gap: '500 parsecs' is not"),
        (GOOD.replace('      rate: "> 8 Hz"\n', ""), "health, line 6, column 5: parallel[1].parallel[0].topic: neither gap"),
        (GOOD.replace("      name: /scan\n", ""), "health, line 6, column 5: parallel[1].parallel[0].topic.name: missing"),
        (GOOD.replace("- name: sensors\n  par", "- seq: 1\n  par"), "health, line 4, column 3: parallel[1].seq: unknown key"),
        ("topic: [", "health, line 1, column 9: this is not YAML"),
        ("topic:\n\tname: /scan", "health, line 2, column 1: this is not YAML"),
        ("a: 1\n---\nb: 2", "health, line 2, column 1: this is not YAML"),
        ("topic: \x07", "health, line 1, column 8: found the character '\\x07'"),
        ("", "health: there is nothing in it"),
        ("- 1", "health, line 1, column 1: found a list"),
        ("a: &a {b: 1}\nc: *a", "health, line 1, column 4: c: is an alias"),
        ("a: &a\n- *a", "health, line 1, column 4: a[0]: is an alias"),
        ("topic: {name: /scan, gap: 1s}\ntopic: {}", "health, line 2, column 1: topic: is given twice"),
        ("topic: !!python/object/apply:os.system [ls]", "health, line 1, column 8: topic: found the tag"),
        ("topic: {name: !!binary aGk=, gap: 1s}", "health, line 1, column 15: topic.name: found the tag !!binary"),
        ("1: {}", "health, line 1, column 1: has a key that is not a text"),
        ("<<: {topic: {}}", "health, line 1, column 1: has a key that is not a text"),
        ("topic: {gap: .inf}", "health, line 1, column 14: topic.gap: found .inf"),
        ("a: " + "[" * 200 + "]" * 200, "health, line 1, column 104: a" + "[0]" * 100 + ": is nested too deeply"),
        pytest.param("[" * 5000, "health: is nested too deeply", id="5000 brackets"),
        ("#" * (LONGEST_TEXT + 1), f"health: has {LONGEST_TEXT + 1} characters"),
    ],
)  # fmt: skip
def test_each_problem_is_reported_with_its_place(text: str, expected: str) -> None:
    assert refused(text)[0].startswith(expected)


def test_places_are_relative_to_the_file_that_contains_the_text() -> None:
    file = "data:\n  health.yaml: |\n" + textwrap.indent(GOOD.replace("500ms", "500 parsecs"), "    ")
    (problem,) = refused(GOOD.replace("500ms", "500 parsecs"), begins=TextOffset(2, 4))
    assert problem.startswith("health, line 5, column 31: ")
    assert file.splitlines()[4][30:].startswith("gap: 500 parsecs")


def test_problems_in_xml_have_their_own_places() -> None:
    text = (
        '<root BTCPP_format="4">\n<BehaviorTree ID="A">\n  <Topic topic="/scan" gap="1 moment"/></BehaviorTree></root>'
    )
    assert refused(text, "xml")[0].startswith("health, line 3, column 3: <Topic> gap: ")
    right = text.replace("1 moment", "1s")
    assert load(right, "xml") == right


@settings(deadline=None, max_examples=300)
@given(
    st.one_of(
        st.text(max_size=200),
        st.lists(st.sampled_from([*"{}[]:,-&*!|>'\"#\n \t", "topic", "parallel", "&a", "*a", "<<", "1s", "/x"]), max_size=60).map("".join),
    )
)  # fmt: skip
def test_any_text_loads_or_is_refused(text: str) -> None:
    try:
        load(text)
    except TreeError as error:
        paths = [problem.path for problem in error.problems]
    else:
        paths = ["health"]
    assert paths
    assert all(path.startswith("health") for path in paths)

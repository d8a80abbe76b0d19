"""One function loads a health tree in any of its languages, and summarizes what is wrong with it."""

from __future__ import annotations

from typing import Any

import pytest

from understudy.api.kinds.failure_policy import Monitoring
from understudy.trees.core.observations import RecordedObservations
from understudy.trees.languages.notations import load_health, load_monitoring
from understudy.trees.source.problems import Problem, TreeError

YAML: dict[str, Any] = {"topic": {"name": "/scan", "gap": "1s"}}
XML = '<root BTCPP_format="4"><BehaviorTree ID="A"><Topic topic="/scan" gap="1s"/></BehaviorTree></root>'
OSC = 'import osc.understudy\nscenario healthy:\n    do topic("/scan", gap: 1s)\n'


@pytest.mark.parametrize("written", [{"yaml": YAML}, {"xml": XML}, {"osc": OSC}])
def test_a_policy_in_each_language_is_loaded_with_its_grace(written: dict[str, Any]) -> None:
    tree = load_monitoring(Monitoring.model_validate({**written, "startupGrace": "7s"}))
    assert [topic.name for topic in tree.topics] == ["/scan"]
    tree.begin(0.0)
    states = [tree.evaluate(RecordedObservations({}), now=now, since=0.0).state for now in (6.9, 7.1)]
    assert states == ["Starting", "Failed"]


@pytest.mark.parametrize(
    ("form", "tree", "expected"),
    [
        ("yaml", {}, "spec.monitoring.yaml: the node is empty"),
        ("yaml", XML, "spec.monitoring.yaml: found '<root"),
        ("xml", YAML, "spec.monitoring.xml: found a mapping; give the text"),
        ("osc", YAML, "spec.monitoring.osc: found a mapping; give the text"),
        ("osc", XML, "spec.monitoring.osc, line 1, column 1: "),
        ("toml", YAML, "form: found 'toml'; known are yaml, xml, osc"),
    ],
)
def test_a_tree_in_another_language_is_refused(form: str, tree: Any, expected: str) -> None:
    with pytest.raises(TreeError) as caught:
        load_health(form, tree, grace=1.0)
    assert str(caught.value).startswith(expected)


def test_many_problems_are_summarized() -> None:
    error = TreeError([Problem(f"spec[{i}]", "x" * 100_000) for i in range(12)])
    assert error.in_short().endswith("; and 2 more")
    assert len(error.in_short()) < 32768 / 2, "a condition has room for more than this"

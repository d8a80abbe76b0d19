"""What docs/trees.md and docs/procedures.md show is so."""

import re
from pathlib import Path

import pytest
import yaml

from understudy.trees.btcpp.library import NODES, REFUSED
from understudy.trees.btcpp.markup import parse
from understudy.trees.btcpp.trees import load_xml
from understudy.trees.expressions import Expression
from understudy.trees.loading import KINDS, TreeError, load
from understudy.trees.procedures import COMPOSITES, CONDITIONS, DECORATORS, STEPS, load_check, load_procedure

PAGE = (Path(__file__).parents[3] / "docs" / "trees.md").read_text()


def test_the_example_loads_and_its_leaves_are_called_as_it_says():
    example, *_ = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    tree = load(yaml.safe_load(example))
    leaves = [node.name for node in tree.root.iterate() if not node.children]
    assert leaves == ["cmd_vel", "sensors/scan", "sensors/odom"]


def test_the_mistakes_are_named_as_it_says():
    shown, _ = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    tree = {"parallel": [{"topic": {"name": "/cmd_vel", "gap": 500}}, {"paralel": []}]}
    with pytest.raises(TreeError) as caught:
        load(tree)
    assert [str(problem) for problem in caught.value.problems] == shown.splitlines()


def test_the_mistakes_in_xml_are_named_as_it_says():
    _, shown = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    text = """<root BTCPP_format="4">
  <BehaviorTree ID="Healthy"><Parallel>
    <Parralel>
      <Topic topic="/scan" gap="1s"/>
    </Parralel>
    <Topic topic="/cmd_vel" gap="500"/>
  </Parallel></BehaviorTree>
</root>"""
    with pytest.raises(TreeError) as caught:
        load_xml(text)
    assert [str(problem) for problem in caught.value.problems] == shown.splitlines()


def test_every_node_and_port_of_xml_is_in_its_table():
    rows = [line.split("|") for line in PAGE.splitlines() if line.startswith("| `<")]
    for tag, node in NODES.items():
        ((_, _, _, ports, _),) = (row for row in rows if f"`<{tag}>`" in row[1])
        assert set(node.ports) <= set(re.findall(r"`([a-z_]+)`", ports))
    assert not NODES.keys() & REFUSED.keys()


def test_the_models_that_are_shown_are_those_of_the_nodes():
    (shown,) = re.findall(r"```xml\n(.*?)```", PAGE, re.DOTALL)
    tree = '<BehaviorTree ID="Healthy"><Topic topic="/scan" gap="1s"/></BehaviorTree>'
    load_xml(f'<root BTCPP_format="4">{tree}{shown}</root>')
    told = {
        model.attributes["ID"]: [port.attributes["name"] for port in model.children] for model in parse(shown).children
    }
    assert told == {
        tag: list(NODES[tag].ports)
        for tag in ("Topic", "Value", "Age", "Diagnostics", "Transform", "Publisher", "WhileTaskActive")
    }


PROCEDURES = (Path(__file__).parents[3] / "docs" / "procedures.md").read_text()


def test_the_procedure_that_is_shown_loads():
    example, leaf = re.findall(r"```yaml\n(.*?)```", PROCEDURES, re.DOTALL)
    shown = yaml.safe_load(example)["bringUp"]
    assert load_procedure(shown["yaml"], path="bringUp").restores_state
    assert load_procedure(yaml.safe_load(leaf), path="bringUp")


def test_every_node_of_a_procedure_is_on_the_page():
    told = set(re.findall(r"`([a-z_]+)`", PROCEDURES))
    assert {*COMPOSITES, *DECORATORS, *STEPS, *CONDITIONS} <= told


def test_the_mistakes_in_procedures_are_named_as_it_says():
    shown = re.findall(r"^spec\..*$", PROCEDURES, re.MULTILINE)
    tree = {"sequence": [{"resend_goals": {}}, {"set_lifecycle": {"node": "amcl", "state": "active"}}]}
    with pytest.raises(TreeError) as caught:
        load_procedure(tree, path="spec.bringUp.yaml")
    with pytest.raises(TreeError) as looked:
        load_check({"set_lifecycle": {}}, path="spec.readinessCheck.yaml")
    assert [str(problem) for problem in [*caught.value.problems, *looked.value.problems]] == shown


def test_the_leaves_that_are_shown_load():
    nodes = [yaml.safe_load(shown) for shown in re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)]
    kinds = [next(iter(node)) for node in nodes if "spec" not in node and load(node).topics]
    assert kinds == ["parallel", "value", "age", "diagnostics", "transform", "publisher", "parallel"]


def test_every_kind_of_node_is_on_the_page():
    for kind in KINDS:
        assert f"| `{kind}` |" in PAGE.replace("`parallel`, `sequence`", "`parallel`")


def test_every_form_of_a_condition_that_is_shown_can_be_read():
    (table,) = re.findall(r"\| fields \|(.*?)\n\n", PAGE, re.DOTALL)
    shown = [text for text in re.findall(r"`([^`]+)`", table) if re.search(r"[a-z]\w* (<|>)|any|all", text)]
    assert len(shown) == 3
    for text in shown:
        assert Expression.parse(text).text == text
    for text in re.findall(r"`(len\([^`]+|min\([^`]+|max\([^`]+|abs\([^`]+|sqrt\([^`]+|\w+\.[^`]+\])`", table):
        assert Expression.parse(f"{text} > 1")

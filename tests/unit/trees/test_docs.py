"""The examples in docs/trees.md and docs/procedures.md are correct."""

import re
from pathlib import Path

import pytest
import yaml

from tests.unit.trees.btcpp_texts import load_xml
from tests.unit.trees.messages import Figure
from tests.unit.trees.world import World
from understudy.trees.languages.btcpp import steps
from understudy.trees.languages.btcpp.library import NODES, REFUSED, tag_of
from understudy.trees.languages.btcpp.xml_elements import parse
from understudy.trees.languages.procedure_notations import compose
from understudy.trees.languages.short.health_loader import KINDS, TreeError, load
from understudy.trees.languages.short.procedure_loader import (
    COMPOSITES,
    CONDITIONS,
    DECORATORS,
    STEPS,
    load_check,
    load_procedure,
)
from understudy.trees.leaves.registry import LEAVES
from understudy.trees.source.expressions import Expression

PAGE = (Path(__file__).parents[3] / "docs" / "trees.md").read_text()


def test_the_example_loads_with_the_documented_leaf_names():
    example, *_ = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    tree = load(yaml.safe_load(example))
    leaves = [node.name for node in tree.root.iterate() if not node.children]
    assert leaves == ["cmd_vel", "sensors/scan", "sensors/odom"]


def test_the_documented_mistakes_are_reported():
    (shown,) = re.findall(r"```text\n(spec\.monitoring\.yaml.*?)```", PAGE, re.DOTALL)
    tree = {"parallel": [{"topic": {"name": "/cmd_vel", "gap": 500}}, {"paralel": []}]}
    with pytest.raises(TreeError) as caught:
        load(tree)
    assert [str(problem) for problem in caught.value.problems] == shown.splitlines()


def test_the_documented_mistakes_in_xml_are_reported():
    (shown,) = re.findall(r"```text\n(spec\.monitoring\.xml.*?)```", PAGE, re.DOTALL)
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


def test_the_table_lists_every_node_and_port_of_xml():
    rows = [line.split("|") for line in PAGE.splitlines() if line.startswith("| `<")]
    for tag, node in NODES.items():
        ((_, _, _, ports, _),) = (row for row in rows if f"`<{tag}>`" in row[1])
        assert set(node.ports) <= set(re.findall(r"`([a-z_]+)`", ports))
    assert not NODES.keys() & REFUSED.keys()


def test_the_documented_models_match_the_nodes():
    (shown,) = re.findall(r"```xml\n(.*?)```", PAGE, re.DOTALL)
    tree = '<BehaviorTree ID="Healthy"><Topic topic="/scan" gap="1s"/></BehaviorTree>'
    load_xml(f'<root BTCPP_format="4">{tree}{shown}</root>')
    documented = {
        model.attributes["ID"]: [port.attributes["name"] for port in model.children] for model in parse(shown).children
    }
    assert documented == {tag: list(NODES[tag].ports) for tag in (*map(tag_of, LEAVES), "WhileTaskActive")}


PROCEDURES = (Path(__file__).parents[3] / "docs" / "procedures.md").read_text()


def test_the_documented_procedure_loads():
    example, leaf = re.findall(r"```yaml\n(.*?)```", PROCEDURES, re.DOTALL)
    shown = yaml.safe_load(example)["bringUp"]
    assert load_procedure(shown["yaml"], path="bringUp").restores_state
    assert load_procedure(yaml.safe_load(leaf), path="bringUp")


def test_the_page_lists_every_node_of_a_procedure():
    documented = set(re.findall(r"`([a-z_]+)`", PROCEDURES))
    assert {*COMPOSITES, *DECORATORS, *STEPS, *CONDITIONS} <= documented


def test_the_documented_mistakes_in_procedures_are_reported():
    shown = re.findall(r"^spec\.\w+\.yaml.*$", PROCEDURES, re.MULTILINE)
    tree = {"sequence": [{"resend_goals": {}}, {"set_lifecycle": {"node": "amcl", "state": "active"}}]}
    with pytest.raises(TreeError) as caught:
        load_procedure(tree, path="spec.bringUp.yaml")
    with pytest.raises(TreeError) as looked:
        load_check({"set_lifecycle": {}}, path="spec.readinessCheck.yaml")
    assert [str(problem) for problem in [*caught.value.problems, *looked.value.problems]] == shown


def test_the_documented_procedure_is_the_same_in_three_languages():
    example, *_ = re.findall(r"```yaml\n(.*?)```", PROCEDURES, re.DOTALL)
    in_xml, *_ = re.findall(r"```xml\n(<root.*?)```", PROCEDURES, re.DOTALL)
    (in_osc,) = re.findall(r"```osc\n(.*?)```", PROCEDURES, re.DOTALL)
    expected = yaml.safe_load(example)["bringUp"]["yaml"]
    assert compose("xml", in_xml, check=False, path="bringUp").node == expected
    assert compose("osc", in_osc, check=False, path="bringUp").node == expected


def test_the_documented_mistake_in_an_xml_procedure_is_reported():
    (shown,) = re.findall(r"^spec\.bringUp\.xml.*$", PROCEDURES, re.MULTILINE)
    (in_xml, _) = re.findall(r"```xml\n(.*?)```", PROCEDURES, re.DOTALL)
    begins, becomes = (
        '<WaitFor topic="/scan" type="sensor_msgs/msg/LaserScan"/>',
        '<SetLifecycle node="amcl" state="active"/>',
    )
    text = in_xml.replace(begins, becomes)
    with pytest.raises(TreeError) as caught:
        compose("xml", text, check=False, path="spec.bringUp.xml")
    assert [str(problem) for problem in caught.value.problems] == [shown]


def test_the_documented_models_of_steps_match_the_nodes():
    (shown,) = re.findall(r"```xml\n(<TreeNodesModel>.*?)```", PROCEDURES, re.DOTALL)
    documented = {
        model.attributes["ID"]: [port.attributes["name"] for port in model.children] for model in parse(shown).children
    }
    own = {
        tag: node for tag, node in steps.PROCEDURES.nodes.items() if tag not in NODES and not tag.startswith("Async")
    }
    assert documented == {tag: list(node.ports) for tag, node in own.items()}
    tree = '<BehaviorTree ID="BringUp"><ResendGoals/></BehaviorTree>'
    assert compose("xml", f'<root BTCPP_format="4">{tree}{shown}</root>', check=False, path="bringUp")


def test_the_documented_leaves_load():
    shown = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    nodes = [node for text in shown for node in yaml.safe_load_all(text) if "apiVersion" not in node]
    kinds = [next(iter(node)) for node in nodes if load(node).topics]
    assert kinds == [
        "parallel",
        "value",
        "name",
        "age",
        "age",
        "diagnostics",
        "transform",
        "publisher",
        "node",
        "log",
        "progress",
        "lifecycle",
        "parameter",
        "parallel",
        "parallel",
    ]


def test_the_page_lists_every_kind_of_node():
    for kind in KINDS:
        assert f"| `{kind}` |" in PAGE.replace("`parallel`, `sequence`", "`parallel`")


def test_every_documented_form_of_a_condition_is_parsed():
    (table,) = re.findall(r"\| fields \|(.*?)\n\n", PAGE, re.DOTALL)
    shown = [text for text in re.findall(r"`([^`]+)`", table) if re.search(r"[a-z]\w* (<|>)|any|all", text)]
    assert len(shown) == 3
    for text in shown:
        assert Expression.parse(text).text == text
    for text in re.findall(r"`(len\([^`]+|min\([^`]+|max\([^`]+|abs\([^`]+|sqrt\([^`]+|\w+\.[^`]+\])`", table):
        assert Expression.parse(f"{text} > 1")


def test_the_documented_figure_of_merit_behaves_as_described():
    (shown,) = re.findall(r"```yaml\n(name: picks\n.*?)```", PAGE, re.DOTALL)
    world = World(yaml.safe_load(shown), grace=5.0)

    def hear(time: float, data: float) -> str:
        return world.hear("/picks_per_minute", time, Figure(data=data)).at(time).state

    assert [hear(10, 8.0), hear(20, 3.9), hear(49, 3.9)] == ["Healthy"] * 3
    assert world.deadline(49) == 50
    assert [hear(50, 3.9), hear(51, 4.1), hear(52, 4.9), hear(53, 12.0)] == ["Failed"] * 4
    assert [hear(54, 5.0), hear(55, 4.1)] == ["Healthy"] * 2

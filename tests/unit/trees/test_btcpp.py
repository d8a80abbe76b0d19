"""Health trees in BehaviorTree.CPP XML: they are the trees of the short form, and what is wrong with one is said with its place."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.trees.arbitrary_texts import garbled, loads_or_is_refused
from tests.unit.trees.btcpp_texts import BOTH, LEAF, ODOM_XML, SCAN_XML, files, load_xml, problems
from tests.unit.trees.btcpp_writer import Writer
from tests.unit.trees.replays import (
    POLICIES,
    SCRIPTS,
    TREES,
    Replay,
    file,
    named,
    numbers,
    shape,
)
from understudy.api.base import LONGEST_TEXT
from understudy.trees.languages.btcpp.library import NODES
from understudy.trees.languages.short.health_loader import load


def same(text: str, tree: dict[str, Any]) -> None:
    """That a text is the same tree as one of the short form."""
    found, expected = load_xml(text), load(tree)
    assert shape(found) == shape(expected)
    assert found.topics == expected.topics


# -- what is written, in the short form -----------------------------------------------------------------------------

SCAN = {"topic": {"name": "/scan", "gap": "1s"}}
ODOM = {"topic": {"name": "/odom", "rate": "9 to 11 Hz", "window": "3s", "type": "nav_msgs/msg/Odometry"}}


@pytest.mark.parametrize(
    ("text", "tree"),
    [
        (SCAN_XML, SCAN),
        (ODOM_XML, ODOM),
        ('<Topic name="lidar" topic="/scan" gap="1s"/>', {**SCAN, "name": "lidar"}),
        ('<Topic name="Topic" topic="/scan" gap="1s"/>', SCAN),
        ('<Topic topic="/a" rate="&lt; 20 Hz"/>', {"topic": {"name": "/a", "rate": "< 20 Hz"}}),
        ('<Topic topic="/a" rate="&gt;= 8 Hz"/>', {"topic": {"name": "/a", "rate": ">= 8 Hz"}}),
        (f"<Sequence>{BOTH}</Sequence>", {"sequence": [SCAN, ODOM]}),
        (f"<ReactiveSequence>{BOTH}</ReactiveSequence>", {"sequence": [SCAN, ODOM]}),
        (f"<Fallback>{BOTH}</Fallback>", {"selector": [SCAN, ODOM]}),
        (f"<ReactiveFallback>{BOTH}</ReactiveFallback>", {"selector": [SCAN, ODOM]}),
        (f'<Parallel name="sensors">{BOTH}</Parallel>', {"parallel": [SCAN, ODOM], "name": "sensors"}),
        (f'<Parallel success_count="2" failure_count="2">{BOTH}</Parallel>', {"parallel": [SCAN, ODOM]}),
        (f'<Parallel success_count="1" failure_count="-1">{BOTH}</Parallel>', {"selector": [SCAN, ODOM]}),
        (f"<ParallelAll>{BOTH}</ParallelAll>", {"parallel": [SCAN, ODOM]}),
        (f"<Inverter>{SCAN_XML}</Inverter>", {"inverter": SCAN}),
        (
            f'<WhileTaskActive action="/go" settle="3s" type="a/action/Go">{SCAN_XML}</WhileTaskActive>',
            {"while": {"task_active": {"action": "/go", "type": "a/action/Go"}}, "settle": "3s", "do": SCAN},
        ),
        (
            f'<WhileTaskActive action="/go">{SCAN_XML}</WhileTaskActive>',
            {"while": {"task_active": {"action": "/go"}}, "do": SCAN},
        ),
        ('<Control ID="Sequence"><Condition ID="Topic" topic="/scan" gap="1s"/></Control>', {"sequence": [SCAN]}),
        (f'<Decorator ID="Inverter">{SCAN_XML}</Decorator>', {"inverter": SCAN}),
        (
            f'<Inverter _description="why" _uid="7" _fullpath="a/b">{SCAN_XML}<!-- a comment --></Inverter>',
            {"inverter": SCAN},
        ),
    ],
)
def test_each_node_is_equivalent_to_one_of_the_short_form(text: str, tree: dict[str, Any]) -> None:
    same(file(text), tree)


def test_a_subtree_is_expanded_with_the_values_of_each_use() -> None:
    front, rear = (f'<SubTree ID="Lidar" name="{place}" scan="/{place}"/>' for place in ("front", "rear"))
    text = files(f"<Parallel>{front}{rear}</Parallel>", Lidar='<Topic topic="{scan}" gap="1s"/>')
    named = [
        {"parallel": [{"topic": {"name": f"/{place}", "gap": "1s"}}], "name": place} for place in ("front", "rear")
    ]
    same(text, {"parallel": named})
    assert [name for kind, name in shape(load_xml(text)) if kind == "TopicLeaf"] == ["front/front", "rear/rear"]


def test_a_subtree_without_a_name_adds_no_node() -> None:
    same(files('<Inverter><SubTree ID="Lidar"/></Inverter>', Lidar=SCAN_XML), {"inverter": SCAN})


def test_values_are_passed_to_subtrees_by_name_by_equal_name_and_by_autoremap() -> None:
    text = files(
        '<SubTree ID="A" topic="/scan" long="1s"/>',
        A='<Parallel><SubTree ID="B" topic="{=}" gap="{long}"/><SubTree ID="C" _autoremap="true"/></Parallel>',
        B='<Topic topic="{topic}" gap="{gap}"/>',
        C='<Topic name="again" topic="{ topic }" gap="{long}"/>',
    )
    same(text, {"parallel": [SCAN, {**SCAN, "name": "again"}]})


def test_explicit_attributes_take_precedence_over_autoremapped_values() -> None:
    text = files(
        '<SubTree ID="A" topic="/other"/>',
        A='<SubTree ID="B" _autoremap="1" topic="/scan"/>',
        B='<Topic topic="{topic}" gap="1s"/>',
    )
    same(text, SCAN)


def test_defaults_of_a_model_apply_to_omitted_ports() -> None:
    model = '<TreeNodesModel><SubTree ID="A"><input_port name="topic"/><input_port name="gap" default="1s"/></SubTree></TreeNodesModel>'
    text = files('<SubTree ID="A" topic="/scan"/>', A='<Topic topic="{topic}" gap="{gap}"/>')
    same(text.replace("</root>", f"{model}</root>"), SCAN)
    assert_golden(
        "tree_problems",
        problems(text.replace(' topic="/scan"', "").replace("</root>", f"{model}</root>")),
        "line 2, column 25",
        "SubTree",
        '"A"',
        "TreeNodesModel",
    )


def test_trees_that_are_not_executed_are_ignored() -> None:
    same(files(SCAN_XML, Navigate='<PipelineSequence><ComputePathToPose goal="{goal}"/></PipelineSequence>'), SCAN)


GROOT = """<?xml version="1.0" encoding="UTF-8"?>
<root BTCPP_format="4"
      main_tree_to_execute="Healthy"
      project_name="Robot">
  <BehaviorTree ID="Healthy">
    <Parallel failure_count="1"
              success_count="-1"
              name="healthy"
              _description="all that the robot needs">
      <WhileTaskActive name="driving"
                       action="/navigate_to_pose"
                       type=""
                       settle="2s">
        <Topic topic="/cmd_vel"
               type="geometry_msgs/msg/Twist"
               gap="500ms"/>
      </WhileTaskActive>
      <SubTree ID="Sensors"
               name="sensors"
               scan="/scan"
               _autoremap="false"
               _collapsed="true"/>
    </Parallel>
  </BehaviorTree>

  <BehaviorTree ID="Sensors">
    <ReactiveSequence>
      <Topic topic="{scan}"
             rate="&gt; 8 Hz"
             window="2s"/>
    </ReactiveSequence>
  </BehaviorTree>

  <!-- Description of Node Models (used by Groot) -->
  <TreeNodesModel>
    <SubTree ID="Sensors"
             editable="true">
      <input_port name="scan"
                  default="/scan">the lidar</input_port>
      <MetadataFields>
        <Metadata category="sensors"/>
      </MetadataFields>
    </SubTree>
    <Condition ID="Topic"
               editable="true">
      <input_port name="topic" type="std::string"/>
      <input_port name="type" default="" type="std::string"/>
      <input_port name="gap"/>
      <input_port name="rate"/>
      <input_port name="window"/>
    </Condition>
    <Decorator ID="WhileTaskActive" editable="true">
      <input_port name="action"/>
      <input_port name="settle" default="2s"/>
    </Decorator>
    <Action ID="SaySomething" editable="true">
      <input_port name="message"/>
      <output_port name="said"/>
    </Action>
  </TreeNodesModel>
</root>
"""


def test_a_file_written_by_groot_loads() -> None:
    driving = {
        "name": "driving",
        "while": {"task_active": {"action": "/navigate_to_pose"}},
        "settle": "2s",
        "do": {"topic": {"name": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "gap": "500ms"}},
    }
    sensors = {
        "name": "sensors",
        "parallel": [{"sequence": [{"topic": {"name": "/scan", "rate": "> 8 Hz", "window": "2s"}}]}],
    }
    same(GROOT, {"name": "healthy", "parallel": [driving, sensors]})


# -- the same trace ------------------------------------------------------------------------------------------------


@settings(max_examples=400, deadline=None)
@given(tree=TREES, seed=st.integers(0, 2**32), script=SCRIPTS, grace=st.sampled_from([0.0, 0.7, 4.0, 30.0]))
def test_a_tree_in_xml_gives_the_same_trace_as_in_the_short_form(
    tree: dict[str, Any], seed: int, script: list[tuple[float, str]], grace: float
) -> None:
    short = named(tree, numbers())
    text = Writer(random.Random(seed).randrange).file(short)
    found, expected = load_xml(text, grace=grace), load(short, grace=grace)
    assert shape(found) == shape(expected), text
    assert sorted(found.topics, key=lambda topic: topic.name) == sorted(expected.topics, key=lambda topic: topic.name)
    assert Replay(found, grace).trace(script) == Replay(expected, grace).trace(script)


@pytest.mark.parametrize("policy", POLICIES)
def test_the_policies_of_the_examples_are_equal_in_xml(policy: dict[str, Any]) -> None:
    tree = policy["spec"]["monitoring"]["yaml"]
    for seed in range(5):
        found = load_xml(Writer(random.Random(seed).randrange).file(tree))
        assert shape(found) == shape(load(tree))


# -- bounds ---------------------------------------------------------------------------------------------------------


def test_a_text_that_is_too_long_is_refused() -> None:
    assert problems(" " * (LONGEST_TEXT + 1)) == [
        f"line 1, column 1: the text has {LONGEST_TEXT + 1} characters; it may have {LONGEST_TEXT}"
    ]


def test_elements_that_are_nested_too_deeply_are_refused() -> None:
    assert problems("<a>" * 1000) == ["line 1, column 193: more than 64 nested elements"]
    (problem,) = problems(file("<Inverter>" * 40 + LEAF + "</Inverter>" * 40))
    assert problem.endswith("<Inverter>: the tree is more than 32 levels deep")


def test_a_text_with_too_many_elements_is_refused() -> None:
    (problem,) = problems(file("<a/>" * 5000))
    assert problem.endswith("the text has more than 4096 elements")


def test_a_tree_with_too_many_nodes_is_refused_with_one_problem() -> None:
    leaves = "".join(f'<Topic topic="/scan" gap="1s" name="leaf{i}"/>' for i in range(600))
    (problem,) = problems(file(f"<Parallel>{leaves}</Parallel>"))
    assert problem.endswith("<Topic>: the tree has more than 512 nodes")


def test_subtrees_that_double_at_every_level_are_refused() -> None:
    trees = {
        f"T{i}": f'<Parallel><SubTree ID="T{i + 1}" name="a"/><SubTree ID="T{i + 1}" name="b"/></Parallel>'
        for i in range(14)
    }
    (problem,) = problems(files('<SubTree ID="T0"/>', **trees, T14=LEAF))
    assert problem.endswith("the tree has more than 512 nodes")


def test_the_number_of_reported_mistakes_of_a_repeated_subtree_is_limited() -> None:
    uses = '<SubTree ID="A"/>' * 500
    unknown = " ".join(f'p{i}=""' for i in range(3000))
    found = problems(files(f"<Parallel>{uses}</Parallel>", A=f'<Topic topic="/a" gap="1s" {unknown}/>'))
    assert len(found) == 101
    assert found[-1].startswith("spec.monitoring.xml: and 2")


# -- anything at all ------------------------------------------------------------------------------------------------

PIECES = [
    *(f"<{tag}>" for tag in (*NODES, "SubTree", "BehaviorTree", "TreeNodesModel", "root", "include", "Script")),
    *(f"</{tag}>" for tag in (*NODES, "BehaviorTree", "root")),
    *(
        "<!DOCTYPE r [<!ENTITY a 'b'>]>",
        "&a;",
        "&lt;",
        "<![CDATA[",
        "]]>",
        "<!--",
        "-->",
        "<?x?>",
        "{",
        "}",
        '"',
        "{=}",
        "\0",
        "\ud800",
    ),
    *(
        ' ID="A"',
        ' ID="Healthy"',
        ' name="x"',
        ' topic="{scan}"',
        ' gap="1h"',
        ' success_count="-7"',
        ' _autoremap="1"',
        ' BTCPP_format="4"',
    ),
]


@settings(max_examples=400, deadline=None)
@given(seed=st.integers(0, 2**32), changes=st.integers(1, 12))
def test_a_changed_text_loads_or_is_refused(seed: int, changes: int) -> None:
    refused_or_loads(garbled(GROOT, PIECES, seed=seed, changes=changes))


@settings(max_examples=200, deadline=None)
@given(st.lists(st.sampled_from(PIECES) | st.text(max_size=5), max_size=60))
def test_fragments_in_any_order_load_or_are_refused(pieces: list[str]) -> None:
    refused_or_loads('<root BTCPP_format="4"><BehaviorTree ID="A">' + "".join(pieces))


def refused_or_loads(text: str) -> None:
    loads_or_is_refused(load_xml, text, "spec.monitoring.xml")

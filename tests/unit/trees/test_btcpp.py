"""Health trees in BehaviorTree.CPP XML: they are the trees of the short form, and what is wrong with one is said with its place."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.trees.garbled import garbled, loads_or_is_refused
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
from tests.unit.trees.written import Writer
from understudy.api.base import LONGEST_TEXT
from understudy.trees.languages.btcpp.library import NODES
from understudy.trees.languages.btcpp.loader import load_xml
from understudy.trees.languages.short.health_loader import load
from understudy.trees.source.problems import TreeError

LEAF = '<Topic topic="/scan" gap="1s"/>'


def files(main: str, **others: str) -> str:
    """A file of several trees: the main one is in line 2, each of the others in the next one."""
    trees = "\n".join(
        f'<BehaviorTree ID="{name}">{tree}</BehaviorTree>' for name, tree in {"Main": main, **others}.items()
    )
    return f'<root BTCPP_format="4" main_tree_to_execute="Main">\n{trees}\n</root>'


def problems(text: object) -> list[str]:
    with pytest.raises(TreeError) as caught:
        load_xml(text)
    return [str(problem).removeprefix("spec.monitoring.xml, ") for problem in caught.value.problems]


def same(text: str, tree: dict[str, Any]) -> None:
    """That a text is the same tree as one of the short form."""
    found, expected = load_xml(text), load(tree)
    assert shape(found) == shape(expected)
    assert found.topics == expected.topics


# -- what is written, in the short form -----------------------------------------------------------------------------

SCAN = {"topic": {"name": "/scan", "gap": "1s"}}
ODOM = {"topic": {"name": "/odom", "rate": "9 to 11 Hz", "window": "3s", "type": "nav_msgs/msg/Odometry"}}
SCAN_XML = '<Topic topic="/scan" gap="1s"/>'
ODOM_XML = '<Topic topic="/odom" rate="9 to 11 Hz" window="3s" type="nav_msgs/msg/Odometry"/>'
BOTH = SCAN_XML + ODOM_XML


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


def test_a_subtree_is_written_once_and_used_with_values_of_each_use() -> None:
    front, rear = (f'<SubTree ID="Lidar" name="{place}" scan="/{place}"/>' for place in ("front", "rear"))
    text = files(f"<Parallel>{front}{rear}</Parallel>", Lidar='<Topic topic="{scan}" gap="1s"/>')
    named = [
        {"parallel": [{"topic": {"name": f"/{place}", "gap": "1s"}}], "name": place} for place in ("front", "rear")
    ]
    same(text, {"parallel": named})
    assert [name for kind, name in shape(load_xml(text)) if kind == "TopicLeaf"] == ["front/front", "rear/rear"]


def test_a_subtree_without_a_name_adds_nothing() -> None:
    same(files('<Inverter><SubTree ID="Lidar"/></Inverter>', Lidar=SCAN_XML), {"inverter": SCAN})


def test_entries_go_down_by_name_by_the_same_name_and_all_at_once() -> None:
    text = files(
        '<SubTree ID="A" topic="/scan" long="1s"/>',
        A='<Parallel><SubTree ID="B" topic="{=}" gap="{long}"/><SubTree ID="C" _autoremap="true"/></Parallel>',
        B='<Topic topic="{topic}" gap="{gap}"/>',
        C='<Topic name="again" topic="{ topic }" gap="{long}"/>',
    )
    same(text, {"parallel": [SCAN, {**SCAN, "name": "again"}]})


def test_attributes_go_before_entries_of_the_same_name_that_are_remapped() -> None:
    text = files(
        '<SubTree ID="A" topic="/other"/>',
        A='<SubTree ID="B" _autoremap="1" topic="/scan"/>',
        B='<Topic topic="{topic}" gap="1s"/>',
    )
    same(text, SCAN)


def test_defaults_of_a_model_are_for_ports_that_are_not_given() -> None:
    model = '<TreeNodesModel><SubTree ID="A"><input_port name="topic"/><input_port name="gap" default="1s"/></SubTree></TreeNodesModel>'
    text = files('<SubTree ID="A" topic="/scan"/>', A='<Topic topic="{topic}" gap="{gap}"/>')
    same(text.replace("</root>", f"{model}</root>"), SCAN)
    assert problems(text.replace(' topic="/scan"', "").replace("</root>", f"{model}</root>")) == [
        'line 2, column 25: <SubTree ID="A"> topic: missing; its <TreeNodesModel> has no default for it'
    ]


def test_trees_that_are_not_executed_do_not_matter() -> None:
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


def test_a_file_as_groot_writes_it_loads() -> None:
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
def test_a_tree_written_in_both_forms_gives_the_same_trace(
    tree: dict[str, Any], seed: int, script: list[tuple[float, str]], grace: float
) -> None:
    short = named(tree, numbers())
    text = Writer(random.Random(seed).randrange).file(short)
    found, expected = load_xml(text, grace=grace), load(short, grace=grace)
    assert shape(found) == shape(expected), text
    assert sorted(found.topics, key=lambda topic: topic.name) == sorted(expected.topics, key=lambda topic: topic.name)
    assert Replay(found, grace).trace(script) == Replay(expected, grace).trace(script)


@pytest.mark.parametrize("policy", POLICIES)
def test_the_policies_of_the_examples_are_the_same_in_xml(policy: dict[str, Any]) -> None:
    tree = policy["spec"]["monitoring"]["yaml"]
    for seed in range(5):
        found = load_xml(Writer(random.Random(seed).randrange).file(tree))
        assert shape(found) == shape(load(tree))


# -- mistakes -------------------------------------------------------------------------------------------------------

KNOWN = (
    "Sequence, ReactiveSequence, Fallback, ReactiveFallback, Parallel, ParallelAll, Inverter, WhileTaskActive, "
    "Topic, Value, Age, Diagnostics, Transform, Publisher, Node, Log, Progress, Lifecycle, Motion, Parameter, Pod, SubTree"
)


@pytest.mark.parametrize(
    ("node", "expected"),
    [
        ("<Fallbak/>", "<Fallbak>: unknown node, did you mean 'Fallback'?"),
        ("<SaySomething/>", f"<SaySomething>: unknown node; known are {KNOWN}"),
        ("<Sequence/>", "<Sequence>: has no node in it; give it one at least"),
        ("<Inverter/>", "<Inverter>: has no node in it; give it one, such as a <Parallel> with the others in it"),
        (
            f"<Inverter>{BOTH}</Inverter>",
            "<Inverter>: has 2 nodes in it; give it one, such as a <Parallel> with the others in it",
        ),
        (
            f'<Topic topic="/a" gap="1s">{SCAN_XML}</Topic>',
            "<Topic>: has a node in it; a leaf has none: put them beside it",
        ),
        (
            f"<Inverter>not{SCAN_XML}</Inverter>",
            "<Inverter>: found the text 'not' in it; values are written as attributes",
        ),
        ('<Topic gap="1s"/>', "<Topic> topic: missing; give the topic's fully qualified name, such as /cmd_vel"),
        (
            '<Topic name="/scan" topic="/scan" gap="1s"/>',
            "<Topic> name: found '/scan'; a node's name is 1 to 63 letters, digits, '_', '-' and '.'",
        ),
        ('<Topic topic="scan" gap="1s"/>', "<Topic> topic: found 'scan'; did you mean '/scan'?"),
        (
            '<Topic topic="/scan"/>',
            "<Topic>: neither gap nor rate is given; give gap, such as 500ms, or rate, such as '> 8 Hz'",
        ),
        ('<Topic topic="/scan" gap="1s" rat="> 8 Hz"/>', "<Topic> rat: unknown port, did you mean 'rate'?"),
        (
            '<Topic topic="/scan" gap="500"/>',
            "<Topic> gap: '500' is not a duration: write a number with ms, s, m or h, such as 500ms or 1m30s",
        ),
        ('<Topic topic="/scan" rate="> 0 Hz"/>', "<Topic> rate: '> 0 Hz' bounds nothing: a bound is above 0 Hz"),
        (
            '<Topic topic="/scan" rate="> 8 Hz" window="100ms"/>',
            "<Topic> window: 100 ms is too short to tell whether a rate is > 8 Hz: a window counts whole messages; "
            "give at least 250 ms",
        ),
        ('<Topic topic="/scan" type="a/srv/B" gap="1s"/>', "<Topic> type: found 'a/srv/B'; give package/msg/Name"),
        (
            f"<Parallel>{SCAN_XML}{SCAN_XML}</Parallel>",
            "<Topic>: 'scan' is already the name of <Topic> in line 3, column 11; give one of them another name",
        ),
        (
            f'<WhileTaskActive action="go">{SCAN_XML}</WhileTaskActive>',
            "<WhileTaskActive> action: found 'go'; did you mean '/go'?",
        ),
        (
            f"<WhileTaskActive>{SCAN_XML}</WhileTaskActive>",
            "<WhileTaskActive> action: missing; give the action's fully qualified name, such as /navigate_to_pose",
        ),
        (
            f'<WhileTaskActive action="/go" settle="2">{SCAN_XML}</WhileTaskActive>',
            "<WhileTaskActive> settle: '2' is not a duration: write a number with ms, s, m or h, such as 500ms or 1m30s",
        ),
        (
            '<WhileTaskActive action="/go"><Topic topic="/go/_action/status" gap="1s"/></WhileTaskActive>',
            "<Topic>: /go/_action/status is the status of a task's action, which is watched already; it cannot have a rate or gap",
        ),
        (
            '<Topic topic="{scan}" gap="1s"/>',
            "<Topic> topic: there is no blackboard entry 'scan': only attributes of a <SubTree> make some, in its tree",
        ),
        (
            '<Topic topic="/scan" gap="{gap}ms"/>',
            "<Topic> gap: found '{gap}ms'; a blackboard entry is a whole value, such as {scan}",
        ),
        (
            f'<Parallel success_count="2">{SCAN_XML}{BOTH}</Parallel>',
            "<Parallel>: success_count=2 and failure_count=1 of 3: leave both out where all must hold, or write <Fallback> "
            "where one is enough; a health tree knows nothing between",
        ),
        (
            f'<Parallel success_count="3">{BOTH}</Parallel>',
            "<Parallel>: success_count: found '3'; give a number from 1 to 2, or -1 for all of them",
        ),
        (
            f'<Parallel failure_count="some">{BOTH}</Parallel>',
            "<Parallel>: failure_count: found 'some'; give a number from 1 to 2, or -1 for all of them",
        ),
        (
            f'<ParallelAll max_failures="2">{BOTH}</ParallelAll>',
            "<ParallelAll>: max_failures=2 of 2: a health tree fails by its first failure; leave max_failures out where all "
            "must hold, or write <Fallback> where one is enough",
        ),
        ("<SubTree/>", "<SubTree> ID: missing; give the name of a <BehaviorTree>"),
        ('<SubTree ID="Man"/>', "<SubTree ID=\"Man\">: there is no tree 'Man', did you mean 'Main'?"),
        (
            '<SubTree ID="Main"/>',
            '<SubTree ID="Main">: the tree would be in itself (Main -> Main); leave one of them out',
        ),
        ("<Main/>", '<Main>: it is a tree; write <SubTree ID="Main"/>'),
        ('<Action ID="Topic" topic="/scan" gap="1s"/>', '<Action ID="Topic">: Topic is a Condition; write <Topic>'),
        ("<Condition/>", "<Condition> ID: missing; say which node it is"),
        (
            f'<RetryUntilSuccessful num_attempts="3">{LEAF}</RetryUntilSuccessful>',
            "<RetryUntilSuccessful>: is not for health trees: a health tree is evaluated continuously; leave it out, and "
            "give the leaf in it a longer gap or window",
        ),
        (
            '<Script code="a:=1"/>',
            "<Script>: is not for health trees: scripts are not run; a condition that counts only during a task goes into "
            '<WhileTaskActive action="/navigate_to_pose">',
        ),
        (
            f'<Delay delay_msec="100">{LEAF}</Delay>',
            "<Delay>: is not for health trees: gap, window and settle, and debounce of the policy, say how long something "
            "may be missing; leave it out",
        ),
        (
            f"<ForceSuccess>{LEAF}</ForceSuccess>",
            "<ForceSuccess>: is not for health trees: a constant result says nothing about the robot; leave it out",
        ),
        (
            f"<SequenceWithMemory>{LEAF}</SequenceWithMemory>",
            "<SequenceWithMemory>: is not for health trees: a health tree is evaluated again each time and remembers "
            "nothing; write <Sequence>",
        ),
        (
            '<Topic topic="/scan" gap="1s" _skipIf="idle"/>',
            "<Topic> _skipIf: scripts are not run; a condition that counts only during a task goes into "
            '<WhileTaskActive action="/navigate_to_pose">',
        ),
    ],
)
def test_a_mistake_in_a_node_is_reported_with_its_place_and_the_valid_values(node: str, expected: str) -> None:
    found = problems(file(node))
    assert len(found) == 1, found
    place, _, message = found[0].partition(": ")
    assert message == expected
    assert place == f"line 3, column {node.rindex('<Topic') + 1 if 'already' in expected else 1}"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "line 1, column 1: this is not XML: no element found"),
        ("parallel: []", "line 1, column 1: this is not XML: syntax error"),
        ("<root>\n  <a></b>\n</root>", "line 2, column 8: this is not XML: mismatched tag"),
        ("<root>&scan;</root>", "line 1, column 7: this is not XML: undefined entity"),
        (
            "\n<?xml version='1.0'?>\n<root/>",
            "line 2, column 1: this is not XML: XML or text declaration not at start of entity",
        ),
        ("\ud800", "line 1, column 1: this is not XML: it has a lone surrogate"),
        (
            '<?xml version="1.0"?>\n  <!DOCTYPE root [<!ENTITY a SYSTEM "file:///etc/passwd">]>\n<root>&a;</root>',
            "line 2, column 3: a document type can have entities and name files to read; leave it out",
        ),
        ("<Root/>", 'line 1, column 1: <Root>: the outermost element is <root BTCPP_format="4">'),
        (
            "<root/>",
            "line 1, column 1: <root> BTCPP_format: missing; write '4': in other versions the same nodes mean other things",
        ),
        (
            '<root BTCPP_format="3"/>',
            "line 1, column 1: <root> BTCPP_format: found '3'; write '4': in other versions the same nodes mean other things",
        ),
        (
            '<root BTCPP_format="4"/>',
            'line 1, column 1: <root>: has no tree in it; give it one <BehaviorTree ID="...">',
        ),
        (
            '<root BTCPP_format="4">\n <include path="a.xml"/></root>',
            "line 2, column 2: <include>: no files are read; write the <BehaviorTree> that is in that file here",
        ),
        (
            '<root BTCPP_format="4">\n<BehaviourTree ID="A"/></root>',
            "line 2, column 1: <BehaviourTree ID=\"A\">: unknown element, did you mean 'BehaviorTree'?",
        ),
        (
            f'<root BTCPP_format="4">\n<BehaviorTree>{LEAF}</BehaviorTree></root>',
            "line 2, column 1: <BehaviorTree> ID: missing; give the tree a name",
        ),
        (
            file(),
            'line 2, column 1: <BehaviorTree ID="Main">: has no node in it; give it one, such as a <Parallel> with the others in it',
        ),
        (
            file(LEAF, LEAF),
            'line 2, column 1: <BehaviorTree ID="Main">: has 2 nodes in it; give it one, such as a <Parallel> with the others in it',
        ),
        (
            files(LEAF, A=LEAF).replace(' main_tree_to_execute="Main"', ""),
            "line 1, column 1: <root> main_tree_to_execute: missing; give one of Main, A",
        ),
        (
            files(LEAF).replace('="Main">\n', '="Mian">\n'),
            "line 1, column 1: <root> main_tree_to_execute: there is no tree 'Mian', did you mean 'Main'?",
        ),
        (
            files(LEAF, A=LEAF).replace('"A"', '"Main"'),
            'line 3, column 1: <BehaviorTree ID="Main">: there is one in line 2 already; give each a name of its own',
        ),
        (
            files('<SubTree ID="A"/>', A='<SubTree ID="B"/>', B='<Inverter><SubTree ID="A"/></Inverter>'),
            'line 4, column 32: <SubTree ID="A">: the tree would be in itself (A -> B -> A); leave one of them out',
        ),
        (
            files('<SubTree ID="A" scan="scan"/>', A='<Topic topic="{scan}" gap="1s"/>'),
            "line 3, column 22 (used in line 2): <Topic> topic: found 'scan'; did you mean '/scan'?",
        ),
        (
            files('<SubTree ID="A" sacn="/scan" gap="1s"/>', A='<Topic topic="/scan" gap="{gap}"/>'),
            'line 2, column 25: <SubTree ID="A"> sacn: the tree reads no such entry; known are gap',
        ),
        (
            files('<SubTree ID="A" _autoremap="yes"/>', A=LEAF),
            "line 2, column 25: <SubTree ID=\"A\"> _autoremap: found 'yes'; give true or false",
        ),
        (
            files(f'<SubTree ID="A">{LEAF}</SubTree>', A=LEAF),
            'line 2, column 25: <SubTree ID="A">: has a node in it; they belong in the <BehaviorTree> of that name',
        ),
        (
            files('<SubTree ID="A"/>', A='<Topic topic="/a" gap="{gap}"/>')
            .replace("</root>", '<TreeNodesModel>\n<Action ID="Topic"/></TreeNodesModel></root>')
            .replace("{gap}", "1s"),
            'line 5, column 1: <Action ID="Topic">: Topic is a Condition; write <Condition ID="Topic">',
        ),
        (
            file(LEAF).replace(
                "</root>",
                '<TreeNodesModel><Condition ID="Topic">\n<input_port name="gab"/></Condition></TreeNodesModel></root>',
            ),
            "line 6, column 1: <input_port>: Topic has no port 'gab', did you mean 'gap'?",
        ),
        (
            file(LEAF).replace(
                "</root>",
                '<TreeNodesModel><Condition ID="Topic">\n<output_port name="gap"/></Condition></TreeNodesModel></root>',
            ),
            "line 6, column 1: <output_port>: 'gap' of Topic is only read; write <input_port>",
        ),
    ],
)
def test_a_mistake_in_the_file_structure_is_reported(text: str, expected: str) -> None:
    assert problems(text) == [expected]


def test_a_value_that_is_not_a_text_is_refused() -> None:
    assert problems({"topic": {}}) == [
        "spec.monitoring.xml: found a mapping; give the text of a BehaviorTree.CPP 4 file"
    ]


def test_all_mistakes_are_reported_at_once_in_text_order() -> None:
    found = problems(
        file(
            "<Parallel>",
            '<Topic topic="/scan" gap="-1s" rate="fast"/>',
            "<Sequnce/>",
            "<Inverter>",
            '<Topic topic="odom" gap="1s"/>',
        ).replace("\n</Beh", "\n</Inverter></Parallel></Beh")
    )
    assert [line.split(": ")[0:2] for line in found] == [
        ["line 4, column 1", "<Topic> gap"],
        ["line 4, column 1", "<Topic> rate"],
        ["line 5, column 1", "<Sequnce>"],
        ["line 7, column 1", "<Topic> topic"],
    ]


# -- bounds ---------------------------------------------------------------------------------------------------------


def test_a_text_too_long_is_refused() -> None:
    assert problems(" " * (LONGEST_TEXT + 1)) == [
        f"line 1, column 1: the text has {LONGEST_TEXT + 1} characters; it may have {LONGEST_TEXT}"
    ]


def test_elements_too_deep_are_refused() -> None:
    assert problems("<a>" * 1000) == ["line 1, column 193: more than 64 nested elements"]
    (problem,) = problems(file("<Inverter>" * 40 + LEAF + "</Inverter>" * 40))
    assert problem.endswith("<Inverter>: the tree is more than 32 levels deep")


def test_elements_too_many_are_refused() -> None:
    (problem,) = problems(file("<a/>" * 5000))
    assert problem.endswith("the text has more than 4096 elements")


def test_a_tree_too_large_is_refused_once() -> None:
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

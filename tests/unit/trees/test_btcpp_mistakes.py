"""Mistakes in BehaviorTree.CPP files are reported with their place and the way out."""

from __future__ import annotations

import pytest

from tests.support.golden import assert_golden
from tests.unit.trees.btcpp_texts import BOTH, LEAF, SCAN_XML, files, problems
from tests.unit.trees.replays import (
    file,
)

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
            "<Topic>: has a node in it, but a leaf cannot have nodes in it: put them next to it",
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
        ('<Topic topic="/scan" rate="> 0 Hz"/>', "<Topic> rate: '> 0 Hz' sets no limit: a bound must be above 0 Hz"),
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
            "<Topic> topic: there is no blackboard entry 'scan': only the attributes of a <SubTree> create entries, inside that subtree",
        ),
        (
            '<Topic topic="/scan" gap="{gap}ms"/>',
            "<Topic> gap: found '{gap}ms'; a blackboard entry is a whole value, such as {scan}",
        ),
        (
            f'<Parallel success_count="2">{SCAN_XML}{BOTH}</Parallel>',
            "<Parallel>: success_count=2 and failure_count=1 of 3: remove both if all must hold, or write <Fallback> "
            "if one is enough; a health tree supports no other numbers",
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
            "<ParallelAll>: max_failures=2 of 2: a health tree fails at its first failure; remove max_failures if all "
            "must hold, or write <Fallback> if one is enough",
        ),
        ("<SubTree/>", "<SubTree> ID: missing; give the name of a <BehaviorTree>"),
        ('<SubTree ID="Man"/>', "<SubTree ID=\"Man\">: there is no tree 'Man', did you mean 'Main'?"),
        (
            '<SubTree ID="Main"/>',
            '<SubTree ID="Main">: the tree would contain itself (Main -> Main); remove one of the <SubTree> nodes',
        ),
        ("<Main/>", '<Main>: it is a tree; write <SubTree ID="Main"/>'),
        ('<Action ID="Topic" topic="/scan" gap="1s"/>', '<Action ID="Topic">: Topic is a Condition; write <Topic>'),
        ("<Condition/>", "<Condition> ID: missing; say which node it is"),
        (
            f'<RetryUntilSuccessful num_attempts="3">{LEAF}</RetryUntilSuccessful>',
            "<RetryUntilSuccessful>: is not for health trees: a health tree is evaluated continuously; remove it, and "
            "give the leaf in it a longer gap or window",
        ),
        (
            '<Script code="a:=1"/>',
            "<Script>: is not for health trees: scripts are not run; a condition that counts only during a task goes into "
            '<WhileTaskActive action="/navigate_to_pose">',
        ),
        (
            f'<Delay delay_msec="100">{LEAF}</Delay>',
            "<Delay>: is not for health trees: gap, window, settle and the policy's debounce set how long something "
            "may be missing; remove it",
        ),
        (
            f"<ForceSuccess>{LEAF}</ForceSuccess>",
            "<ForceSuccess>: is not for health trees: a constant result says nothing about the robot; remove it",
        ),
        (
            f"<SequenceWithMemory>{LEAF}</SequenceWithMemory>",
            "<SequenceWithMemory>: is not for health trees: a health tree is evaluated again at each tick and remembers "
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
        (
            '<root>\n  <a when="b < 2"/>\n</root>',
            "line 2, column 14: this is not XML: not well-formed (invalid token); write &lt; for < in the value of an attribute",
        ),
        (
            '<root>\n  <a when="b && c"/>\n</root>',
            "line 2, column 15: this is not XML: not well-formed (invalid token); write &amp; for &",
        ),
        ("<root>&scan;</root>", "line 1, column 7: this is not XML: undefined entity; write &amp; for &"),
        (
            "\n<?xml version='1.0'?>\n<root/>",
            "line 2, column 1: this is not XML: XML or text declaration not at start of entity",
        ),
        ("\ud800", "line 1, column 1: this is not XML: it has a lone surrogate"),
        (
            '<?xml version="1.0"?>\n  <!DOCTYPE root [<!ENTITY a SYSTEM "file:///etc/passwd">]>\n<root>&a;</root>',
            "line 2, column 3: a document type can have entities and name files to read; remove it",
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
            'line 4, column 32: <SubTree ID="A">: the tree would contain itself (A -> B -> A); remove one of the <SubTree> nodes',
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


def test_a_value_that_is_not_text_is_refused() -> None:
    assert_golden("tree_problems", problems({"topic": {}}), "spec.monitoring.xml", "BehaviorTree")


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

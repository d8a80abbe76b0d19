"""Procedures in XML and OpenSCENARIO 2: they are those of the short form, and what is wrong with one is said with its place."""

from __future__ import annotations

import asyncio
import random
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.trees.arbitrary_texts import garbled, loaded_or_refused
from tests.unit.trees.procedure_texts import ACTIVE, ACTIVE_OSC, ACTIVE_XML, PATH, file, scenario
from tests.unit.trees.procedure_world import LONG, Instance
from tests.unit.trees.procedure_writers import as_scenario, as_xml
from understudy.api.kinds.procedure_spec import Check, Procedure
from understudy.trees.core.procedure_steps import ProcedureFailed
from understudy.trees.languages.btcpp import library
from understudy.trees.languages.btcpp import steps as xml
from understudy.trees.languages.osc import steps as scenarios
from understudy.trees.languages.osc import tokens
from understudy.trees.languages.osc.library import WORDS
from understudy.trees.languages.procedure_notations import LoadedProcedure, compose, composed
from understudy.trees.languages.short import procedure_loader
from understudy.trees.languages.short.procedure_loader import CONDITIONS, DECORATORS, STEPS
from understudy.trees.leaves import procedure_leaves
from understudy.trees.leaves.registry import LEAVES
from understudy.trees.source.problems import TreeError

# -- what is written, in the short form -----------------------------------------------------------------------------

LOAD = {"service": "/load", "type": "nav2_msgs/srv/LoadMap"}
LOAD_XML, LOAD_OSC = '<CallService service="/load" type="nav2_msgs/srv/LoadMap"', '"/load", "nav2_msgs/srv/LoadMap"'


@pytest.mark.parametrize(
    ("node", "element", "lines"),
    [
        (ACTIVE, ACTIVE_XML, [ACTIVE_OSC]),
        (
            {"call_service": {**LOAD, "request": {"map_url": "/a.yaml"}, "expect": {"result": 0}, "repeat": "5s"}},
            f"{LOAD_XML} request='json:{{\"map_url\": \"/a.yaml\"}}' expect='json:{{\"result\": 0}}' repeat=\"5s\"/>",
            [f'call_service({LOAD_OSC}, "{{map_url: /a.yaml}}", "{{result: 0}}", repeat: 5s)'],
        ),
        (
            {"publish": {"topic": "/a", "type": "b/msg/C", "message": {"y": 1.5, "n": [True, None, "x"]}}},
            "<Publish topic=\"/a\" type=\"b/msg/C\" message='json:{\"y\": 1.5, \"n\": [true, null, \"x\"]}'/>",
            ['publish("/a", topic_type: "b/msg/C", message: "{y: 1.5, n: [true, null, x]}")'],
        ),
        (
            {"set_parameters": {"node": "/a", "values": {"use_sim_time": True, "rates": [1, 2]}}},
            "<SetParameters node=\"/a\" values='json:{\"use_sim_time\": true, \"rates\": [1, 2]}'/>",
            ['set_parameters("/a", "{use_sim_time: true, rates: [1, 2]}")'],
        ),
        (
            {"wait_for": {"topic": "/a", "type": "b/msg/C", "within": "20s"}},
            '<WaitFor topic="/a" type="b/msg/C" service="" node="" within="20s"/>',
            ['wait_for("/a", "b/msg/C", within: 20s)'],
        ),
        ({"wait_for": {"service": "/a"}}, '<WaitFor service="/a"/>', ['wait_for(service_name: "/a")']),
        ({"restore_state": {}}, "<RestoreState/>", ["restore_state()"]),
        (
            {"restore_state": {"only": ["/amcl_pose", "/map"]}},
            '<RestoreState only="/amcl_pose;/map"/>',
            ['restore_state("/amcl_pose, /map")'],
        ),
        ({"resend_goals": {}}, "<ResendGoals/>", ["resend_goals()"]),
        (
            {"lifecycle_is": {"node": "/a", "state": "inactive"}},
            '<LifecycleIs node="/a" state="inactive"/>',
            ['lifecycle_is("/a", lifecycle_state!inactive)'],
        ),
        ({"node_present": {"node": "/a"}}, '<NodePresent node="/a"/>', ['node_present("/a")']),
        ({"service_present": {"service": "/a"}}, '<ServicePresent service="/a"/>', ['service_present("/a")']),
        (
            {"parameter_is": {"node": "/a", "name": "rate", "value": 2}},
            '<ParameterIs name="twice" node="/a" parameter="rate" value="2"/>',
            ['parameter_is("/a", "rate", "2")'],
        ),
        (
            {"parameter_is": {"node": "/a", "name": "frame", "value": "map"}},
            '<ParameterIs node="/a" parameter="frame" value="map"/>',
            ['parameter_is("/a", "frame", value: "map")'],
        ),
        ({"topic": {"name": "/a", "gap": "1s"}}, '<Topic topic="/a" gap="1s"/>', ['topic("/a", gap: 1s)']),
        ({"node": {"name": "/a"}}, '<Node name="a node" node="/a"/>', ['node("/a")']),
        ({"sequence": [ACTIVE]}, f"<Sequence>{ACTIVE_XML}</Sequence>", ["serial:", f"    {ACTIVE_OSC}"]),
        ({"sequence": [ACTIVE]}, f'<Control ID="AsyncSequence">{ACTIVE_XML}</Control>', ["serial:", f"    {ACTIVE_OSC}"]),
        ({"selector": [ACTIVE]}, f"<Fallback>{ACTIVE_XML}</Fallback>", ["one_of:", f"    {ACTIVE_OSC}"]),
        (
            {"parallel": [ACTIVE]},
            f'<Parallel success_count="-1" failure_count="1">{ACTIVE_XML}</Parallel>',
            ["all_at_once: parallel:", f"    {ACTIVE_OSC}"],
        ),
        ({"inverter": ACTIVE}, f"<Inverter>{ACTIVE_XML}</Inverter>", [f"{ACTIVE_OSC} with:", "    inverter()"]),
        (
            {"timeout": {"within": "5000ms", "do": ACTIVE}},
            f'<Timeout msec="5000">{ACTIVE_XML}</Timeout>',
            [f"{ACTIVE_OSC} with:", "    timeout(5000ms)"],
        ),
        (
            {"retry": {"times": 3, "do": ACTIVE}},
            f'<RetryUntilSuccessful num_attempts="3">{ACTIVE_XML}</RetryUntilSuccessful>',
            [f"{ACTIVE_OSC} with:", "    retry(3)"],
        ),
        (
            {"retry": {"times": 3, "wait": "2s", "do": {"timeout": {"within": "500ms", "do": ACTIVE}}}},
            '<RetryUntilSuccessful num_attempts="3" wait="2s"><Timeout msec="500">'
            f"{ACTIVE_XML}</Timeout></RetryUntilSuccessful>",
            [f"{ACTIVE_OSC} with:", "    retry(count: 3, pause: 2s)", "    timeout(duration: 500ms)"],
        ),
    ],
)  # fmt: skip
def test_each_node_is_equivalent_to_one_of_the_short_form(node: dict[str, Any], element: str, lines: list[str]) -> None:
    assert compose("xml", file(element), check=False, path=PATH).node == node
    assert compose("osc", scenario(*lines), check=False, path=PATH).node == {"sequence": [node]}
    assert compose("yaml", node, check=False, path=PATH).node == node


def test_a_subtree_accepts_structured_values() -> None:
    text = (
        '<root BTCPP_format="4" main_tree_to_execute="Main"><BehaviorTree ID="Main"><Sequence>'
        '<SubTree ID="Say" what=\'json:{"data": "a"}\'/><SubTree ID="Say" name="again" what=\'json:{"data": "b"}\'/>'
        '</Sequence></BehaviorTree><BehaviorTree ID="Say"><Publish topic="/a" type="b/msg/C" message="{what}"/></BehaviorTree></root>'
    )
    found = compose("xml", text, check=False, path=PATH).node["sequence"]
    assert [node["publish"]["message"] for node in found] == [{"data": "a"}, {"data": "b"}]


def test_every_kind_of_procedure_node_can_be_written() -> None:
    kinds = {*STEPS, *CONDITIONS, *DECORATORS, *procedure_loader.COMPOSITES}
    assert {node.key for node in xml.PROCEDURES.nodes.values()} == kinds
    assert {node.key for node in xml.CHECKS.nodes.values()} == kinds - {*STEPS, "timeout", "retry"}
    scenario_kinds = {
        one.key for one in (*scenarios.PROCEDURES.actions.values(), *scenarios.PROCEDURES.modifiers.values())
    }
    assert scenario_kinds == kinds - {*procedure_loader.COMPOSITES}
    for kind, step in {**procedure_leaves.STEPS, **procedure_leaves.CONDITIONS}.items():
        where = {f"{kind}.{key}" for key in step.keys}
        assert set(xml.PROCEDURES.nodes[library.tag_of(kind)].ports.values()) == where
        assert {argument.where for argument in scenarios.PROCEDURES.actions[kind].arguments.values()} == where


def test_known_and_refused_nodes_are_disjoint_and_complete() -> None:
    for found in (xml.PROCEDURES, xml.CHECKS, library.HEALTH):
        assert not found.nodes.keys() & found.refused.keys()
    for found in (xml.PROCEDURES, xml.CHECKS):
        assert library.REFUSED.keys() <= found.nodes.keys() | found.refused.keys()
        assert library.NODES.keys() <= found.nodes.keys() | found.refused.keys()
    for dialect in (scenarios.PROCEDURES, scenarios.CHECKS):
        known = {**dialect.actions, **dialect.modifiers}
        assert not known.keys() & dialect.refused.keys()
        assert not known.keys() & WORDS
        assert not {name for one in known.values() for name in one.arguments} & WORDS
        assert dialect.words.keys() == tokens.REFUSED.keys()


def test_a_spec_is_composed_once_and_by_its_language() -> None:
    procedure = Procedure(xml=file(ACTIVE_XML))
    found = composed(procedure, path=PATH)
    assert found.node == ACTIVE
    assert composed(procedure, path=PATH) is found
    check = Check(osc=scenario('node_present("/a")'))
    assert composed(check, path=PATH).node == {"sequence": [{"node_present": {"node": "/a"}}]}
    with pytest.raises(TreeError, match="a check takes no action"):
        composed(Check(osc=scenario(ACTIVE_OSC)), path=PATH)


@pytest.mark.parametrize("given_", [{}, {"yaml": ACTIVE, "xml": "<root/>"}, {"xml": "<root/>", "osc": "scenario"}])
def test_a_spec_has_exactly_one_tree(given_: dict[str, Any]) -> None:
    for model in (Procedure, Check):
        with pytest.raises(ValueError, match="give exactly one of yaml, xml and osc"):
            model.model_validate(given_)


# -- the same trace ------------------------------------------------------------------------------------------------


class Fickle(Instance):
    """An instance on which some of what is done fails, at the first times or always."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        chosen = random.Random(seed)
        self._fails = {name: chosen.choice([0, 0, 0, 1, 2, 99]) for name in NAMES}
        self.nodes = {name for name in NAMES if chosen.random() < 0.7}
        self.parameters = {"rate": chosen.choice([1, 2.5, "fast", True])}

    async def _step(self, what: str, name: str) -> None:
        await super()._step(what, name)
        if self._fails.get(name, 0) > 0:
            self._fails[name] -= 1
            raise RuntimeError(f"{name} isn't {what}")


NAMES = ("/a", "/b", "/c")
STRUCTURES = st.dictionaries(
    st.sampled_from(["data", "x", "y", "on"]),
    st.sampled_from([1, 2.5, True, None, "no", 'it\'s "so": \\', {"z": [1, "a"]}, []]),
    min_size=1,
    max_size=3,
)


def leaves() -> st.SearchStrategy[dict[str, Any]]:
    names, states = st.sampled_from(NAMES), st.sampled_from(["inactive", "active"])
    service, type_ = {"service": names, "type": st.just("a/srv/B")}, st.just("a/msg/B")
    fields = {
        "set_lifecycle": st.fixed_dictionaries({"node": names, "state": states}),
        "call_service": st.fixed_dictionaries(
            service, optional={"request": STRUCTURES, "repeat": st.sampled_from(["1s", "250ms"])}
        ),
        "publish": st.fixed_dictionaries({"topic": names, "type": type_, "message": STRUCTURES}),
        "set_parameters": st.fixed_dictionaries({"node": names, "values": st.just({"rate": 2.5, "list": [1, 2]})}),
        "wait_for": st.fixed_dictionaries({"topic": names, "type": type_}, optional={"within": st.just("9s")}),
        "restore_state": st.fixed_dictionaries({}, optional={"only": st.lists(names, min_size=1, max_size=2)}),
        "resend_goals": st.just({}),
        "lifecycle_is": st.fixed_dictionaries({"node": names, "state": states}),
        "node_present": st.fixed_dictionaries({"node": names}),
        "service_present": st.fixed_dictionaries({"service": names}),
        "parameter_is": st.fixed_dictionaries(
            {"node": names, "name": st.just("rate"), "value": st.sampled_from([1, 2.5, "fast", "1", True, [1]])}
        ),
    }
    return st.one_of([st.builds(lambda found, kind=kind: {kind: found}, found) for kind, found in fields.items()])


def above(nodes: st.SearchStrategy[dict[str, Any]]) -> st.SearchStrategy[dict[str, Any]]:
    several = st.lists(nodes, min_size=1, max_size=3)
    composites = st.builds(lambda key, inside: {key: inside}, st.sampled_from(["sequence", "selector"]), several)
    # What is tried again beside others takes turns with them that hang on the clock.
    parallels = st.builds(lambda inside: {"parallel": inside}, st.lists(leaves(), min_size=1, max_size=3))
    retries = st.builds(
        lambda times, inside: {"retry": {"times": times, "wait": "1ms", "do": inside}}, st.integers(1, 3), nodes
    )
    timeouts = st.builds(lambda inside: {"timeout": {"within": "60000ms", "do": inside}}, nodes)
    return composites | parallels | retries | timeouts | st.builds(lambda inside: {"inverter": inside}, nodes)


TREES = st.recursive(leaves(), above, max_leaves=6)


async def trace(found: LoadedProcedure, seed: int) -> list[str]:
    """The actions on an instance and their results, with the node names of the short form."""
    instance, end = Fickle(seed), "done"
    try:
        await found.tree.run(instance, LONG)
    except ProcedureFailed as error:
        end = str(error)
    # The longest first: one place may begin another.
    for inner, place in sorted(found.places.items(), key=lambda item: -len(item[1])):
        end = end.replace(f"{PATH}, {place}:", f"{PATH}.{inner}:")
    return [*instance.done, end]


@settings(max_examples=80, deadline=None)
@given(tree=TREES, seed=st.integers(0, 2**32))
def test_a_procedure_does_the_same_in_three_languages(tree: dict[str, Any], seed: int) -> None:
    short = compose("yaml", tree, check=False, path=PATH)
    in_xml = compose("xml", as_xml(tree), check=False, path=PATH)
    in_osc = compose("osc", as_scenario(tree), check=False, path=PATH)
    assert in_xml.node == in_osc.node == tree
    with mock.patch.object(procedure_loader, "TICK", 0.001):
        expected = asyncio.run(trace(short, seed))
        assert asyncio.run(trace(in_xml, seed)) == expected
        assert asyncio.run(trace(in_osc, seed)) == expected


async def test_a_failure_is_reported_with_its_place_in_the_text() -> None:
    text = file("<Sequence>", '<NodePresent node="/a"/>', "</Sequence>")
    with pytest.raises(ProcedureFailed) as failure:
        await compose("xml", text, check=False, path=PATH).tree.run(Instance(), LONG)
    assert_golden("procedures", str(failure.value), "line 4, column 1", "NodePresent", "/a")
    instance = Instance()
    instance.never = {"/amcl"}
    slow = scenario(f"{ACTIVE_OSC} with:", "    timeout(100ms)")
    with pytest.raises(ProcedureFailed) as failure:
        await compose("osc", slow, check=False, path=PATH).tree.run(instance, LONG)
    assert_golden("procedures", str(failure.value), "line 5, column 13", "0.1 s", "line 4, column 9", "set_lifecycle")


EXAMPLE = Path(__file__).parents[3] / "examples" / "navigation"


def test_the_bring_up_of_the_example_is_equal_in_all_languages() -> None:
    (expected,) = (
        item["spec"]["bringUp"]["yaml"]
        for item in yaml.safe_load_all((EXAMPLE / "manifests" / "workload.yaml").read_text())
        if item["kind"] == "RobotWorkload"
    )
    for form in ("xml", "osc"):
        text = (EXAMPLE / "trees" / f"bring_up.{form}").read_text()
        assert compose(form, text, check=False, path=PATH).node == expected


def procedures_of_the_examples() -> list[Any]:
    found = []
    for path in sorted(EXAMPLE.parent.rglob("*.yaml")):
        for item in yaml.safe_load_all(path.read_text()):
            spec = (item or {}).get("spec", {})
            owners = [spec, *(spec.get("strategies") or [])]
            for field in ("bringUp", "initialization", "recovery", "readinessCheck"):
                for owner in owners:
                    if tree := (owner.get(field) or {}).get("yaml"):
                        name = f"{path.parent.name}-{path.stem}-{field}-{len(found)}"
                        found.append(pytest.param(tree, field == "readinessCheck", id=name))
    return found


@pytest.mark.parametrize(("tree", "check"), procedures_of_the_examples())
def test_the_procedures_of_the_examples_are_equal_in_all_languages(tree: dict[str, Any], check: bool) -> None:
    for form, text in (("xml", as_xml(tree)), ("osc", as_scenario(tree))):
        assert compose(form, text, check=check, path=PATH).node == tree


# -- anything at all ------------------------------------------------------------------------------------------------

WHOLE = {form: (EXAMPLE / "trees" / f"bring_up.{form}").read_text() for form in ("xml", "osc")}
PIECES = {
    "xml": [
        *(f"<{tag}>" for tag in (*xml.PROCEDURES.nodes, "SubTree", "BehaviorTree", "Script", "Delay")),
        *(f"</{tag}>" for tag in ("Sequence", "Parallel", "Fallback", "BehaviorTree", "root")),
        *("json:", "json:{", '="', "'", "{", "}", "{x: 1}", "[[[[[[[[", "&#10;", "1e999", "NaN", "&a *a", "\ud800", "\0"),
        *(' node="{node}"', ' message="json:[1"', ' num_attempts="9999999999"', ' msec="-1"', ' values="!!python/x 1"', ' within="9h"'),
    ],
    "osc": [
        *scenarios.PROCEDURES.actions,
        *scenarios.PROCEDURES.modifiers,
        *tokens.REFUSED_IN_PROCEDURES,
        *("do", "with:", "serial:", "one_of:", "lifecycle_state!", "\n", "\n        ", "(", ")", ":", ",", '"', "'", "\\", "{", "}"),
        *('"{x: "', '"json:[1"', '"&a [*a, *a]"', '"!!python/x 1"', '"<<: 1"', "retry(3)", "timeout(1s)", "9999999999", "\ud800", "\0"),
    ],
}  # fmt: skip


@pytest.mark.parametrize("form", ["xml", "osc"])
@pytest.mark.parametrize("check", [False, True])
@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32), changes=st.integers(1, 12))
def test_a_changed_text_loads_or_is_refused(form: str, check: bool, seed: int, changes: int) -> None:
    text = garbled(WHOLE[form], PIECES[form], seed=seed, changes=changes)
    loaded_or_refused(lambda given_: compose(form, given_, check=check, path=PATH), text, PATH)


@pytest.mark.parametrize("form", ["xml", "osc"])
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_fragments_in_any_order_load_or_are_refused(form: str, data: st.DataObject) -> None:
    pieces = data.draw(st.lists(st.sampled_from(PIECES[form]) | st.text(max_size=5), max_size=60))
    begin = (
        '<root BTCPP_format="4"><BehaviorTree ID="A">'
        if form == "xml"
        else "import osc.understudy\nscenario a:\n    do serial:\n        "
    )
    loaded_or_refused(lambda given_: compose(form, given_, check=False, path=PATH), begin + " ".join(pieces), PATH)


# -- what agents load -----------------------------------------------------------------------------------------------


def test_an_agent_runs_procedures_without_their_languages() -> None:
    program = (
        "import sys\nfrom understudy.trees.languages.notations import load_health\n"
        "from understudy.trees.languages.short.procedure_loader import load_procedure\n"
        "load_procedure({'resend_goals': {}}, path='bringUp', places={'resend_goals': 'line 1, column 1: <ResendGoals>'})\n"
        "print([name for name in ('antlr4', 'yaml', 'understudy.trees.languages.text.flow_values') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "[]", "")


def test_procedures_know_no_leaf_that_needs_the_active_instance() -> None:
    for kind, leaf in LEAVES.items():
        for check in (False, True):
            known = (xml.CHECKS if check else xml.PROCEDURES).nodes.values()
            assert any(node.key == kind for node in known) is not leaf.active_only

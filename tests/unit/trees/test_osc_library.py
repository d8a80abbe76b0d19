"""The library of OpenSCENARIO 2 has all leaves with all that they can be given, and is what scenario-execution takes it to be."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import py_trees
import pytest
import yaml
from scenario_execution.model.model_resolver import resolve_internal_model
from scenario_execution.model.osc2_parser import OpenScenario2Parser
from scenario_execution.model.types import (
    BehaviorInvocation,
    ModelElement,
    ModifierInvocation,
    PhysicalTypeDeclaration,
    UnitDeclaration,
)
from scenario_execution.osc2_parsing.OpenSCENARIO2Lexer import OpenSCENARIO2Lexer

from tests.unit.trees.osc_texts import load_osc
from tests.unit.trees.replays import POLICIES
from tests.unit.trees.scenarios import ScenarioWriter
from understudy.trees.languages.osc import steps, tokens
from understudy.trees.languages.osc.library import ACTIONS, ENUMS, MODIFIERS, REFUSED, WORDS
from understudy.trees.languages.osc.units import OWN, UNITS
from understudy.trees.languages.procedure_notations import compose
from understudy.trees.languages.short.health_loader import TASK_KEYS, load
from understudy.trees.leaves.registry import LEAVES
from understudy.trees.source.problems import TreeError

REPOSITORY = Path(__file__).resolve().parents[3]
PAGE = (REPOSITORY / "docs" / "trees-osc.md").read_text()


# -- what there is --------------------------------------------------------------------------------------------------


def test_every_leaf_and_key_can_be_written() -> None:
    for kind, leaf in LEAVES.items():
        reached = {argument.where for argument in ACTIONS[kind].arguments.values()}
        assert reached == {f"{kind}.{key}" for key in leaf.keys}
    reached = {argument.where for argument in MODIFIERS["while_task_active"].arguments.values()}
    assert reached == {*(f"while.task_active.{key}" for key in TASK_KEYS), "settle"}


@pytest.mark.parametrize("kind", LEAVES)
def test_the_example_of_each_leaf_is_equal_in_openscenario(kind: str) -> None:
    example = yaml.safe_load(LEAVES[kind].example)
    text = ScenarioWriter().file({kind: example})
    assert f"{kind}(" in text
    assert load_osc(text).topics == load({kind: example}).topics


@pytest.mark.parametrize("kind", LEAVES)
def test_no_argument_with_the_type_string_is_a_duration(kind: str) -> None:
    """If this fails, the key of the leaf has the wrong type in its declaration."""
    texts = [one.where.rpartition(".")[2] for one in ACTIONS[kind].arguments.values() if one.type == "string"]
    for key in texts:
        found = refusals({kind: {**yaml.safe_load(LEAVES[kind].example), key: "7 parsecs"}})
        assert not any("is not a duration" in message for message in found), key


def refusals(tree: dict[str, Any]) -> list[str]:
    try:
        load(tree)
    except TreeError as error:
        return [problem.message for problem in error.problems]
    return []


def test_no_argument_has_the_name_of_a_keyword() -> None:
    names = {name for one in (*ACTIONS.values(), *MODIFIERS.values()) for name in one.arguments}
    assert not names & WORDS
    literals = {name.strip("'") for name in OpenSCENARIO2Lexer.literalNames}
    assert {word for word in literals if re.fullmatch("[A-Za-z_0-9]+", word)} <= WORDS
    assert set(tokens.REFUSED) <= literals
    assert not {*ACTIONS, *MODIFIERS} & WORDS
    assert not {*ACTIONS, *MODIFIERS} & REFUSED.keys()


# -- as scenario-execution reads it ---------------------------------------------------------------------------------


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The project's entry points, as they are where it is installed."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    metadata = tmp_path / "understudy-0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: understudy\nVersion: 0\n")
    groups = [
        "\n".join([f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())])
        for group, entries in project["entry-points"].items()
    ]
    (metadata / "entry_points.txt").write_text("\n".join(groups))
    monkeypatch.syspath_prepend(str(tmp_path))


def resolved(file: Path) -> ModelElement:
    """The model of a file with all that it imports, resolved and checked by scenario-execution."""
    logger = logging.getLogger(__name__)
    parser = OpenScenario2Parser(logger)
    model = parser.load_internal_model(parser.parse_file(str(file)), str(file))
    resolve_internal_model(model, py_trees.composites.Sequence(name="", memory=True), logger, False)
    return model


def within(element: ModelElement, *kinds: type) -> Iterator[Any]:
    """The elements of some kinds, in the order of the file."""
    if isinstance(element, kinds):
        yield element
    for child in element.get_children():
        if isinstance(child, ModelElement):
            yield from within(child, *kinds)


EVERYTHING = """
import osc.understudy

scenario healthy:
    longest: time = 500ms
    do parallel:
        topic("/cmd_vel", gap: longest)
        sensors: serial:
            topic("/scan", rate_min: 8Hz, rate_max: 0.02kHz, window: 2s)
        with:
            inverter()
            while_task_active("/go", settle: 1min)
        one_of:
            |left-camera|: diagnostics(worst: level!WARN)
            publisher("/plan", count: 2, for: 0.001h)
"""


@pytest.mark.usefixtures("installed")
def test_scenario_execution_reads_the_same_values(tmp_path: Path) -> None:
    file = tmp_path / "healthy.osc"
    file.write_text(EVERYTHING)
    model = resolved(file)
    called = [
        {name: value for name, value in found.get_resolved_value().items() if value is not None}
        for found in within(model, BehaviorInvocation, ModifierInvocation)
    ]
    assert called == [
        {"topic_name": "/cmd_vel", "gap": 0.5},
        {"topic_name": "/scan", "rate_min": 8, "rate_max": 20.0, "window": 2},
        {},
        {"action_name": "/go", "settle": 60},
        {"topic_name": "/diagnostics", "worst": ("WARN", 1)},
        {"topic_name": "/plan", "count": 2, "for": 3.6},
    ]
    topics = {topic.name: topic for topic in load_osc(EVERYTHING).topics}
    assert (topics["/scan"].window, topics["/scan"].rate) == (2.0, 20.0)


@pytest.mark.usefixtures("installed")
def test_scenario_execution_has_the_same_units(tmp_path: Path) -> None:
    file = tmp_path / "healthy.osc"
    file.write_text(EVERYTHING)
    model = resolved(file)
    for name, units in UNITS.items():
        (declared,) = (found for found in within(model, PhysicalTypeDeclaration) if found.type_name == name)
        known = {
            found.unit_name: found.get_children()
            for found in within(model, UnitDeclaration)
            if found.physical_name is declared
        }
        factors = {unit: Fraction(str(next(iter(children)).factor)) for unit, children in known.items()}
        assert factors == {unit: found.factor for unit, found in units.items()}
    assert "frequency" in OWN


TEXTS = [
    *(pytest.param(ScenarioWriter().file(one.values[0]["spec"]["monitoring"]["yaml"]), id=one.id) for one in POLICIES),
    *(
        pytest.param(item["spec"]["monitoring"]["osc"], id=item["metadata"]["name"])
        for file in sorted((REPOSITORY / "examples").rglob("osc.yaml"))
        for item in yaml.safe_load_all(file.read_text())
    ),
    *(
        pytest.param(yaml.safe_load(shown)["spec"]["monitoring"]["osc"], id="page")
        for shown in re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    ),
]


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("text", TEXTS)
def test_scenario_execution_accepts_the_trees(text: str, tmp_path: Path) -> None:
    file = tmp_path / "healthy.osc"
    file.write_text(text)
    assert list(within(resolved(file), BehaviorInvocation))
    assert load_osc(text).topics


PROCEDURES = [
    pytest.param(file.read_text(), id=file.parent.parent.name)
    for file in sorted((REPOSITORY / "examples").rglob("trees/*.osc"))
] + [
    pytest.param(shown, id="page")
    for shown in re.findall(r"```osc\n(.*?)```", (REPOSITORY / "docs" / "procedures.md").read_text(), re.DOTALL)
]


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("text", PROCEDURES)
def test_scenario_execution_accepts_the_procedures(text: str, tmp_path: Path) -> None:
    file = tmp_path / "bring_up.osc"
    file.write_text(text)
    called = [found.behavior.name for found in within(resolved(file), BehaviorInvocation)]
    assert "set_lifecycle" in called
    assert compose("osc", text, check=False, path="bringUp").tree.topics == []


@pytest.mark.usefixtures("installed")
def test_scenario_execution_accepts_every_step_and_condition(tmp_path: Path) -> None:
    file = tmp_path / "all.osc"
    calls = [f"        {name}()\n" for name in (*steps.STEPS, *steps.CONDITIONS)]
    with_ = "            timeout(duration: 1s)\n            retry(count: 3, pause: 500ms)\n"
    file.write_text(
        f"import osc.understudy\n\nscenario all_of_them:\n    do serial:\n{''.join(calls)}        resend_goals() with:\n{with_}"
    )
    assert len(list(within(resolved(file), BehaviorInvocation))) == len(calls) + 1


# -- what it costs, and what it doesn't touch -----------------------------------------------------------------------

_PARSER_LOADED = "'scenario_execution' in sys.modules or 'antlr4' in sys.modules"


def test_the_parser_is_loaded_only_for_a_policy_in_this_language() -> None:
    program = (
        "import sys\nfrom understudy.trees.languages.notations import load_health\n"
        "load_health('yaml', {'topic': {'name': '/a', 'gap': '1s'}}, grace=1)\n"
        f"assert not ({_PARSER_LOADED})\n"
        "load_health('osc', 'import osc.understudy\\nscenario a:\\n  do topic(\"/a\", gap: 1s)', grace=1)\n"
        f"assert {_PARSER_LOADED}\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


_WATCHED = """
import sys
from functools import partial

from understudy.trees.languages.notations import load_health
from understudy.trees.source.problems import TreeError

load_osc = partial(load_health, "osc", grace=30.0)
GOOD = 'import osc.understudy\\nimport osc.types\\nscenario a:\\n  do topic("/a", gap: 1s)\\n'
BAD = [
    'import "/etc/passwd"\\n' + GOOD,
    'import "../secrets.osc"\\n' + GOOD,
    'import osc.helpers\\n' + GOOD,
    'import osc.anything_installed\\n' + GOOD,
    GOOD + '  do run_process("touch /tmp/escaped")\\n',
    GOOD.replace('topic("/a", gap: 1s)', 'run_process("touch /tmp/escaped")'),
    GOOD + 'struct s:\\n  def f() is external os.system("touch /tmp/escaped")\\n',
    GOOD + 'global x: string = open("/etc/passwd")\\n',
    GOOD + '$\\n',
]
load_osc(GOOD)  # all that is imported once has been
touched = []


def watch(event, arguments):
    if event.split(".")[0] in ("open", "os", "subprocess", "socket", "shutil", "import", "exec", "compile", "ctypes", "glob"):
        touched.append((event, arguments))


sys.addaudithook(watch)
load_osc(GOOD)
for text in BAD:
    try:
        load_osc(text)
    except TreeError:
        continue
    raise SystemExit(f"loaded: {text}")
found = [one for one in touched if one[0] != "import"]
sys.stdout.write(repr(found[:3]) if found else "nothing")
"""


def test_loading_opens_no_files_starts_no_processes_and_prints_nothing() -> None:
    done = subprocess.run([sys.executable, "-c", _WATCHED], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "nothing", "")


# -- its page -------------------------------------------------------------------------------------------------------


def test_the_page_lists_every_behaviour_and_argument() -> None:
    rows = [line.split("|") for line in PAGE.splitlines() if line.startswith("| `")]
    for name, behavior in (*ACTIONS.items(), *MODIFIERS.items()):
        documented = [set(re.findall(r"`([a-z_]+)`", row[3])) for row in rows if f"`{name}()`" in row[1]]
        assert documented, f"{name}() is missing in the table of docs/trees-osc.md"
        assert set(behavior.arguments) <= documented[0], (
            f"arguments of {name}() are missing in the table of docs/trees-osc.md"
        )
    for type_, units in UNITS.items():
        assert set(units) <= set(re.findall(r"`([A-Za-z]+)`", PAGE)), type_
    documented = set(re.findall(r"`([a-z_]+![A-Za-z]+)`", PAGE))
    assert {f"{enum}!{member}" for enum, members in ENUMS.items() for member in members} <= documented


def test_the_documented_mistakes_are_reported() -> None:
    *_, shown = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    text = (
        "import osc.understudy\n\nscenario healthy:\n    do parallel:\n"
        '        topik("/scan", gap: 1s)\n        topic("/cmd_vel", gap: 500)\n'
    )
    with pytest.raises(TreeError) as caught:
        load_osc(text)
    assert [str(problem) for problem in caught.value.problems] == shown.splitlines()

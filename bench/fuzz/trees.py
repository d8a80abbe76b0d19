"""Health trees, procedures and checks in the three languages, valid ones and mutated ones.

A tree is drawn in the short form, by the declarations of all leaves and steps, and is written in one of the languages.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any
from xml.sax.saxutils import quoteattr

import yaml
from hypothesis import strategies as st

from bench.fuzz import values
from bench.fuzz.values import Strategy, one_of
from understudy.trees.languages.osc.tokens import MOST as MOST_TOKENS
from understudy.trees.leaves.leaf_plan import Key
from understudy.trees.leaves.procedure_leaves import CONDITIONS, STEPS
from understudy.trees.leaves.registry import LEAVES

RATES = ("> 8 Hz", ">= 8 Hz", "< 20 Hz", "9 to 11 Hz", "> 1e308 Hz", "11 to 9 Hz", "> NaN Hz", "> 0 Hz", "8", "> 8 kHz")
AMOUNTS = ("0.5 m/s2", "20 %", "0.03 m/s", "1 rad/s2", "1e400 m/s", "-1 %", "0.1 rad/s")
LIMITS = ("< 1.5", "< 200Mi", "> 0.2", "0.2 to 0.3", "< 1e99", "0.3 to 0.2", "a; b", "1; 2; 3")

_ATOMS = (
    "percentage", "pose.pose.position.x", "ranges[0]", "ranges[-1]", "header.stamp.sec", "0.15", "1e308", "2**64", "True", "'a'",
    "ranges[99999999999999999999]", "x.y" * 40, "0x" + "f" * 100, "1_0", "nan", "é", "self", "().__class__", "b'a'", "1j", "...",
)  # fmt: skip
_OPERATORS = (
    " > ",
    " < ",
    " == ",
    " != ",
    " + ",
    " - ",
    " * ",
    " / ",
    " % ",
    " and ",
    " or ",
    " ** ",
    " @ ",
    " in ",
    " is ",
    " << ",
)

expressions: Strategy = st.one_of(
    st.recursive(
        one_of(*_ATOMS),
        lambda inner: st.one_of(
            st.builds(lambda left, sign, right: f"{left}{sign}{right}", inner, one_of(*_OPERATORS), inner),
            st.builds(
                lambda name, of: f"{name}({of})",
                one_of("abs", "min", "max", "len", "sqrt", "isfinite", "not ", "-", "eval", "any", ""),
                inner,
            ),
            st.builds(lambda of, over: f"any({of} for e in {over})", inner, inner),
            st.builds(lambda of, index: f"{of}[{index}]", inner, inner),
        ),
        max_leaves=12,
    ),
    one_of(
        "(" * 300 + "1" + ")" * 300, "a" + ".b" * 240, "not " * 120 + "a", "a" + " > a" * 100, "-" * 400 + "1", "a if b else c",
        "lambda: 1", "a\nand b", "[" * 200, "f'{a}'", "a := 1", "x > 0 # comment", "\x00", "a" + "[0]" * 150, "1" + "*9" * 200,
        "any(any(any(any(any(True for a in b) for b in c) for c in d) for d in e) for e in f)",
    ),
)  # fmt: skip
"""Conditions over the fields of a message."""

_BY_TYPE: Mapping[str, Strategy] = {
    "time": values.durations,
    "int": st.one_of(st.integers(0, 12), values.numbers, values.texts),
    "float": st.one_of(one_of(0.3, 1.0), values.numbers, values.texts),
    "frequency": one_of(*RATES),
    "structure": values.structures,
    "names": st.one_of(st.lists(values.names, max_size=3), values.structures),
}
_BY_NAME: Mapping[str, Strategy] = {
    **dict.fromkeys(("topic", "commands", "node", "service", "action", "name"), values.names),
    "type": values.types,
    **dict.fromkeys(("holds", "recovers"), expressions),
    **dict.fromkeys(("acceleration", "turn_acceleration", "slip", "tolerance", "turn_tolerance"), one_of(*AMOUNTS)),
    **dict.fromkeys(("cpu", "memory", "between", "one_of", "equals"), one_of(*LIMITS)),
    "says": one_of("*", "a*b*c", "*" * 200, "**a" * 60, "failed", "(a+)+$", "x" * 500),
}


def _of_key(key: Key) -> Strategy:
    if key.members:
        return st.one_of(one_of(*key.members), one_of(*key.members), values.texts)
    return _BY_NAME.get(key.name, _BY_TYPE.get(key.type, values.texts))


def _leaf(kind: str, keys: tuple[Key, ...], example: Mapping[str, Any]) -> Strategy:
    """Return leaves of a kind: the example with some keys replaced, added or removed."""
    drawn = st.lists(st.one_of([st.tuples(st.just(key.name), _of_key(key)) for key in keys]), max_size=3)
    without = st.one_of(st.just(""), st.just(""), st.just(""), one_of(*example) if example else st.just(""))
    return st.builds(
        lambda given, left_out: {
            kind: {key: value for key, value in {**example, **dict(given)}.items() if key != left_out}
        },
        drawn if keys else st.just([]),
        without,
    )


_EXAMPLES: Mapping[str, Mapping[str, Any]] = {
    "set_lifecycle": {"node": "/amcl", "state": "active"},
    "call_service": {"service": "/run", "type": "std_srvs/srv/SetBool", "request": {"data": True}},
    "publish": {"topic": "/initialpose", "type": "std_msgs/msg/String", "message": {"data": "a"}},
    "set_parameters": {"node": "/amcl", "values": {"a": 1}},
    "wait_for": {"node": "/amcl"},
    "restore_state": {},
    "resend_goals": {},
    "lifecycle_is": {"node": "/amcl", "state": "active"},
    "node_present": {"node": "/amcl"},
    "service_present": {"service": "/run"},
    "parameter_is": {"node": "/amcl", "name": "a", "value": 1},
}

health_leaves = st.one_of([_leaf(kind.name, kind.arguments, yaml.safe_load(kind.example)) for kind in LEAVES.values()])
procedure_leaves = st.one_of(
    [_leaf(name, kind.arguments, _EXAMPLES[name]) for name, kind in {**STEPS, **CONDITIONS}.items()]
)

_NODE_NAMES = st.one_of(one_of("sensors", "a", "b.c", "d-e"), values.texts)


def _health_node(inner: Strategy) -> Strategy:
    nodes = st.lists(inner, max_size=4)
    named = st.one_of(st.just({}), st.just({}), st.builds(lambda name: {"name": name}, _NODE_NAMES))
    return st.one_of(
        st.builds(lambda key, found, name: {key: found, **name}, one_of("parallel", "sequence", "selector"), nodes, named),
        st.builds(lambda node: {"inverter": node}, inner),
        st.builds(
            lambda action, node, settle: {"while": {"task_active": {"action": action}}, "do": node, **settle},
            values.names, inner, st.one_of(st.just({}), st.builds(lambda time: {"settle": time}, values.durations)),
        ),
    )  # fmt: skip


def _procedure_node(inner: Strategy) -> Strategy:
    nodes = st.lists(inner, max_size=4)
    return st.one_of(
        st.builds(lambda key, found: {key: found}, one_of("parallel", "sequence", "selector"), nodes),
        st.builds(lambda node: {"inverter": node}, inner),
        st.builds(lambda within, node: {"timeout": {"within": within, "do": node}}, values.durations, inner),
        st.builds(
            lambda times, wait, node: {"retry": {"times": times, "do": node, "wait": wait}},
            st.one_of(st.integers(1, 5), values.numbers), values.durations, inner,
        ),
    )  # fmt: skip


def _deep(leaf: Any, levels: int) -> Any:
    for _ in range(levels):
        leaf = {"inverter": leaf}
    return leaf


def _nodes(leaves: Strategy, node: Any) -> Strategy:
    tree = st.recursive(leaves, node, max_leaves=10)
    return st.one_of(
        tree, tree, tree, tree,
        st.builds(_deep, leaves, one_of(20, 31, 33, 120)),
        st.builds(lambda leaf, count: {"parallel": [leaf] * count}, leaves, one_of(3, 100, 510, 600)),
        st.builds(lambda found, extra: {**found, **extra}, tree, st.dictionaries(values.texts, values.hostile, max_size=2)),
        st.builds(lambda value: value if isinstance(value, dict) and value else {"topic": value}, values.hostile),
    )  # fmt: skip


health = _nodes(health_leaves, _health_node)
"""Nodes of health trees in the short form."""

procedures = _nodes(st.one_of(procedure_leaves, procedure_leaves, health_leaves), _procedure_node)
"""Nodes of procedures and checks in the short form."""


# -- BehaviorTree.CPP -----------------------------------------------------------------------------------------------------

_TAGS = {"parallel": "Parallel", "sequence": "Sequence", "selector": "Fallback", "inverter": "Inverter"}
_PORTS = {
    (name, key.name): key.port
    for name, kind in (*LEAVES.items(), *STEPS.items(), *CONDITIONS.items())
    for key in kind.arguments
}


def as_xml(node: Any) -> str:
    """Return a document with one tree."""
    return f'<?xml version="1.0"?>\n<root BTCPP_format="4">\n<BehaviorTree ID="Main">\n{_element(node)}\n</BehaviorTree>\n</root>\n'


def _element(node: Any) -> str:
    if not isinstance(node, Mapping) or not node:
        return f"<Script code={_quoted(node)}/>"
    kind, value = next(iter(node.items()))
    if kind in ("parallel", "sequence", "selector"):
        return (
            f"<{_TAGS[kind]}>{''.join(map(_element, value))}</{_TAGS[kind]}>"
            if isinstance(value, list)
            else "<Parallel/>"
        )
    if kind == "inverter":
        return f"<Inverter>{_element(value)}</Inverter>"
    if kind == "while":
        return f"<WhileTaskActive{_attributes(kind, value.get('task_active'))}>{_element(node.get('do'))}</WhileTaskActive>"
    if kind in ("timeout", "retry") and isinstance(value, Mapping):
        tag = "Timeout msec" if kind == "timeout" else "RetryUntilSuccessful num_attempts"
        limit = value.get("within", value.get("times"))
        return f"<{tag}={_quoted(limit)}>{_element(value.get('do'))}</{tag.split()[0]}>"
    tag = "".join(part.capitalize() for part in str(kind).split("_"))
    return f"<{tag}{_attributes(kind, value)}/>"


def _attributes(kind: str, fields: Any) -> str:
    if not isinstance(fields, Mapping):
        return f" value={_quoted(fields)}"
    return "".join(f" {_PORTS.get((kind, key), key)}={_quoted(value)}" for key, value in fields.items())


def _quoted(value: Any) -> str:
    return quoteattr(value if isinstance(value, str) else f"json:{json.dumps(value)}")


_USES = '<SubTree ID="b"/>' * 8
XML_PIECES = (
    '<!DOCTYPE root [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>', "&a;", "&#0;", "&#x110000;", "<![CDATA[",
    "]]>", "<!--", "-->", "<?php ?>", '<include path="/etc/passwd"/>', '<SubTree ID="Main"/>', '<SubTree ID="b" _autoremap="true"/>',
    f'</BehaviorTree><BehaviorTree ID="b"><Sequence>{_USES}</Sequence></BehaviorTree><BehaviorTree ID="c">', ' name="{a}"',
    ' _skipIf="a"', "<TreeNodesModel>", '<Topic topic="{t}" gap="{g}"/>', "<Inverter>" * 60, "</Inverter>" * 60, "<a>" * 3000,
    ' xmlns:a="b"', "<", ">", '"', "'", "/>", ' ID="Main"', 'encoding="utf-16"', 'encoding="utf-7"', " a='1'" * 2000, "\x00", "&lt;",
    '<Condition ID="Topic"/>', '<Parallel success_count="{n}" failure_count="-1">', "&b;" * 100,
)  # fmt: skip


# -- OpenSCENARIO 2 -------------------------------------------------------------------------------------------------------

_OSC_BLOCKS = {"parallel": "parallel", "sequence": "serial", "selector": "one_of"}
_OSC_NAMES = {
    "topic": "topic_name",
    "service": "service_name",
    "only": "names",
    "type": "topic_type",
    "action": "action_name",
}


def as_osc(node: Any) -> str:
    """Return a file with one scenario."""
    first, *rest = _lines(node, 1, [])
    return "\n".join(["import osc.understudy", "scenario main:", f"    do {first.strip()}", *rest, ""])


def _lines(node: Any, depth: int, modifiers: list[str]) -> list[str]:
    indent = "    " * min(depth, 60)
    if not isinstance(node, Mapping) or not node:
        return [f"{indent}emit {node!r}"]
    kind, value = next(iter(node.items()))
    if kind in _OSC_BLOCKS and isinstance(value, list):
        inside = [line for child in value for line in _lines(child, depth + 1, [])]
        return [f"{indent}{_OSC_BLOCKS[kind]}:", *inside, *_with(indent, modifiers)]
    if kind == "inverter":
        return _lines(value, depth, [*modifiers, "inverter()"])
    if kind == "while" and isinstance(value, Mapping):
        action = _argument("action", (value.get("task_active") or {}).get("action"))
        return _lines(node.get("do"), depth, [*modifiers, f"while_task_active({action})"])
    if kind == "timeout" and isinstance(value, Mapping):
        return _lines(value.get("do"), depth, [*modifiers, f"timeout({value.get('within')})"])
    if kind == "retry" and isinstance(value, Mapping):
        return _lines(value.get("do"), depth, [*modifiers, f"retry({value.get('times')}, pause: {value.get('wait')})"])
    fields = value if isinstance(value, Mapping) else {"value": value}
    arguments = ", ".join(f"{_osc_name(kind, key)}: {_argument(key, one)}" for key, one in fields.items())
    return [f"{indent}{kind}({arguments}){' with:' if modifiers else ''}", *(f"{indent}    {one}" for one in modifiers)]


def _with(indent: str, modifiers: list[str]) -> list[str]:
    return [f"{indent}with:", *(f"{indent}    {one}" for one in modifiers)] if modifiers else []


def _osc_name(kind: str, key: str) -> str:
    if key == "name":
        return {"topic": "topic_name", "node": "node", "diagnostics": "status"}.get(kind, "parameter")
    return "service_type" if (kind, key) == ("call_service", "type") else _OSC_NAMES.get(key, str(key))


def _argument(key: str, value: Any) -> str:
    if key in ("for", "gap", "within", "window", "most", "at_most", "settle", "delay", "quiet", "repeat"):
        return str(value)
    if key == "state":
        return f"lifecycle_state!{value}"
    if key in ("level", "worst", "by") and isinstance(value, str):
        return f"{ {'level': 'severity', 'worst': 'level'}.get(key, 'age_by') }!{value}"
    if isinstance(value, bool | int | float):
        return str(value).lower()
    text = value if isinstance(value, str) else json.dumps(value)
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


OSC_PIECES = (
    "import osc.standard", "import osc.types", "import /etc/passwd", "import 'http://a'", "scenario main:", "    do ", "parallel:",
    "serial:", "one_of:", "with:", "keep(a == b)", "var a: time = 1s", "a: time = 1s", "event e", "emit e", "until @e", "until rise(a)",
    "enum e: [a, b]", "extend a:", "actor b", "cover(a)", "1s", "1e400s", "0.1ms", "5kHz", "99999999999999999999", "0x1F", "'", '"',
    '"""', "\\", "\t", "\r", "    " * 70, "#", "(" * 500, "[" * 500, "$", "..", "@", "!", "?", "->", "[1..2]", "\x00", "é", "\u2028",
    " + ".join(["1"] * 300), "- " * 200, "." * MOST_TOKENS, "do main()", "topic('/a', gap: 1s)", "not " * 200, "it.a", "a ? b : c",
    "def f() -> int is external a.b()", "wait elapsed(1s)", "global x: int = 1",
)  # fmt: skip


# -- texts of files -------------------------------------------------------------------------------------------------------

YAML_PIECES = (
    "&a ", "*a", "<<: *a\n", "!!python/object/apply:os.system [true]", "!!binary aGk=", "!!set {a}", "!a ", "? ", ": ", "- ", "\t", "|\n",
    ">\n", "%YAML 1.9\n---\n", "---\n", "...\n", "{", "}", "[", "]", "'", '"', '"\\ud800"', '"\\UFFFFFFFF"', "0x" + "f" * 200, "~",
    "2001-01-01", "1:30", "{? a : b}", "[" * 200, "{a: " * 200, "- " * 400, "a: &x [*x]", "&a [" + "&b [" * 20, "\x00", "\ufeff",
    "\u0085", "#", "@", "`", "a: 1\na: 2\n", "yes", "1e400", ".nan", "[*a,*a,*a,*a,*a,*a,*a,*a,*a]", "9" * 5000, "_1_", "? [a]\n: b\n",
)  # fmt: skip


def as_yaml(node: Any) -> str:
    """Return the text of a tree in the short form."""
    return json.dumps(node) if len(json.dumps(node)) % 2 else yaml.safe_dump(node, allow_unicode=False)


_WRITERS = {"yaml": (as_yaml, YAML_PIECES), "xml": (as_xml, XML_PIECES), "osc": (as_osc, OSC_PIECES)}

Edit = tuple[float, int, str]
"""Where, as a fraction of the text; how many characters are replaced; by what."""


def _edited(text: str, edits: list[Edit]) -> str:
    for place, length, piece in edits:
        start = int(place * len(text))
        text = text[:start] + (piece or text[start : start + length] * 2) + text[start + length :]
    return text


def texts(form: str, nodes: Strategy) -> Strategy:
    """Return texts of trees in a language: as they are written, with edits, and texts that are no trees."""
    write, pieces = _WRITERS[form]
    written = nodes.map(write)
    edits = st.lists(
        st.tuples(
            st.floats(0, 1, exclude_max=True),
            one_of(0, 0, 1, 5, 40, 400),
            st.one_of(one_of(*pieces), one_of(*pieces), values.texts, st.just("")),
        ),
        min_size=1,
        max_size=4,
    )
    return st.one_of(
        written, st.builds(_edited, written, edits), st.builds(_edited, written, edits), values.hostile_texts
    )


def written(nodes: Strategy) -> Strategy:
    """Return trees with the field that holds them: one language, and sometimes none or two."""
    fields = {
        "yaml": st.builds(lambda tree: {"yaml": tree}, nodes),
        "xml": st.builds(lambda tree: {"xml": tree}, texts("xml", nodes)),
        "osc": st.builds(lambda tree: {"osc": tree}, texts("osc", nodes)),
    }
    return st.one_of(*fields.values())

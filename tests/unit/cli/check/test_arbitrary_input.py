"""Whatever a file contains: it has findings, and never a traceback."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.unit.cli.check.manifests import POLICY, POOL, WORKLOAD
from understudy.cli.check.command import Result, check
from understudy.trees.languages.short.health_loader import KINDS
from understudy.trees.languages.short.procedure_loader import COMPOSITES, CONDITIONS, DECORATORS, STEPS

MANIFESTS = [yaml.safe_load(text) for text in (POLICY, WORKLOAD, POOL)]

often = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])

_FIELDS = """apiVersion kind metadata name labels spec monitoring yaml xml strategies type topic outputs readiness template
workloadSelector matchExpressions containers Restart 500ms /scan recovery bringUp items List poolRef failurePolicyRef
Auto requirements safety"""
_WORDS = st.sampled_from([*_FIELDS.split(), *KINDS, *COMPOSITES, *CONDITIONS, *DECORATORS, *STEPS])
_SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.dates() | _WORDS
_VALUES = st.recursive(
    _SCALARS,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(_WORDS | st.integers() | st.text(max_size=3), inner, max_size=4)
    ),
    max_leaves=20,
)


def _sound(result: Result) -> None:
    for finding in result.findings:
        assert str(finding).isprintable()
        assert finding.place >= (1, 1)
        assert finding.message


def _paths(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(inner for key, item in items for inner in _paths(item, (*path, key)))]


def _with(value: Any, path: tuple[Any, ...], other: Any) -> Any:
    if not path:
        return other
    key, *rest = path
    changed = value.copy()
    changed[key] = _with(value[key], tuple(rest), other)
    return changed


@often
@given(st.binary(max_size=200))
def test_arbitrary_bytes_give_findings(content: bytes) -> None:
    _sound(check([("a.yaml", content)]))


@often
@given(st.text(alphabet="ab:-?#&*!|>'\"%@`{}[],<~ \t\n\r\\./0.1e\x85\u2028é", max_size=60), st.integers(0, 300))
def test_arbitrary_text_in_a_manifest_gives_findings(text: str, where: int) -> None:
    _sound(check([("a.yaml", f"{POLICY[:where]}{text}{POLICY[where:]}".encode())]))


@often
@given(st.lists(_VALUES, max_size=3))
def test_arbitrary_documents_give_findings(values: list[Any]) -> None:
    _sound(check([("a.yaml", yaml.safe_dump_all(values).encode("utf-8", "replace"))]))


@often
@given(st.data())
def test_manifests_with_an_arbitrary_value_give_findings(data: st.DataObject) -> None:
    files = []
    for number, manifest in enumerate(MANIFESTS):
        path = data.draw(st.sampled_from(_paths(manifest)))
        text = yaml.safe_dump(_with(manifest, path, data.draw(_VALUES)), default_flow_style=data.draw(st.booleans()))
        files.append((f"{number}.yaml", text.encode("utf-8", "replace")))
    _sound(check(files))


@often
@given(st.text(max_size=80), st.sampled_from(["|", "|-", "'", '"', ">"]))
def test_arbitrary_xml_gives_findings(text: str, style: str) -> None:
    policy = MANIFESTS[0] | {"spec": {"monitoring": {"xml": f"<root BTCPP_format='4'>\n{text}"}, "strategies": []}}
    dumped = yaml.dump(policy, Dumper=_dumper(style[0]), allow_unicode=True)
    _sound(check([("a.yaml", dumped.encode("utf-8", "replace"))]))


@often
@given(st.text(max_size=80), st.sampled_from(["|", "|-", "'", '"', ">"]))
def test_arbitrary_openscenario_gives_findings(text: str, style: str) -> None:
    tree = f"import osc.understudy\nscenario a:\n    do {text}\n"
    policy = MANIFESTS[0] | {"spec": {"monitoring": {"osc": tree}, "strategies": []}}
    dumped = yaml.dump(policy, Dumper=_dumper(style[0]), allow_unicode=True)
    _sound(check([("a.yaml", dumped.encode("utf-8", "replace"))]))


def _dumper(style: str) -> type[yaml.SafeDumper]:
    class Dumper(yaml.SafeDumper):
        """Writes texts of several lines in one style."""

    def represent(dumper: yaml.SafeDumper, text: str) -> yaml.Node:
        return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style if "\n" in text else None)

    Dumper.add_representer(str, represent)
    return Dumper


@pytest.mark.parametrize(
    "value", ["0x" + "f" * 5000, "9" * 5000, r'"\UFFFFFFFF"', r'"\ud800"', "1.0e+400"], ids=lambda value: value[:20]
)
@pytest.mark.parametrize("place", ["{parallel: %s}", "{topic: {name: /cmd_vel, gap: %s}}"])
def test_values_that_python_cannot_write_give_findings(value: str, place: str) -> None:
    result = check([("a.yaml", POLICY.replace("{topic: {name: /cmd_vel, gap: 500ms}}", place % value).encode())])
    assert result.errors
    _sound(result)
    assert all(len(finding.message) < 500 for finding in result.findings)


@pytest.mark.parametrize(
    "key", ["? 0x" + "f" * 5000 + "\n: 1\n", "%YAML 1." + "9" * 5000 + "\n---\na: 1\n"], ids=["key", "directive"]
)
def test_keys_and_directives_that_python_cannot_write_give_findings(key: str) -> None:
    result = check([("a.yaml", key.encode())])
    assert result.findings
    _sound(result)

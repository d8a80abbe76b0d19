"""What is found in manifests, where, and what would be right."""

from __future__ import annotations

import pytest

from tests.support.golden import assert_golden
from tests.unit.cli.check.manifests import POLICY, POOL, WORKLOAD, checked, found, only, text, workload
from understudy.cli.check.command import check


def _lines(*texts: str) -> list[str]:
    return [str(finding) for finding in found(*texts)]


def test_a_valid_manifest_has_no_findings() -> None:
    result = checked(f"{POLICY}---\n{WORKLOAD}", POOL)
    assert result.findings == []
    assert_golden("check", result.totals(), "3 objects", "2 files", "0 errors", "0 warnings")


def test_a_field_deep_in_a_tree_has_its_line_and_column() -> None:
    policy = text("""
        apiVersion: understudy.dev/v1alpha1
        kind: FailurePolicy
        metadata: {name: navigation}
        spec:
          monitoring:
            yaml:
              parallel:
                - topic: {name: /cmd_vel, gap: 500ms}
                - topic: {name: /scan, gapp: 1s}
          strategies:
            - {type: Restart, recovery: {yaml: {sequence: [{set_lifecycle: {node: /drive, state: on}}]}}}
        """)
    missing, unknown, state = _lines(policy)
    assert_golden(
        "check",
        unknown,
        "a.yaml:9:32: error",
        "FailurePolicy",
        "spec.monitoring.yaml.parallel[1].topic.gapp",
        "'gapp'",
        "'gap'",
    )
    assert_golden("check", missing, "a.yaml:9:11: error", "FailurePolicy", "spec.monitoring.yaml.parallel[1].topic")
    assert_golden(
        "check",
        state,
        "a.yaml:11:83: error",
        "FailurePolicy",
        "spec.strategies[0].recovery.yaml.sequence[0].set_lifecycle.state",
    )
    assert 'write "on"' in state


def _xml(value: str) -> str:
    return POLICY.replace("yaml: {topic: {name: /cmd_vel, gap: 500ms}}", f"xml: {value}")


BLOCK = """|
      <root BTCPP_format="4">
        <BehaviorTree ID="Healthy">
          <Topic topic="/cmd_vel" gap="0.5"/>
        </BehaviorTree>
      </root>"""


@pytest.mark.parametrize(
    ("block", "line"),
    [
        (BLOCK, 9),
        (BLOCK.replace("|", "|-", 1), 9),
        (BLOCK.replace("|", "|2  # Groot", 1).replace("      <root", "        <root"), 9),
        (BLOCK.replace("|", "|\n", 1), 10),
        (BLOCK.replace("|", "&tree |", 1), 9),
    ],
    ids=["plain", "chomped", "indented", "after-an-empty-line", "anchored"],
)
def test_places_in_xml_refer_to_the_file(block: str, line: int) -> None:
    finding = only(_xml(block))
    assert (finding.place.line, finding.place.column) == (line, 11)
    assert finding.field == "spec.monitoring.xml"
    assert_golden("check", finding.message, "'0.5'")


def test_malformed_xml_is_reported_in_its_line() -> None:
    finding = only(_xml(BLOCK.replace("</BehaviorTree>", "</BehaviourTree>")))
    assert (finding.place.line, finding.field) == (10, "spec.monitoring.xml")
    assert "mismatched tag" in finding.message


def test_columns_in_one_line_of_xml_refer_to_the_file() -> None:
    inner = '<root BTCPP_format="4"><BehaviorTree ID="H"><Topic topic="/cmd_vel" gap="0.5"/></BehaviorTree></root>'
    policy = _xml(f"'{inner}'")
    finding = only(policy)
    assert policy.splitlines()[finding.place.line - 1][finding.place.column - 1 :].startswith("<Topic ")


def test_a_place_in_folded_xml_is_given_as_a_line_of_the_text() -> None:
    finding = only(_xml('"<root BTCPP_format=\\"4\\">\\n<BehaviorTree ID=\\"H\\"><Nope/></BehaviorTree></root>"'))
    assert (finding.place.line, finding.place.column) == (6, 5)
    assert finding.field.startswith("spec.monitoring.xml, line 2, column ")


def test_places_in_openscenario_refer_to_the_file() -> None:
    policy = POLICY.replace(
        "    yaml: {topic: {name: /cmd_vel, gap: 500ms}}\n",
        "    osc: |\n      import osc.understudy\n      scenario healthy:\n          do parallel:\n"
        '              topic("/cmd_vel", gap: 0.5)\n              topik()\n',
    )
    lines = policy.splitlines()
    gap, unknown = found(policy)
    assert lines[gap.place.line - 1][gap.place.column - 1 :] == "0.5)"
    assert lines[unknown.place.line - 1][unknown.place.column - 1 :] == "topik()"
    assert gap.field == unknown.field == "spec.monitoring.osc"
    assert unknown.message == "topik(): unknown behaviour, did you mean 'topic'?"


def test_an_invalid_expression_is_reported_at_its_place() -> None:
    policy = POLICY.replace(
        "{topic: {name: /cmd_vel, gap: 500ms}}",
        "{value: {topic: /battery, type: sensor_msgs/msg/BatteryState, holds: 'percentage > 0.15 and'}}",
    )
    finding = only(policy)
    assert finding.field == "spec.monitoring.yaml.value.holds"
    assert (finding.place.line, finding.place.column) == (6, policy.splitlines()[5].index("holds") + 1)


@pytest.mark.parametrize("field", ["bringUp", "initialization", "readinessCheck"])
def test_mistakes_in_procedures_and_checks_are_reported(field: str) -> None:
    base = workload("robot-18") if field == "bringUp" else POOL
    finding = only(POLICY, WORKLOAD, f"{base}  {field}: {{yaml: {{set_lifecycl: {{}}}}}}\n")
    assert finding.field == f"spec.{field}.yaml.set_lifecycl"
    assert finding.file == "c.yaml"


def test_a_check_with_an_action_is_refused() -> None:
    step = "{yaml: {set_lifecycle: {node: /drive, state: active}}}"
    assert [one.field for one in found(POLICY, WORKLOAD, f"{POOL}  initialization: {step}\n")] == []
    assert only(POLICY, WORKLOAD, f"{POOL}  readinessCheck: {step}\n").field.startswith("spec.readinessCheck.yaml")


def test_mistakes_that_only_the_operator_refuses_are_reported() -> None:
    reflex = only(POLICY, WORKLOAD + "  gate: {reflex: {}}\n")
    template = "template: {spec: {containers: [{name: understudy-agent, image: i}]}}"
    taken = only(POLICY, WORKLOAD.replace("workloadRef: {kind: Deployment, name: nav2}", template))
    assert reflex.field == "spec.gate.reflex"
    assert "workloadRef" in reflex.message
    assert taken.field == "spec.template.spec.containers[0].name"
    assert_golden("check", taken.message, "understudy-agent")


@pytest.mark.parametrize("annotation", ["k8s.v1.cni.cncf.io/networks", "v1.multus-cni.io/default-network"])
def test_a_template_with_networks_that_no_gate_controls_is_reported_at_its_annotation(annotation: str) -> None:
    spec = "spec: {containers: [{name: app, image: app, command: [run]}]}"
    template = f"template: {{metadata: {{annotations: {{{annotation}: robot-lan}}}}, {spec}}}"
    workload = WORKLOAD.replace("workloadRef: {kind: Deployment, name: nav2}", template)
    pool = POOL.replace("Executing", "Uninitialized").replace("perWorkload", "replicas") + f"  {template}\n"
    for finding in (only(POLICY, workload), only(POLICY, WORKLOAD, pool)):
        assert finding.severity == "error"
        assert finding.field == f"spec.template.metadata.annotations[{annotation}]"
        assert finding.place is not None
        assert "Remove it" in finding.message


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            ("name: navigation}", "name: Navigation}"),
            'a.yaml:3:12: error: FailurePolicy Navigation: metadata.name: "Navigation": the name of an object must consist of lower-case',
        ),
        (
            ("name: navigation}", "labels: {a: true}, name: b}"),
            "a.yaml:3:21: error: FailurePolicy b: metadata.labels.a: found True; must be of type string",
        ),
        (
            ("name: navigation}", 'labels: {app: "a:b"}, name: b}'),
            'a.yaml:3:21: error: FailurePolicy b: metadata.labels.app: "a:b": a label consists of letters, digits, dashes',
        ),
        (
            ("name: navigation}", "label: {a: b}, name: b}"),
            "a.yaml:3:12: error: FailurePolicy b: metadata.label: unknown field 'label', did you mean 'labels'?",
        ),
        (
            ("strategies:", "strategys:"),
            "a.yaml:7:3: error: FailurePolicy navigation: spec.strategys: unknown field 'strategys', did you mean 'strategies'?",
        ),
        (
            ("{name: navigation}", "{}"),
            "a.yaml:3:1: error: FailurePolicy (no name): metadata.name: missing; set a name",
        ),
        (
            ("v1alpha1", "v1"),
            "a.yaml:1:1: error: FailurePolicy navigation: apiVersion: found 'understudy.dev/v1'; "
            "give understudy.dev/v1alpha1",
        ),
        (
            ("FailurePolicy", "FailurePolcy"),
            "a.yaml:2:1: error: FailurePolcy navigation: kind: found 'FailurePolcy', did you mean 'FailurePolicy'?",
        ),
        (
            ("  strategies", "  startupGrace: 5s\n  strategies"),
            "a.yaml:7:3: error: FailurePolicy navigation: spec.startupGrace: unknown field 'startupGrace' here; it belongs to "
            "spec.monitoring.startupGrace: check the indentation",
        ),
        (
            ("  strategies", "  limits: {cooldown: 5}\n  strategies"),
            "spec.limits.cooldown: found 5; must be of type string (a text, in quotes if it looks like a number): "
            "write a duration as a number with ms, s, m or h",
        ),
    ],
    ids=["name", "label", "label-value", "metadata", "required", "no-name", "version", "kind", "elsewhere", "number"],
)
def test_mistakes_that_the_api_server_refuses_are_reported(change: tuple[str, str], line: str) -> None:
    assert line in str(only(POLICY.replace(*change)))


def test_a_missing_spec_is_an_error() -> None:
    for spec in ("", "spec:\n", "spec: {}\n"):
        findings = found(POLICY[: POLICY.index("spec:")] + spec)
        assert findings
        assert all(finding.severity == "error" for finding in findings)


# -- files --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("node", ["/fork/mission: {}", "fork: {{mission: {}}}", "/**: {}"])
def test_a_file_of_ros_parameters_is_skipped_silently(node: str) -> None:
    result = checked(POLICY, node.format("{ros__parameters: {speed: 0.6}}"))
    assert (result.findings, result.skipped) == ([], 1)


def test_other_kinds_are_skipped_and_counted() -> None:
    config = "apiVersion: v1\nkind: ConfigMap\nmetadata: {name: a}\ndata: {a: b, nobody: [knows]}\n"
    result = checked(f"---\n{config}---\n{POLICY}---\n")
    assert result.findings == []
    assert (result.checked, result.skipped, result.files) == (1, 1, 1)
    assert_golden(
        "check", result.totals(), "1 object checked in 1 file", "1 object of other kinds", "0 errors", "0 warnings"
    )


def test_the_items_of_a_list_are_checked() -> None:
    items = "".join(
        "- " + one.replace("\n", "\n  ").rstrip() + "\n" for one in (POLICY, WORKLOAD.replace("Twist", "twist"))
    )
    result = checked(f"apiVersion: v1\nkind: List\nitems:\n{items}")
    (finding,) = result.findings
    assert result.checked == 2
    assert finding.field == "spec.outputs[0].type"
    assert (finding.place.line, finding.place.column) == (18, 27)


@pytest.mark.parametrize(
    ("content", "place", "message"),
    [
        (b"", (1, 1), "the file is empty"),
        (b"---\n# only words\n---\n", (1, 1), "the file is empty"),
        (b"a:\n\tb: 1\n", (2, 1), "indent with spaces"),
        (b"a: {b: 1\n", (2, 1), "started in line 1, column 4"),
        (b"a: b: c\n", (1, 5), "quote a text"),
        (b"{{- if .Values.robot }}\n", (1, 3), "helm template ... | understudy check -"),
        (b"a: *nobody\n", (1, 4), "found undefined alias"),
        (b"a: \x00\n", (1, 4), "which YAML does not allow"),
        (b"a: b\nc: \xff\n", (2, 4), "the file is not UTF-8"),
        (b"- a\n- b\n", (1, 1), "found a list; a manifest is a mapping"),
        (b"--- 42\n", (1, 5), "found a text or number; a manifest is a mapping"),
        (b"a: b\n", (1, 1), "missing, so this document is skipped"),
        (b"[" * 5000, (1, 1), "nested too deeply"),
    ],
    ids=[
        "empty",
        "comments",
        "tab",
        "open",
        "colons",
        "helm",
        "alias",
        "zero",
        "latin-1",
        "list",
        "number",
        "no-kind",
        "deep",
    ],
)
def test_a_file_without_a_manifest_is_reported(content: bytes, place: tuple[int, int], message: str) -> None:
    (finding,) = check([("a.yaml", content)]).findings
    assert message in finding.message
    assert tuple(finding.place) == place


def test_documents_before_a_syntax_error_are_checked() -> None:
    kind, syntax = found(f"{POLICY.replace('FailurePolicy', 'FailurePolcy')}---\na: [\n")
    assert kind.field == "kind"
    assert syntax.message.startswith("this is not valid YAML")


def test_a_duplicate_key_is_reported() -> None:
    finding = only(POLICY.replace("  strategies", "  limits: {cooldown: 1s, cooldown: 2s}\n  strategies"))
    assert (finding.field, tuple(finding.place)) == ("spec.limits.cooldown", (7, 26))
    assert_golden("check", finding.message, "line 7")


def test_aliases_are_checked_like_the_values_they_stand_for() -> None:
    policy = text("""
        apiVersion: understudy.dev/v1alpha1
        kind: FailurePolicy
        metadata: {name: navigation}
        spec:
          monitoring: {yaml: {topic: {name: /a, gap: 1s}}, debounce: &time 5 s}
          strategies:
            - {type: Restart, verifyWithin: *time}
            - <<: {type: Restart}
              verifyWithin: 3s
        """)
    debounce, alias, within = sorted(found(policy), key=lambda one: (one.place, one.severity == "error"))
    assert (debounce.severity, debounce.field) == ("error", "spec.monitoring.debounce")
    assert (alias.severity, alias.field) == ("warning", "spec.strategies[0].verifyWithin")
    assert "spec.monitoring.debounce" in alias.message
    assert (within.severity, within.field) == ("error", "spec.strategies[0].verifyWithin")


def test_recursive_and_exponential_aliases_are_reported() -> None:
    assert any("contains itself" in one.message for one in found("a: &a {b: *a}\nkind: X\n"))
    bomb = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 12)
    )
    assert any("with all aliases expanded" in one.message for one in found(bomb))


def test_control_characters_do_not_reach_the_terminal() -> None:
    policy = POLICY.replace("500ms", '"\\e[2J\\n\\ud800"')
    for line in _lines(policy):
        assert line.isprintable()


def test_values_are_parsed_as_kubernetes_parses_them() -> None:
    annotations = "{name: navigation, annotations: {time: 2026-01-02, ratio: 1:30, version: 1.0}}"
    finding = only(POLICY.replace("{name: navigation}", annotations))
    assert finding.field == "metadata.annotations.version"  # the others are texts
    infinite = only(POLICY, WORKLOAD + "  monitor: {resources: {limits: {cpu: .inf}}}\n")
    assert infinite.field == "spec.monitor.resources.limits.cpu"
    assert "found .inf, which JSON does not support" in infinite.message


PROCEDURE = """
      xml: |
        <root BTCPP_format="4">
          <BehaviorTree ID="Up">
            <SetLifecycle node="drive" state="active"/>
          </BehaviorTree>
        </root>"""


def test_places_in_procedures_refer_to_the_file() -> None:
    findings = checked(WORKLOAD.replace("spec:\n", f"spec:\n  bringUp:{PROCEDURE}\n", 1)).findings
    (finding,) = (one for one in findings if one.severity == "error")
    lines = WORKLOAD.splitlines().index("spec:") + 1
    assert (finding.place.line, finding.place.column) == (lines + 5, 13)
    assert finding.field == "spec.bringUp.xml"
    assert_golden("check", finding.message, "SetLifecycle", "'drive'", "'/drive'")


def test_places_in_an_openscenario_check_refer_to_the_file() -> None:
    check = """
    osc: |
      import osc.understudy
      scenario ready:
          do resend_goals()"""
    lines = POOL.splitlines().index("spec:") + 1
    findings = checked(POOL.replace("spec:\n", f"spec:\n  readinessCheck:{check}\n", 1)).findings
    (finding,) = (one for one in findings if one.field == "spec.readinessCheck.osc")
    assert (finding.place.line, finding.place.column) == (lines + 5, 14)
    assert_golden("check", finding.message, "resend_goals")


def test_a_procedure_has_exactly_one_tree() -> None:
    both = WORKLOAD.replace("spec:\n", f"spec:\n  bringUp:\n      yaml: {{resend_goals: {{}}}}{PROCEDURE}\n", 1)
    assert_golden("check", [str(finding) for finding in found(both)], "yaml, xml and osc")

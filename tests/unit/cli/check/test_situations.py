"""What is found in a policy's ``spec.situations`` without a cluster."""

from __future__ import annotations

from tests.support.golden import assert_golden
from tests.unit.cli.check.manifests import POLICY, POOL, WORKLOAD, found, only

CARRYING = (
    POLICY
    + """\
  situations:
    - name: carrying
      when: {task: {action: /carry}}
      strategies:
        - {type: Fallback, poolRef: {name: hot}}
        - {type: Restart}
"""
)
LOADED = """\
    - name: loaded
      when: {yaml: {value: {topic: /load, type: std_msgs/msg/Float32, holds: data > 5}}}
      strategies:
        - {type: Restart}
"""


def test_a_valid_policy_with_situations_has_no_findings() -> None:
    assert found(CARRYING + LOADED, POOL, WORKLOAD) == []


def test_a_missing_pool_is_reported_at_its_place() -> None:
    finding = only(CARRYING.replace("{name: hot}", "{name: hod}"), POOL, WORKLOAD)
    assert (finding.severity, finding.field) == ("warning", "spec.situations[0].strategies[0].poolRef.name")
    assert 'no FallbackPool "hod" in the given files' in finding.message
    assert finding.place.line == 13


def test_a_situation_that_can_never_apply_is_reported() -> None:
    again = LOADED.replace(
        "{yaml: {value: {topic: /load, type: std_msgs/msg/Float32, holds: data > 5}}}", "{task: {action: /carry}}"
    )
    finding = only(CARRYING + again, POOL, WORKLOAD)
    assert (finding.severity, finding.field) == ("warning", "spec.situations[1].when")
    assert_golden("check", finding.message, "situation carrying")


def test_a_pool_without_standbys_is_reported() -> None:
    finding = only(CARRYING, POOL.replace("perWorkload: 1", "perWorkload: 0"), WORKLOAD)
    assert (finding.severity, finding.field) == ("warning", "spec.situations[0].strategies[0].poolRef.name")
    assert "FallbackPool hot has perWorkload 0" in finding.message


def test_a_mistake_in_a_tree_is_placed_like_one_in_the_health_tree() -> None:
    finding = only(CARRYING + LOADED.replace("data > 5", "data >"), POOL, WORKLOAD)
    assert finding.field == "spec.situations[1].when.yaml.value.holds"


def test_a_mistake_in_a_procedure_is_placed() -> None:
    wrong = "recovery: {yaml: {set_lifecycle: {node: /nav, state: on}}}"
    finding = only(CARRYING.replace("poolRef: {name: hot}}", f"poolRef: {{name: hot}}, {wrong}}}"), POOL, WORKLOAD)
    assert finding.field.startswith("spec.situations[0].strategies[0].recovery.yaml")


def test_a_situation_must_define_strategies_in_the_way_of_its_policy() -> None:
    finding = only(CARRYING + "      requirements: {taskCriticality: High}\n", POOL, WORKLOAD)
    assert finding.field == "spec.situations[0]"
    assert_golden("check", finding.message, "spec.strategies")
    auto = CARRYING.replace(
        "    - {type: Restart}\n  situations", "    - {type: Auto}\n  requirements: {}\n  situations", 1
    )
    assert "each situation must set requirements" in only(auto, POOL, WORKLOAD).message

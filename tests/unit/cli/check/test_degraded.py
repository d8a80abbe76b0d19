"""What is found in a policy's ``spec.degraded`` without a cluster."""

from __future__ import annotations

from tests.unit.cli.check.manifests import POLICY, POOL, WORKLOAD, found, only

DEGRADED = (
    POLICY
    + """\
  degraded:
    monitoring:
      yaml: {topic: {name: /cmd_vel, rate: "> 18 Hz"}}
"""
)


def test_a_valid_policy_for_degraded_states_has_no_findings() -> None:
    assert found(DEGRADED) == []


def test_a_finding_in_the_degraded_tree_has_its_field_and_line() -> None:
    finding = only(DEGRADED.replace("18 Hz", "18 Herz"))
    assert finding.field == "spec.degraded.monitoring.yaml.topic.rate"
    assert "is not a rate: write" in finding.message
    assert finding.place.line == 11


def test_a_mistake_in_openscenario_has_its_line_in_the_file() -> None:
    text = """\
      osc: |
        import osc.understudy
        scenario well:
            do topic("/cmd_vel", rate_minimum: 18Hz)
"""
    finding = only(DEGRADED.replace('      yaml: {topic: {name: /cmd_vel, rate: "> 18 Hz"}}\n', text))
    assert finding.field == "spec.degraded.monitoring.osc"
    assert finding.place.line == 14


RESCHEDULING = (
    DEGRADED
    + """\
    actions:
      - reschedule: {after: 1m}
"""
)


def test_a_workload_that_is_never_idle_is_reported() -> None:
    finding = only(RESCHEDULING, WORKLOAD)
    assert (finding.severity, finding.field) == ("warning", "spec.tasks")
    assert "nothing defines when this workload is idle" in finding.message
    assert "spec.degraded.actions[0].reschedule.idle" in finding.message


def test_a_task_or_an_idle_tree_defines_when_the_workload_is_idle() -> None:
    task = "  tasks:\n    - {action: /go, type: nav2_msgs/action/NavigateToPose}\n"
    assert found(RESCHEDULING, WORKLOAD + task) == []
    idle = RESCHEDULING.replace("{after: 1m}", "{after: 1m, idle: {yaml: {topic: {name: /standing, gap: 1s}}}}")
    assert found(idle, WORKLOAD) == []
    finding = only(idle.replace("gap: 1s", "gap: 1"), WORKLOAD)
    assert finding.field == "spec.degraded.actions[0].reschedule.idle.yaml.topic.gap"


def test_an_action_that_is_given_twice_is_refused() -> None:
    finding = only(RESCHEDULING + "      - reschedule: {after: 2m}\n")
    assert (finding.severity, finding.field) == ("error", "spec.degraded.actions")
    assert "actions contains reschedule twice" in finding.message


def test_an_action_with_two_kinds_is_refused() -> None:
    finding = only(RESCHEDULING.replace("reschedule: {after: 1m}", "{resize: {cpu: 1500m}, reschedule: {after: 1m}}"))
    assert finding.field == "spec.degraded.actions[0]"
    assert "each action has exactly one of" in finding.message


def test_a_resize_needs_amounts_as_strings() -> None:
    number = only(RESCHEDULING.replace("reschedule: {after: 1m}", "resize: {cpu: 2}"))
    assert number.field == "spec.degraded.actions[0].resize.cpu"
    assert "in quotes if it looks like a number" in number.message
    assert "write the number of cores as a string" in number.message
    nothing = only(RESCHEDULING.replace("reschedule: {after: 1m}", "resize: {container: app}"))
    assert "give the new amount" in nothing.message


def test_prewarming_a_shared_pool_is_refused() -> None:
    policy = RESCHEDULING.replace("{type: Restart}", "{type: Fallback, poolRef: {name: hot}}")
    policy = policy.replace("reschedule: {after: 1m}", "prewarm: {poolRef: {name: hot}}")
    assert found(policy, WORKLOAD, POOL) == []
    shared = POOL.replace("Executing", "Uninitialized").replace("perWorkload", "replicas")
    finding = only(policy, WORKLOAD.replace("workloadRef: {kind: Deployment, name: nav2}", TEMPLATE), shared + SOURCE)
    assert (finding.severity, finding.field) == ("error", "spec.degraded.actions[0].prewarm.poolRef.name")
    assert "FallbackPool hot has readiness Uninitialized" in finding.message


TEMPLATE = "template: {spec: {containers: [{name: app, image: app, command: [run]}]}}"
SOURCE = "  templateFrom: {workload: robot-17}\n"

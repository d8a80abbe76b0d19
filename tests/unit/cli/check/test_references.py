"""What the objects of several files say of each other."""

from __future__ import annotations

from tests.support.golden import assert_golden
from tests.unit.cli.check.manifests import POLICY, POOL, WORKLOAD, found, only, workload

FALLBACK = POLICY.replace("{type: Restart}", "{type: Fallback, poolRef: {name: hot}}")


def test_a_policy_missing_from_the_files_is_reported() -> None:
    finding = only(WORKLOAD, POLICY.replace("name: navigation}", "name: navigating}"))
    assert_golden(
        "check",
        str(finding),
        "a.yaml:8:22: warning",
        "RobotWorkload",
        "robot-17",
        "spec.failurePolicyRef.name",
        "FailurePolicy",
        '"navigation"',
        '"navigating"',
    )


def test_a_pool_missing_from_the_files_is_reported() -> None:
    finding = only(FALLBACK)
    assert (finding.severity, finding.field) == ("warning", "spec.strategies[0].poolRef.name")
    assert tuple(finding.place) == (8, 34)


def test_a_pool_that_selects_no_workload_is_reported() -> None:
    of_workload, pool = found(FALLBACK, WORKLOAD, POOL.replace("app: navigation", "app: nav"))
    assert (pool.severity, pool.field) == ("warning", "spec.workloadSelector")
    assert "robot-17 has labels app=navigation" in pool.message
    assert (of_workload.severity, of_workload.field) == ("warning", "metadata.labels")
    assert "no fallback of FailurePolicy navigation could run" in of_workload.message


def test_a_pool_without_any_workload_is_reported() -> None:
    finding = only(POOL)
    assert (finding.severity, finding.field) == ("warning", "spec.workloadSelector")
    assert_golden("check", finding.message, "no RobotWorkload")


def test_a_workload_that_another_pool_of_its_policy_serves_has_no_warning() -> None:
    policy = FALLBACK.replace("hot}}", "hot}}\n    - {type: Fallback, poolRef: {name: warm}}")
    hot = POOL.replace("app: navigation", "app: navigation, task: critical")
    critical = workload("robot-18").replace("app: navigation", "app: navigation, task: critical")
    assert found(policy, WORKLOAD, critical, hot, POOL.replace("hot", "warm")) == []


def test_a_template_from_a_missing_workload_is_reported() -> None:
    pool = POOL.replace("Executing", "Uninitialized").replace("perWorkload", "replicas")
    pool += "  templateFrom: {workload: robot-71}\n"
    finding = only(POLICY, WORKLOAD, pool)
    assert finding.field == "spec.templateFrom.workload"
    assert 'did you mean "robot-17"?' in finding.message


def test_references_stay_within_their_namespace() -> None:
    def within(manifest: str, namespace: str) -> str:
        return manifest.replace("metadata: {", f"metadata: {{namespace: {namespace}, ", 1)

    assert found(within(POLICY, "a"), within(WORKLOAD, "a")) == []
    assert found(POLICY, within(WORKLOAD, "a")) == []
    assert only(within(POLICY, "b"), within(WORKLOAD, "a")).field == "spec.failurePolicyRef.name"


def test_waiting_for_an_executing_standby_is_reported() -> None:
    waits = POLICY.replace("{type: Restart}", "{type: Fallback, poolRef: {name: hot}, waitFor: 10s}")
    finding = only(waits, WORKLOAD, POOL)
    assert (finding.severity, finding.field) == ("warning", "spec.strategies[0].waitFor")
    assert_golden("check", finding.message, "FallbackPool hot is Executing")
    shared = POOL.replace("Executing", "Uninitialized").replace("perWorkload", "replicas")
    assert found(waits, WORKLOAD, shared + "  templateFrom: {workload: robot-17}\n") == []


def test_a_policy_that_watches_no_output_of_its_workload_is_reported() -> None:
    finding = only(POLICY.replace("/cmd_vel", "/cmd_vell"), WORKLOAD)
    assert (finding.severity, finding.file, finding.field) == ("warning", "a.yaml", "spec.monitoring")
    assert_golden("check", finding.message, "/cmd_vell", "RobotWorkload", "robot-17")


def test_one_watched_output_is_enough() -> None:
    more = WORKLOAD.replace(
        "  failurePolicyRef", "    - {topic: /fork, type: std_msgs/msg/Float64}\n  failurePolicyRef"
    )
    assert found(POLICY, more) == []


def test_a_policy_without_topic_leaves_need_not_watch_an_output() -> None:
    assert found(POLICY.replace("topic: {name: /cmd_vel, gap: 500ms}", "node: {name: /planner}"), WORKLOAD) == []


def test_a_workload_with_services_only_needs_no_watched_output() -> None:
    service = WORKLOAD.replace(
        "{topic: /cmd_vel, type: geometry_msgs/msg/Twist}", "{service: /grip, type: std_srvs/srv/Trigger}"
    )
    assert found(POLICY, service) == []


def test_a_policy_with_its_tree_in_a_configmap_is_not_reported() -> None:
    elsewhere = POLICY.replace(
        "yaml: {topic: {name: /cmd_vel, gap: 500ms}}", "configMapKeyRef: {name: trees, key: tree.yaml}"
    )
    assert "watches" not in only(elsewhere, WORKLOAD).message


def needing(name: str, *others: str) -> str:
    listed = ", ".join(f"{{name: {other}}}" for other in others)
    return workload(name) + f"  dependsOn: [{listed}]\n"


def test_circular_dependencies_are_reported() -> None:
    findings = found(POLICY, needing("a", "b"), needing("b", "c"), needing("c", "d", "a"), needing("d"))
    assert [(one.severity, one.file, one.field) for one in findings] == [
        ("error", "b.yaml", "spec.dependsOn[0].name"),
        ("error", "c.yaml", "spec.dependsOn[0].name"),
        ("error", "d.yaml", "spec.dependsOn[1].name"),
    ]
    assert all("a -> b -> c -> a is a cycle" in one.message for one in findings)


def test_a_workload_that_depends_on_itself_is_reported_once() -> None:
    finding = only(POLICY, needing("a", "a"))
    assert (finding.severity, finding.field) == ("error", "spec.dependsOn")
    assert "contains this workload itself" in finding.message


def test_a_missing_dependency_is_reported() -> None:
    finding = only(POLICY, needing("planning", "localisation"), needing("localization"))
    assert (finding.severity, finding.field) == ("warning", "spec.dependsOn[0].name")
    assert 'did you mean "localization"?' in finding.message


def test_the_action_after_a_recovery_needs_its_procedure() -> None:
    def one(entry: str) -> str:
        return WORKLOAD + f"  dependsOn: [{{name: other, {entry}}}]\n"

    other = workload("other")
    assert "procedure is required" in only(POLICY, other, one("onRecovery: Procedure")).message
    assert "procedure is required" in only(POLICY, other, one("procedure: {yaml: {wait_for: {node: /a}}}")).message
    assert "which is missing: set spec.bringUp" in only(POLICY, other, one("onRecovery: Reinitialize")).message
    wrong = only(
        POLICY, other, one("onRecovery: Procedure, procedure: {yaml: {set_lifecycle: {node: amcl, state: active}}}")
    )
    assert wrong.field == "spec.dependsOn[0].procedure.yaml.set_lifecycle.node"


def test_an_object_that_is_given_twice_is_an_error_in_one_file_and_a_warning_in_two() -> None:
    second = only(POLICY, f"{WORKLOAD}---\n{WORKLOAD}")
    assert (second.severity, second.field, second.place.line) == ("error", "metadata.name", 12)
    assert_golden("check", second.message, "RobotWorkload", "b.yaml:3")
    variant = only(POLICY, WORKLOAD, WORKLOAD)
    assert (variant.severity, variant.file) == ("warning", "c.yaml")


def test_objects_of_one_name_in_two_namespaces_or_of_two_kinds_are_not_the_same() -> None:
    named = POLICY.replace("navigation", "robot-17"), WORKLOAD.replace("name: navigation}", "name: robot-17}")
    assert found(*named) == []
    there = [text.replace("metadata: {", "metadata: {namespace: a, ") for text in (POLICY, WORKLOAD)]
    assert found(*there, *(text.replace("namespace: a", "namespace: b") for text in there)) == []


def test_two_workloads_of_one_source_are_an_error() -> None:
    finding = only(POLICY, WORKLOAD, WORKLOAD.replace("robot-17", "robot-18"))
    assert (finding.severity, finding.file, finding.field) == ("error", "c.yaml", "spec.workloadRef.name")
    assert_golden("check", finding.message, "Deployment nav2", "RobotWorkload robot-17")
    there = [text.replace("metadata: {", "metadata: {namespace: a, ") for text in (POLICY, WORKLOAD)]
    other = [text.replace("namespace: a", "namespace: b").replace("robot-17", "robot-18") for text in there]
    assert found(*there, *other) == [], "they are in two namespaces"

"""The chart beside the code: definitions, names and rights are those that the code has; and what Helm itself says of it.

The suites in charts/understudy/tests check what the templates render from values (test_suites.py).
"""

from __future__ import annotations

import json
import re
import subprocess

import pytest
import yaml

from tests.support.chart import SET_IMAGES
from tests.unit.chart.conftest import CHART, Object, Render, one
from understudy.api import names
from understudy.api.schema.definitions import definitions
from understudy.kube.gates.base import GateRecord
from understudy.kube.gates.kinds.network_policy import GATE


@pytest.mark.parametrize(
    "values",
    [("--set", SET_IMAGES), ("--values", str(CHART / "production.yaml"))],
    ids=["default-values", "production"],
)
def test_helm_lint_reports_nothing(helm: str, values: tuple[str, ...]) -> None:
    done = subprocess.run([helm, "lint", "--strict", str(CHART), *values], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout
    assert "[WARNING]" not in done.stdout
    assert "[ERROR]" not in done.stdout


def test_the_definitions_equal_those_of_the_models(render: Render) -> None:
    rendered = {item["metadata"]["name"]: item for item in render() if item["kind"] == "CustomResourceDefinition"}
    expected = {definition["metadata"]["name"]: definition for definition in definitions().values()}
    assert rendered.keys() == expected.keys()
    for name, definition in expected.items():
        assert rendered[name]["spec"] == definition["spec"]


def test_the_metrics_port_is_the_one_that_the_operator_uses(render: Render) -> None:
    (container,) = one(render(), "Deployment")["spec"]["template"]["spec"]["containers"]
    assert container["ports"] == [{"name": "metrics", "containerPort": names.METRICS_PORT}]


def test_roles_in_watched_namespaces_and_the_cluster_role_grant_the_same_rights_together(render: Render) -> None:
    everywhere = one(render(), "ClusterRole", "understudy-operator")["rules"]
    items = render("watchNamespaces={fleet-a,fleet-b}")
    of_cluster = one(items, "ClusterRole", "understudy-operator")["rules"]
    roles = [i for i in items if i["kind"] == "Role" and i["metadata"]["name"] == "understudy-operator-workloads"]
    assert len(roles) == 2
    assert all([*role["rules"], *of_cluster] == everywhere for role in roles)


def test_helm_test_uses_an_account_that_the_admission_policy_recognizes(render: Render) -> None:
    assert one(render(tests=True), "Pod")["spec"]["serviceAccountName"].endswith(names.MONITOR_ACCOUNT_ENDING)


def test_the_admission_policy_uses_the_names_of_the_code(render: Render) -> None:
    text = yaml.safe_dump(one(render(), "ValidatingAdmissionPolicy", "understudy-monitors"), width=10_000)
    assert f"endsWith('{names.MONITOR_ACCOUNT_ENDING}')" in text.replace("''", "'")
    for label in (names.WORKLOAD, names.INSTANCE, names.HELD):
        assert f"labels[?'{label}']" in text.replace("''", "'")
    for annotation in (names.CLAIM, names.CLAIMED_AT):
        assert f"'{annotation}'" in text.replace("''", "'")
    assert f"c.name == '{names.AGENT_CONTAINER}'" in text.replace("''", "'")
    assert f"e.name == '{names.WORKLOAD_VARIABLE}'" in text.replace("''", "'")


def test_the_policy_of_gates_allows_the_record_that_the_code_writes(render: Render) -> None:
    policy = one(render(), "ValidatingAdmissionPolicy", "understudy-gates")
    text = " ".join(yaml.safe_dump(policy, width=10_000).replace("''", "'").split())
    assert f"endsWith('{names.MONITOR_ACCOUNT_ENDING}')" in text
    record = GateRecord(epoch=3, active="w-a", active_uid="uid-a", recovery="", version="1")
    patches = [
        GATE.commitment("w", over=record, active="w-a", let_through="[]", waits_for="spare"),
        GATE.commitment("w", over=record, fenced=2),
        GATE.admission("w", over=record, admitted="w-b", admitted_uid="uid-b", let_through="[]"),
        GATE.noting(over=record, recovery="{}"),
        GATE.overtaking(over=record, recovery="r"),
    ]
    annotations = {key for patch in patches for key in patch["metadata"]["annotations"]}
    (listed,) = re.findall(
        r"key in \[(.*?)\]", next(v["expression"] for v in policy["spec"]["variables"] if v["name"] == "annotated")
    )
    assert set(listed.replace("'", "").split(", ")) == annotations
    assert {key for patch in patches for key in patch["metadata"].get("labels", ())} == {names.WAITS_FOR}
    assert f"key != '{names.WAITS_FOR}'" in text
    assert f"variables.workload + '{names.gate('')}'" in text
    assert f"'' ? ['{names.NOBODY}'] : variables.admitted" in text
    for key in (names.WORKLOAD, names.INSTANCE, names.EPOCH, names.ACTIVE, names.ADMITTED, names.FENCED):
        assert f"'{key}'" in text


def test_the_policy_of_labels_uses_the_names_of_the_code(render: Render) -> None:
    text = yaml.safe_dump(one(render(), "ValidatingAdmissionPolicy", "understudy-labels"), width=10_000)
    assert f"startsWith('{names.GROUP}/')" in text.replace("''", "'")
    assert f"endsWith('{names.MONITOR_ACCOUNT_ENDING}')" in text.replace("''", "'")


def test_the_policies_of_new_pods_and_controllers_name_the_labels_that_the_code_selects_by(render: Render) -> None:
    labels = (
        names.WORKLOAD,
        names.INSTANCE,
        names.POOL,
        names.HELD,
        names.CLAIMED_BY,
        names.MONITORED,
        names.COMPONENT,
    )
    listed = ", ".join(f"'{label}'" for label in labels)
    for name, count in (("new-pods", 2), ("controllers", 3)):
        policy = one(render(), "ValidatingAdmissionPolicy", f"understudy-{name}")
        text = " ".join(yaml.safe_dump(policy, width=10_000).replace("''", "'").split())
        assert text.count(f"[{listed}]") == count


def test_the_policy_of_controllers_matches_no_write_of_a_failover(render: Render) -> None:
    """Not the gate, a pod, or the scale of a ReplicaSet: the API server does not look at the policy then."""
    policy = one(render(), "ValidatingAdmissionPolicy", "understudy-controllers")
    matched = {
        resource for rule in policy["spec"]["matchConstraints"]["resourceRules"] for resource in rule["resources"]
    }
    assert not matched & {"networkpolicies", "pods", "replicasets/scale", "*"}
    assert not [resource for resource in matched if "/" in resource]


def test_an_old_kubernetes_is_refused(helm: str) -> None:
    command = [helm, "template", "understudy", str(CHART), "--kube-version", "1.29"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode != 0
    assert "requires kubeVersion: >=1.30" in done.stderr


def test_the_values_contain_every_property_of_the_schema() -> None:
    schema = json.loads((CHART / "values.schema.json").read_text())
    values = yaml.safe_load((CHART / "values.yaml").read_text())

    def compare(properties: Object, found: Object, path: str) -> None:
        assert properties.keys() - {"global"} == found.keys(), path
        for name, child in properties.items():
            child = schema["definitions"][child["$ref"].rpartition("/")[2]] if "$ref" in child else child
            if "properties" in child and name not in ("resources",):
                compare(child["properties"], found[name], f"{path}.{name}")

    compare(schema["properties"], values, "")

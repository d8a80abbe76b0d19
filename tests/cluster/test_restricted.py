"""Namespaces at Pod Security `restricted`: everything that the operator creates conforms, and what does not is reported."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.cluster.operators import CORE, Fleet, Operator, bare_template, hot, policy, spare, workload
from tests.support.cluster import Cluster, Object, until
from tests.support.pod_security import BEYOND
from understudy.api import names


@pytest.fixture
def restricted(cluster: Cluster, namespace: str) -> None:
    _restrict(cluster, namespace)


def _restrict(cluster: Cluster, namespace: str, level: str = "restricted") -> None:
    found = cluster.get(CORE, "Namespace", namespace)
    cluster.patch(found, {"metadata": {"labels": {"pod-security.kubernetes.io/enforce": level}}})


def test_monitors_discovery_servers_and_agents_are_within_it(
    restricted: None, fleet: Fleet, operator: Operator
) -> None:
    tasks = [{"action": "/drive", "type": "nav2_msgs/action/NavigateToPose", "onFailover": "Resend"}]
    fleet.create(
        policy("hot", "spare"),
        hot(),
        spare(replicas=1),
        workload(gate={"reflex": {"deadline": "100ms"}}),
        workload("tasked", tasks=tasks),
    )
    for name in ("w", "tasked"):
        fleet.wait_built(name)
        until(lambda name=name: len(fleet.instances(name)) == 2, "a pod and a standby")
        for component in ("monitor", "discovery"):
            labels = f"{names.COMPONENT}={component},{names.MONITORED}={name}"
            until(lambda labels=labels: fleet.pods(labels), f"the pod of the {component} of {name} to be admitted")
    until(lambda: len(fleet.held()) == 1, "a held pod")


def test_an_earlier_template_that_violates_pod_security_is_reported_with_the_missing_fields(fleet: Fleet) -> None:
    """Templates that are written later are refused: strangers/test_templates.py."""
    _restrict(fleet.cluster, fleet.namespace, "baseline")
    bare = bare_template()
    fleet.create(policy("hot", "spare"), hot(), spare(replicas=1, template=bare), workload(template=bare))
    _restrict(fleet.cluster, fleet.namespace)
    with Operator(fleet.cluster.kubeconfig, fleet.namespace):
        for kind, name in (("RobotWorkload", "w"), ("FallbackPool", "spare")):
            said = fleet.wait_condition(kind, name, "Accepted", "TemplateInvalid")["message"]
            assert 'container "app" must set securityContext.allowPrivilegeEscalation=false' in said
            assert "understudy-agent" not in said, "the agent is within it"
            assert said.endswith("See docs/how-to/production.md")


EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def _example_pods() -> Iterator[tuple[str, Object]]:
    """Yield the templates of pods in the examples, each with its place."""
    for path in sorted(EXAMPLES.glob("*/manifests/**/*.yaml")):
        for item in yaml.safe_load_all(path.read_text()):
            found = (item or {}).get("spec", {}).get("template")
            if found and path not in BEYOND:
                yield f"{path.relative_to(EXAMPLES)} {item['metadata']['name']}", found


def test_the_examples_are_within_it(restricted: None, cluster: Cluster, namespace: str) -> None:
    pods = dict(_example_pods())
    assert len(pods) >= 15
    for number, (place, found) in enumerate(pods.items()):
        metadata = {"name": f"example-{number}", "namespace": namespace}
        pod = {
            "apiVersion": "v1",
            "kind": "Pod",
            "metadata": metadata,
            "spec": {"restartPolicy": "Never"} | found["spec"],
        }
        assert cluster.create(pod, dry_run=True), place

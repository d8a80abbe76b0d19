"""Namespaces at Pod Security `restricted`: everything that the operator creates conforms, and what does not is reported."""

from __future__ import annotations

import pytest

from tests.cluster.operators import CORE, Fleet, Operator, hot, policy, spare, template, workload
from tests.support.cluster import Cluster, Object, until
from understudy.api import names


@pytest.fixture
def restricted(cluster: Cluster, namespace: str) -> None:
    _restrict(cluster, namespace)


def _restrict(cluster: Cluster, namespace: str) -> None:
    found = cluster.get(CORE, "Namespace", namespace)
    cluster.patch(found, {"metadata": {"labels": {"pod-security.kubernetes.io/enforce": "restricted"}}})


def within() -> Object:
    """A template that asks for no more than it may."""
    found = template(securityContext={"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}})
    found["spec"]["securityContext"] = {"runAsNonRoot": True, "seccompProfile": {"type": "RuntimeDefault"}}
    return found


def test_monitors_discovery_servers_and_agents_are_within_it(
    restricted: None, fleet: Fleet, operator: Operator
) -> None:
    tasks = [{"action": "/drive", "type": "nav2_msgs/action/NavigateToPose", "onFailover": "Resend"}]
    fleet.create(
        policy("hot", "spare"),
        hot(),
        spare(replicas=1, template=within()),
        workload(template=within(), gate={"reflex": {"deadline": "100ms"}}),
        workload("tasked", template=within(), tasks=tasks),
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
    fleet.create(policy("hot", "spare"), hot(), spare(replicas=1), workload())
    _restrict(fleet.cluster, fleet.namespace)
    with Operator(fleet.cluster.kubeconfig, fleet.namespace):
        for kind, name in (("RobotWorkload", "w"), ("FallbackPool", "spare")):
            said = fleet.wait_condition(kind, name, "Accepted", "TemplateInvalid")["message"]
            assert 'container "app" must set securityContext.allowPrivilegeEscalation=false' in said
            assert "understudy-agent" not in said, "the agent is within it"
            assert said.endswith("See docs/how-to/production.md")

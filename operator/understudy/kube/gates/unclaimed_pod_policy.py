"""The network isolation of unclaimed pods, whatever the kind of the gates."""

from __future__ import annotations

from understudy.api import names
from understudy.kube.client import NETWORK_POLICIES, Object
from understudy.kube.gates.policy_parts import network_policy

RESOURCE = NETWORK_POLICIES
"""Resource of the objects that isolate pods."""

KIND = "NetworkPolicy"


def held_pods(pool: str, claimable: str) -> Object:
    """Return the policy of a pool's unclaimed pods: only monitors reach their agents, and the pods can send nothing else.

    Monitors are selected by both of their labels: that of the component does not say that a pod serves a workload.
    The annotation of the policy holds the hash of the template whose pods may be claimed.
    """
    serves = {"key": names.MONITORED, "operator": "Exists"}
    monitors = [{"podSelector": {"matchLabels": {names.COMPONENT: "monitor"}, "matchExpressions": [serves]}}]
    policy = network_policy(
        names.held(pool),
        {"matchLabels": {names.POOL: pool, names.HELD: "true"}},
        {
            "policyTypes": ["Ingress", "Egress"],
            "ingress": [
                {"from": monitors, "ports": [{"protocol": "TCP", "port": names.AGENT_PORT}]},
                {"ports": [{"protocol": "TCP", "port": names.AGENT_HEALTH_PORT}]},
            ],
        },
    )
    policy["metadata"]["annotations"] = {names.TEMPLATE_HASH: claimable}
    return policy

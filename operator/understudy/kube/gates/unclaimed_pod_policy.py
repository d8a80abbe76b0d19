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

    Its annotation holds the hash of the template whose pods may be claimed.
    """
    monitors = [{"podSelector": {"matchLabels": {names.COMPONENT: "monitor"}}}]
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

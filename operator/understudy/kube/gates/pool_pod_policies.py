"""The network policies of the pods of shared pools, whatever the kind of the gates.

A claim changes no label that a policy selects by (names.CLAIMED_BY). So the policy of a pool selects its pods after their claim too, and
another one adds what instances of a workload may do, for the pods that it names.
"""

from __future__ import annotations

from collections.abc import Sequence

from understudy.api import names
from understudy.kube.client import NETWORK_POLICIES, Object
from understudy.kube.gates.policy_parts import named, network_policy, of_workload

RESOURCE = NETWORK_POLICIES
"""Resource of the objects that isolate pods."""

KIND = "NetworkPolicy"


def held_pods(pool: str, claimable: str) -> Object:
    """Return the policy of a pool's pods: only monitors reach their agents, and the pods can send nothing else.

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


def claimed_pods(workload: str, rules: Object, claimed: Sequence[str]) -> Object:
    """Return the policy of the pods that a workload has claimed. ``rules`` are those of an instance that is not in control."""
    return network_policy(names.claimed(workload), claimed_selector(workload, claimed), rules)


def claimed_selector(workload: str, claimed: Sequence[str]) -> Object:
    """Return the selector of this policy."""
    return {"matchExpressions": [of_workload(workload), named(claimed)]}

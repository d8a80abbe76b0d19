"""The parts of which NetworkPolicies are made."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from understudy.api import names
from understudy.kube.client import Object

_LAST_PORT = 65535


def network_policy(name: str, selector: Mapping[str, Any], rules: Object) -> Object:
    """Return a NetworkPolicy with these rules for the pods that a selector matches."""
    return {
        "apiVersion": "networking.k8s.io/v1",
        "kind": "NetworkPolicy",
        "metadata": {"name": name},
        "spec": {"podSelector": dict(selector), **rules},
    }


def ports(protocol: str, first: int = 1, last: int = _LAST_PORT) -> Object:
    """Return a range of ports; all of them by default.

    All of them are no range: engines that keep an entry for each peer and each block of ports, such as Cilium, need one instead of 16.
    """
    whole = (first, last) == (1, _LAST_PORT)
    return {"protocol": protocol} if whole else {"protocol": protocol, "port": first, "endPort": last}


def addresses(cidrs: Iterable[str]) -> list[Object]:
    """Return the peers at addresses outside the cluster."""
    return [{"ipBlock": {"cidr": cidr}} for cidr in cidrs]


def of_workload(workload: str) -> Object:
    """Return the requirement that a pod is an instance of a workload, or of a shared pool, from which the workload may have claimed it.

    A pod that nobody has claimed can send nothing (pool_pod_policies), so a rule may have it as a peer. A policy that selects pods by this
    requirement must also name them.
    """
    return {"key": names.WORKLOAD, "operator": "In", "values": [workload, names.UNCLAIMED]}


def named(pods: Iterable[str]) -> Object:
    """Return the requirement that a pod is one of these instances; without any, that it is none."""
    return {"key": names.INSTANCE, "operator": "In", "values": list(pods) or [names.NOBODY]}


def protectors(workload: str) -> Object:
    """Return the peer that selects the monitor and the discovery server of a workload, in its own namespace."""
    return {"podSelector": {"matchLabels": {names.MONITORED: workload}}}

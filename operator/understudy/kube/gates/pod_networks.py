"""Finds the networks of a pod besides the pod network, which is the only one that NetworkPolicies apply to.

Multus and similar plugins follow the Kubernetes Network Custom Resource Definition De-facto Standard: annotations request further networks
(and Multus another default network), and the plugin reports the interfaces of each pod in another annotation.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from understudy.kube.client import Object

NETWORKS = "k8s.v1.cni.cncf.io/networks"
"""The annotation that gives a pod further interfaces."""

DEFAULT_NETWORK = "v1.multus-cni.io/default-network"
"""The annotation that replaces the network of a pod's first interface."""

_STATUS = "k8s.v1.cni.cncf.io/network-status"
"""The annotation in which the plugin reports the interfaces of a pod: a JSON list."""


def ungated(pod: Object) -> dict[str, tuple[str, ...]]:
    """Return the networks of a pod that no NetworkPolicy controls, as its object shows them: each with its known addresses."""
    found: dict[str, tuple[str, ...]] = {}
    if pod["spec"].get("hostNetwork"):
        found["the network of its node (spec.hostNetwork)"] = ()
    annotations = pod["metadata"].get("annotations") or {}
    for key in (NETWORKS, DEFAULT_NETWORK):
        if annotations.get(key):
            found[f"other networks (metadata.annotations[{key}])"] = ()
    return found | _further(annotations.get(_STATUS, ""), _addresses(pod))


def _addresses(pod: Object) -> set[str]:
    """Return the addresses of a pod in the pod network."""
    status = pod.get("status") or {}
    found = {status.get("podIP"), *(one.get("ip") for one in status.get("podIPs") or [])}
    return {address for address in found if address}


def _further(status: str, own: set[str]) -> dict[str, tuple[str, ...]]:
    """Return the interfaces in a plugin's report that are not that of the pod network: the default one, or one with the pod's address.

    Without an address of the pod, it is not known which one that is, so there are none.
    """
    further: dict[str, tuple[str, ...]] = {}
    pod_network = set[str]()
    for network in _networks(status) if own else ():
        name = network.get("interface") or network.get("name")
        if not isinstance(name, str):
            continue
        listed = network.get("ips")
        addresses = tuple(map(str, listed)) if isinstance(listed, list) else ()
        if network.get("default") is True or not own.isdisjoint(addresses):
            pod_network.add(name)
        else:
            further[name] = further.get(name, ()) + addresses
    return {name: addresses for name, addresses in further.items() if name not in pod_network}


def _networks(status: str) -> Iterator[Mapping[str, Any]]:
    """Yield the networks in a plugin's report. What cannot be read is left out, because anybody may have written it."""
    try:
        listed = json.loads(status or "[]")
    except (ValueError, RecursionError):
        return
    if isinstance(listed, list):
        yield from (network for network in listed if isinstance(network, dict))

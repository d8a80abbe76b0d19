"""Names, addresses and folders of one local cluster, all derived from a few decisions."""

import ipaddress
import itertools
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from testcluster import atomic
from testcluster.paths import cache, mark
from testcluster.shell import run

DEFAULT_NAME = "understudy"
OWN = "own"
"""The enforcer of network policies that this provider brings itself."""

# 198.18.0.0/15 is reserved for tests of network devices (RFC 2544, RFC 6890), so homes, companies and clouds do not use
# it.
POOL = ipaddress.ip_network("198.18.0.0/15")
# Parts of a cluster's /18 in units of /24: 0 nodes, 16-31 services, 32-63 pods of node 1-31.
PREFIX = 18
MAX_NODES = 31
API_PORT = 6443


class BadSetting(ValueError):
    """A setting from the environment or the command line cannot be used."""


@dataclass(frozen=True)
class Layout:
    """The decisions for one cluster.

    Attributes:
        slot: a number that is unique on this machine.
        network: all of its addresses.
        cgroup: name of the control group of all of its processes.
        enforcer: name of what enforces its network policies (programs.ENFORCERS).
    """

    name: str
    slot: int
    network: ipaddress.IPv4Network
    node_count: int
    cgroup: str
    enforcer: str

    def _subnet(self, index: int, prefix: int = 24) -> ipaddress.IPv4Network:
        return ipaddress.IPv4Network((int(self.network.network_address) + (index << 8), prefix))

    def _fabric(self, host: int) -> str:
        return str(self._subnet(0)[host])

    @property
    def state(self) -> Path:
        """The folder with all files of this cluster."""
        return folder(self.name)

    @property
    def log(self) -> Path:
        """The folder with the control plane's logs."""
        return self.state / "log"

    @property
    def nodes(self) -> range:
        """The nodes' numbers."""
        return range(1, self.node_count + 1)

    @property
    def control_plane_ip(self) -> str:
        """Address of the API server, which is also the nodes' router."""
        return self._fabric(1)

    @property
    def host_ip(self) -> str:
        """Address of this machine in the cluster's network."""
        return self._fabric(254)

    def node_ip(self, node: int) -> str:
        """Return the address of a node."""
        return self._fabric(10 + node)

    def machine_ip(self, machine: int) -> str:
        """Return the address of a machine outside of the cluster, on the network of the nodes."""
        return self._fabric(100 + machine)

    def pod_network(self, node: int) -> ipaddress.IPv4Network:
        """Return the addresses of a node's pods."""
        return self._subnet(32 + node)

    @property
    def pods(self) -> ipaddress.IPv4Network:
        """Addresses of all pods."""
        return self._subnet(32, 19)

    @property
    def services(self) -> ipaddress.IPv4Network:
        """Addresses of services."""
        return self._subnet(16, 20)

    @property
    def kubernetes_ip(self) -> str:
        """Address of the service in front of the API server."""
        return str(self.services[1])

    @property
    def dns_ip(self) -> str:
        """Address of the DNS service."""
        return str(self.services[10])

    @property
    def api(self) -> str:
        """URL of the API server."""
        return f"https://{self.control_plane_ip}:{API_PORT}"

    @property
    def host_link(self) -> str:
        """Name of this machine's end of its link into the cluster's network (15 characters at most)."""
        return _host_link(self.slot)

    @property
    def kubeconfig(self) -> Path:
        """The administrator's kubeconfig."""
        return self.state / "pki" / "admin.conf"

    @property
    def api_ready(self) -> Path:
        """A file that exists once the API server answers; nodes wait for it."""
        return self.state / "api-ready"

    def node_state(self, node: int) -> Path:
        """Return the folder with all files of a node."""
        return self.state / node_name(node)

    def save(self) -> None:
        """Save the decisions for later calls."""
        decided = {
            "slot": self.slot,
            "network": str(self.network),
            "nodes": self.node_count,
            "cgroup": self.cgroup,
            "enforcer": self.enforcer,
        }
        atomic.write(self.state / "layout.json", json.dumps(decided) + "\n")


def _host_link(slot: int) -> str:
    return f"understudy{slot}"


def node_name(node: int) -> str:
    """Return the Kubernetes name of a node, which is also its host name."""
    return f"node{node}"


def node_number(name: str, layout: Layout) -> int:
    """Return the number of a node with this name.

    Raises:
        BadSetting: the cluster has no such node.
    """
    for node in layout.nodes:
        if name == node_name(node):
            return node
    raise BadSetting(
        f"cluster {layout.name}: no node {name!r}; it has {', '.join(node_name(node) for node in layout.nodes)}"
    )


def folder(name: str) -> Path:
    """Return the folder of a cluster with this name."""
    return cache() / "clusters" / name


def load(name: str) -> Layout | None:
    """Return the layout of a cluster that was started before; None if there is none."""
    try:
        kept = json.loads((folder(name) / "layout.json").read_text())
    except FileNotFoundError:
        return None
    group, enforcer = kept.get("cgroup", f"understudy-{name}"), kept.get("enforcer", OWN)
    return Layout(name, int(kept["slot"]), ipaddress.IPv4Network(kept["network"]), int(kept["nodes"]), group, enforcer)


def names() -> list[str]:
    """Return the names of all clusters of this machine."""
    return [path.parent.name for path in (cache() / "clusters").glob("*/layout.json")]


def _others(name: str) -> list[Layout]:
    return [found for found in (load(other) for other in names() if other != name) if found]


def _routed() -> list[ipaddress.IPv4Network]:
    """Return the networks to which this machine has a route, except the default route."""
    routes = json.loads(run("ip", "-j", "-4", "route", "show", "table", "all") or "[]")
    destinations = (route["dst"] for route in routes if route["dst"] != "default")
    return [ipaddress.IPv4Network(destination, strict=False) for destination in destinations]


def _free_network(taken: Iterable[ipaddress.IPv4Network]) -> ipaddress.IPv4Network:
    taken = list(taken)
    for candidate in POOL.subnets(new_prefix=PREFIX):
        if not any(candidate.overlaps(other) for other in taken):
            return ipaddress.IPv4Network(candidate)
    raise BadSetting(
        f"no /{PREFIX} of {POOL} is free on this machine; name another one in UNDERSTUDY_CLUSTER_ADDRESSES"
    )


def decide(name: str, enforcer: str = OWN) -> Layout:
    """Decide the layout of a new cluster: a free slot and network, or the network of UNDERSTUDY_CLUSTER_ADDRESSES.

    Raises:
        BadSetting: a setting is malformed or its addresses are in use.
    """
    others = _others(name)
    used = {other.host_link for other in others} | {link["ifname"] for link in json.loads(run("ip", "-j", "link"))}
    slot = next(number for number in itertools.count() if _host_link(number) not in used)
    taken = [other.network for other in others] + _routed()
    wanted = os.environ.get("UNDERSTUDY_CLUSTER_ADDRESSES")
    if wanted:
        try:
            network = ipaddress.IPv4Network(wanted)
        except ValueError as error:
            raise BadSetting(
                f"UNDERSTUDY_CLUSTER_ADDRESSES={wanted}: {error}; an IPv4 network such as 198.18.0.0/{PREFIX} is needed"
            ) from None
        if network.prefixlen != PREFIX:
            raise BadSetting(f"UNDERSTUDY_CLUSTER_ADDRESSES={wanted}: a /{PREFIX} is needed")
        clash = [str(other) for other in taken if network.overlaps(other)]
        if clash:
            raise BadSetting(
                f"UNDERSTUDY_CLUSTER_ADDRESSES={wanted}: this machine already reaches {', '.join(clash)} in it"
            )
    else:
        network = _free_network(taken)
    asked = os.environ.get("UNDERSTUDY_CLUSTER_NODES", "3")
    if not asked.isdigit() or not 0 <= int(asked) <= MAX_NODES:
        raise BadSetting(f"UNDERSTUDY_CLUSTER_NODES={asked}: a number from 0 to {MAX_NODES} is needed")
    return Layout(name, slot, network, int(asked), f"understudy-{name}-{mark()}", enforcer)

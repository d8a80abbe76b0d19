"""The cluster's network: a bridge as its switch, a link to each node, and one to this machine.

The bridge is in the control plane's own network namespace, so that this machine's packet filter never sees frames
between nodes. Processes hold the namespaces, not mounted files: nothing has to be unmounted, and a node that loses
power also loses its packet filter and connection tracking. `ip netns add` is never used: its first use mounts
/run/netns over itself, and every container runtime on the machine then fails to remove its pods.
"""

import ipaddress
import json
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from testcluster.local import cgroups, processes
from testcluster.local.layout import Layout
from testcluster.progress import wait_until
from testcluster.shell import CommandFailed, run

BRIDGE = "br0"
HOLDER = ("sleep", "infinity")


def inside(pid: int) -> list[str]:
    """Return the prefix of a command that runs in the network namespace of a process."""
    return ["nsenter", f"--net=/proc/{pid}/ns/net"]


def _batch(commands: Sequence[str], pid: int | None = None) -> None:
    """Run `ip` commands in one process, in the namespace of the given process or in this machine's."""
    run(*(inside(pid) if pid else []), "ip", "-batch", "-", input="\n".join(commands) + "\n")


def _own_namespace(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/ns/net").readlink() != Path("/proc/self/ns/net").readlink()
    except OSError:
        return False


def control_plane_group(layout: Layout) -> str:
    """Return the control group of the control plane and of its network."""
    return f"{layout.cgroup}/control-plane"


def holder(layout: Layout) -> int | None:
    """Return the process that holds the control plane's network namespace; None if there is none."""
    pid = processes.find(control_plane_group(layout), *HOLDER)
    return pid if pid and _own_namespace(pid) else None


def _links(pid: int | None = None) -> dict[str, bool]:
    """Return the names of the links in a namespace, and whether each is up."""
    listed = json.loads(run(*(inside(pid) if pid else []), "ip", "-j", "link") or "[]")
    return {link["ifname"]: "UP" in link["flags"] for link in listed}


# A real control plane has its own machines. Here it shares some processors with everything that it controls.
WEIGHT = 16
# A real cluster has its own machines too. Without a weight, all of its processes together would get as much of the processors as a
# single one of the tests', and robots would miss their deadlines when a test starts a command.
CLUSTER_WEIGHT = 8


def _node_link(node: int) -> str:
    return f"node{node}"


def _machine_link(machine: int) -> str:
    return f"machine{machine}"


def up(layout: Layout) -> int:
    """Make the bridge and its link as far as they are missing, and return the process that holds the namespace."""
    group = control_plane_group(layout)
    cgroups.create(group)
    cgroups.weigh(layout.cgroup, CLUSTER_WEIGHT)
    cgroups.weigh(group, WEIGHT)
    pid = holder(layout)
    if pid is None:
        pid = processes.start(group, ["unshare", "--net", *HOLDER], layout.log / "network.log")
        # `unshare` becomes the holder. Until then its namespace is still this machine's.
        wait_until(lambda: holder(layout) is not None, 10, "network namespace of the control plane")
    links = _links(pid)
    if BRIDGE not in links:
        _batch(
            [
                "link set lo up",
                f"link add {BRIDGE} type bridge",
                f"addr add {layout.control_plane_ip}/24 dev {BRIDGE}",
                f"link set {BRIDGE} up",
            ],
            pid,
        )
        run(
            *inside(pid),
            "sh",
            "-c",
            "echo 1 >/proc/sys/net/ipv4/ip_forward; "
            "for f in /proc/sys/net/bridge/bridge-nf-call-*tables; do [ ! -e $f ] || echo 0 >$f; done",
        )
    if "host" not in links or layout.host_link not in _links():
        remove_host_link(layout)
        _batch([f"link add {layout.host_link} type veth peer name host netns {pid}"])
        _batch([f"link set host master {BRIDGE} up"], pid)
        _batch(
            [
                f"addr add {layout.host_ip}/24 dev {layout.host_link}",
                f"link set {layout.host_link} up",
                *(f"route replace {layout.pod_network(node)} via {layout.node_ip(node)}" for node in layout.nodes),
            ]
        )
    routes = (f"route replace {layout.pod_network(node)} via {layout.node_ip(node)}" for node in layout.nodes)
    _batch(list(routes), pid)
    return pid


def _attach(layout: Layout, pid: int, link: str, address: str, nodes: Iterable[int]) -> None:
    """Give the namespace of a process a link to the bridge, an address, and routes to the pods of these nodes."""
    control_plane = holder(layout)
    if control_plane is None:
        raise RuntimeError(f"cluster {layout.name}: its network is not up; run `scripts/cluster up` first")
    wait_until(lambda: _own_namespace(pid), 10, f"network namespace of {link}")
    _detach(layout, link)
    _batch([f"link add {link} type veth peer name eth0 netns {pid}"], control_plane)
    _batch(
        [
            "link set lo up",
            f"addr add {address}/24 dev eth0",
            "link set eth0 up",
            f"route add default via {layout.control_plane_ip}",
            *(f"route add {layout.pod_network(node)} via {layout.node_ip(node)}" for node in nodes),
        ],
        pid,
    )
    _batch([f"link set {link} master {BRIDGE} up"], control_plane)


def _detach(layout: Layout, link: str) -> None:
    control_plane = holder(layout)
    if control_plane is not None and link in _links(control_plane):
        _batch([f"link del {link}"], control_plane)


def attach_node(layout: Layout, node: int, pid: int) -> None:
    """Give the node with this first process its link, address and routes.

    The node's script waits for the link.
    """
    _attach(layout, pid, _node_link(node), layout.node_ip(node), (other for other in layout.nodes if other != node))
    run(*inside(pid), "sh", "-c", "echo 1 >/proc/sys/net/ipv4/ip_forward")


def detach_node(layout: Layout, node: int) -> None:
    """Remove a node's link, if there is one."""
    _detach(layout, _node_link(node))


def attach_machine(layout: Layout, machine: int, pid: int) -> None:
    """Give the machine outside of the cluster with this process its link, its address, and routes to all pods."""
    _attach(layout, pid, _machine_link(machine), layout.machine_ip(machine), layout.nodes)


def detach_machine(layout: Layout, machine: int) -> None:
    """Remove a machine's link, if there is one."""
    _detach(layout, _machine_link(machine))


def set_node_link(layout: Layout, node: int, connected: bool) -> None:
    """Disconnect a node from the network, or connect it again.

    Raises:
        RuntimeError: the cluster or the node is not up.
    """
    control_plane = holder(layout)
    if control_plane is None or _node_link(node) not in _links(control_plane):
        raise RuntimeError(f"cluster {layout.name}: node{node} has no link; it is not up")
    _batch([f"link set {_node_link(node)} {'up' if connected else 'down'}"], control_plane)


def node_connected(layout: Layout, node: int) -> bool:
    """Return whether a node is connected to the network."""
    control_plane = holder(layout)
    return control_plane is not None and _links(control_plane).get(_node_link(node), False)


def remove_host_link(layout: Layout) -> None:
    """Remove this machine's link into the cluster, and with it every route through it."""
    for _ in range(50):
        links = json.loads(run("ip", "-j", "-4", "addr", "show", check=False) or "[]")
        ours = [link for link in links if link["ifname"] == layout.host_link]
        if not ours:
            return
        addresses = [entry["local"] for entry in ours[0].get("addr_info", [])]
        if any(ipaddress.IPv4Address(address) not in layout.network for address in addresses):
            raise RuntimeError(
                f"link {layout.host_link} has {', '.join(addresses)}, outside {layout.network}: "
                "it is not ours to remove"
            )
        try:
            run("ip", "link", "del", layout.host_link)
        except CommandFailed:
            # If the namespace of its other end is ending now, the kernel removes the link.
            time.sleep(0.1)

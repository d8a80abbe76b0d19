"""A node: its own namespaces, container runtime, kubelet and kube-proxy, and the faults that it can have."""

import contextlib
import json
import os
import shlex
import shutil
import signal
from functools import partial
from pathlib import Path

from testcluster import atomic
from testcluster.local import cgroups, golden, network, processes
from testcluster.local.enforcer import Enforcer
from testcluster.local.layout import Layout, node_name
from testcluster.local.programs import Programs
from testcluster.modes import NetworkModes
from testcluster.paths import cache
from testcluster.progress import wait_until
from testcluster.shell import run

_INIT = Path(__file__).resolve().parent / "node-init.sh"

NODE_WEIGHT = 8
"""The weight of a node beside the control plane, and that of its pods beside its kubelet and its runtime. With the usual weight, robots'
instances were silent for half a second while containers started, and failed.
"""

_RUNTIME = {"kubelet": ("kubelet",), "containerd": ("containerd", "--config")}
"""The programs with which Kubernetes runs a node's containers, and words of their command lines."""

_NAMESPACES = ["--net", "--mount", "--uts", "--ipc", "--pid", "--fork", "--mount-proc", "--propagation", "private"]


def group(layout: Layout, node: int) -> str:
    """Return the control group of a node: its programs are in `system`, its pods in `pods`."""
    return f"{layout.cgroup}/{node_name(node)}"


def init(layout: Layout, node: int) -> int | None:
    """Return the node's first process; None if the node is off."""
    return processes.init_of(f"{group(layout, node)}/system")


def _container_store(layout: Layout, node: int) -> Path:
    return layout.node_state(node) / "containerd"


def has_images(layout: Layout, node: int) -> bool:
    """Return whether a node was on before, and so has images."""
    return _container_store(layout, node).exists()


def _reserved_memory(nodes: int) -> int:
    """Return the memory (MiB) that a node may not give to pods.

    Each node reports all memory of the machine, so together the nodes would have too much.
    """
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemTotal:"):
            total = int(line.split()[1]) // 1024
            rest = min(3072, total // 3)
            return total - (total - rest) // nodes
    raise RuntimeError("/proc/meminfo has no line MemTotal")


def _containerd(layout: Layout, node: int, plugins: str) -> str:
    state = layout.node_state(node)
    return f"""version = 2
root = "{_container_store(layout, node)}"
state = "/run/containerd"
[grpc]
  address = "/run/containerd/containerd.sock"
[plugins."io.containerd.grpc.v1.cri"]
  sandbox_image = "{golden.PAUSE_IMAGE}"
  # Without the right to lower the score of an out-of-memory kill, containers would not start at all.
  restrict_oom_score_adj = true
  [plugins."io.containerd.grpc.v1.cri".cni]
    bin_dir = "{plugins}"
    conf_dir = "{state}/etc/cni"
  [plugins."io.containerd.grpc.v1.cri".containerd]
    snapshotter = "overlayfs"
    [plugins."io.containerd.grpc.v1.cri".containerd.runtimes.runc]
      runtime_type = "io.containerd.runc.v2"
"""


def _kubelet(layout: Layout, node: int) -> str:
    pki = layout.state / "pki"
    return f"""apiVersion: kubelet.config.k8s.io/v1beta1
kind: KubeletConfiguration
authentication: {{anonymous: {{enabled: false}}, x509: {{clientCAFile: {pki}/ca.crt}}, webhook: {{enabled: true}}}}
authorization: {{mode: Webhook}}
tlsCertFile: {pki}/{node_name(node)}.crt
tlsPrivateKeyFile: {pki}/{node_name(node)}.key
cgroupDriver: cgroupfs
cgroupRoot: /{group(layout, node)}/pods
failCgroupV1: false
failSwapOn: false
clusterDNS: [{layout.dns_ip}]
clusterDomain: cluster.local
resolvConf: {layout.node_state(node)}/etc/resolv.conf
containerRuntimeEndpoint: unix:///run/containerd/containerd.sock
# A node counts as lost after a few seconds, so it must send heartbeats more often.
nodeStatusUpdateFrequency: 2s
nodeLeaseDurationSeconds: 4
syncFrequency: 10s
serializeImagePulls: false
# Images are loaded by scripts/images and could not be pulled again: never remove one.
imageGCHighThresholdPercent: 100
evictionHard: {{nodefs.available: "1%", imagefs.available: "1%", memory.available: 100Mi}}
makeIPTablesUtilChains: false
systemReserved: {{memory: {_reserved_memory(layout.node_count)}Mi}}
"""


def _kube_proxy(layout: Layout, node: int) -> str:
    return f"""apiVersion: kubeproxy.config.k8s.io/v1alpha1
kind: KubeProxyConfiguration
clientConnection: {{kubeconfig: {layout.state}/pki/proxy.conf}}
mode: nftables
clusterCIDR: {layout.pods}
hostnameOverride: {node_name(node)}
nodePortAddresses: [primary]
# The limits of connection tracking belong to the whole machine.
conntrack: {{maxPerCore: 0, min: 0}}
"""


def _configure(layout: Layout, node: int, enforcer: Enforcer) -> None:
    state = layout.node_state(node)
    etc = state / "etc"
    (etc / "cni").mkdir(parents=True, exist_ok=True)
    (state / "kubelet").mkdir(exist_ok=True)
    (state / "log").mkdir(exist_ok=True)
    hosts = ["127.0.0.1 localhost", *(f"{layout.node_ip(other)} {node_name(other)}" for other in layout.nodes)]
    (etc / "hosts").write_text("\n".join(hosts) + "\n")
    # For pods that use the node's resolver. It is empty, because nothing outside the cluster can be reached.
    (etc / "resolv.conf").write_text("nameserver 127.0.0.1\n")
    (etc / "ip").write_text(layout.node_ip(node))
    (etc / "containerd.toml").write_text(_containerd(layout, node, enforcer.plugins))
    enforcer.exchange(layout, node)
    enforcer.configure(layout, node)
    command = shlex.join(str(word) for word in enforcer.command(layout, node))
    atomic.write(etc / "enforcer.sh", f"#!/bin/sh\nexec {command}\n", 0o755)
    (etc / "kubelet.yaml").write_text(_kubelet(layout, node))
    (etc / "kube-proxy.yaml").write_text(_kube_proxy(layout, node))
    shutil.copy2(layout.state / "pki" / f"{node_name(node)}.conf", etc / "kubelet.conf")
    # A copy, because the shell reads a script while it runs, and somebody may edit the original meanwhile.
    shutil.copy2(_INIT, etc / "init.sh")
    if enforcer.prepare is not None:
        shutil.copy2(enforcer.prepare, etc / "prepare-enforcer.sh")


def renew(layout: Layout, node: int, programs: Programs) -> bool:
    """Update what can be updated in a running node, and return whether anything was.

    When the enforcer of network policies ends, the node's first process starts it again. Its rules stay in force
    meanwhile.
    """
    if not programs.enforcer.exchange(layout, node):
        return False
    pid = processes.find(f"{group(layout, node)}/system", *programs.enforcer.words(layout, node))
    if pid is not None:
        run("kill", "-TERM", str(pid), check=False)
    return True


def up(layout: Layout, node: int, programs: Programs) -> bool:
    """Switch a node on unless it is on, and return whether it was off. Its network has no modes then."""
    _forget_network_modes(layout, node)
    running = init(layout, node)
    if running is not None and network.node_connected(layout, node) and not cgroups.frozen(group(layout, node)):
        renew(layout, node, programs)
        return False
    if running is not None and cgroups.frozen(group(layout, node)):
        cgroups.freeze(group(layout, node), False)
    if running is not None and not network.node_connected(layout, node):
        # A test disconnected it, or its start was interrupted before it got its link: both look the same from here.
        down(layout, node)
        running = None
    if running is None:
        down(layout, node)
        start_runtime(layout, node)
        _configure(layout, node, programs.enforcer)
        golden.clone(programs, _container_store(layout, node))
        for part in ("system", "pods"):
            cgroups.create(f"{group(layout, node)}/{part}")
        for weighed in (group(layout, node), f"{group(layout, node)}/pods"):
            cgroups.weigh(weighed, NODE_WEIGHT)
        # The node's pods must not delay the enforcer: a real node would have another processor for it.
        enforcers = f"{layout.cgroup}/enforcers"
        cgroups.create(enforcers)
        cgroups.weigh(enforcers, network.WEIGHT)
        pid = processes.start(
            f"{group(layout, node)}/system",
            [
                "unshare",
                *_NAMESPACES,
                "bash",
                layout.node_state(node) / "etc" / "init.sh",
                node_name(node),
                layout.node_state(node),
                cache(),
                layout.api_ready,
                programs.hyperkube,
                cgroups.processors(enforcers) or "",
            ],
            layout.node_state(node) / "log" / "init.log",
        )
        network.attach_node(layout, node, pid)
    return True


def down(layout: Layout, node: int) -> None:
    """Cut a node's power: everything in it ends at once, without notice."""
    first = init(layout, node)
    if first is not None:
        cgroups.freeze(group(layout, node), False)
        run("kill", "-KILL", str(first), check=False)
    # Remove what an interrupted start left, and the parent of the first process.
    cgroups.kill(group(layout, node))
    # Remaining groups of containers would cost the next kubelet three seconds each.
    cgroups.remove(group(layout, node))
    network.detach_node(layout, node)


def stop_runtime(layout: Layout, node: int) -> None:
    """Stop a node's kubelet and container runtime. Its containers and its network continue.

    Raises:
        RuntimeError: the node is off.
        TimeoutError: the kernel does not end them.
    """
    if init(layout, node) is None:
        raise RuntimeError(f"cluster {layout.name}: {node_name(node)} is off")
    stopped = _stopped(layout, node)
    stopped.mkdir(exist_ok=True)

    def gone(words: tuple[str, ...]) -> bool:
        pid = processes.find(f"{group(layout, node)}/system", *words)
        if pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return pid is None

    for name, words in _RUNTIME.items():
        (stopped / name).touch()
        wait_until(partial(gone, words), 20, f"{name} of {node_name(node)} has ended")


def start_runtime(layout: Layout, node: int) -> None:
    """Start a node's kubelet and container runtime again. It is no error if they run."""
    for name in _RUNTIME:
        (_stopped(layout, node) / name).unlink(missing_ok=True)


def _modes_file(layout: Layout, node: int) -> Path:
    # Beside the enforcer, which looks for it there.
    return layout.node_state(node) / "etc" / "network-modes.json"


def _modes_answer(layout: Layout, node: int) -> Path:
    path = _modes_file(layout, node)
    return path.with_name(f"{path.name}.applied")


def network_modes(layout: Layout, node: int) -> NetworkModes:
    """Return the modes of a node's network."""
    try:
        return NetworkModes.from_json(_modes_file(layout, node).read_text())
    except FileNotFoundError:
        return NetworkModes()


def set_network_modes(layout: Layout, node: int, modes: NetworkModes) -> None:
    """Give a node's network these modes, and wait until its enforcer has them.

    Raises:
        RuntimeError: the node is off, or its enforcer refuses them.
        TimeoutError: its enforcer does not answer.
    """
    if init(layout, node) is None:
        raise RuntimeError(f"cluster {layout.name}: {node_name(node)} is off")
    answer, text = _modes_answer(layout, node), modes.to_json()
    atomic.write(_modes_file(layout, node), text)

    def applied() -> bool:
        try:
            found = json.loads(answer.read_text())
        except FileNotFoundError:
            return False
        if found["text"] == text and found["error"]:
            raise RuntimeError(f"{node_name(node)}: {found['error']}")
        return bool(found["text"] == text)

    wait_until(
        applied,
        10,
        f"the enforcer of {node_name(node)} has its modes (`scripts/cluster up` gives it the present one)",
        interval=0.01,
    )


def _forget_network_modes(layout: Layout, node: int) -> None:
    _modes_answer(layout, node).unlink(missing_ok=True)
    _modes_file(layout, node).unlink(missing_ok=True)


def _stopped(layout: Layout, node: int) -> Path:
    return layout.node_state(node) / "stopped"


def mounts(layout: Layout, node: int) -> list[str]:
    """Return the prefix of a command that runs with a node's mounts, which contain its container runtime's socket.

    Raises:
        RuntimeError: the node is off.
    """
    pid = init(layout, node)
    if pid is None:
        raise RuntimeError(f"cluster {layout.name}: {node_name(node)} is off")
    return ["nsenter", f"--target={pid}", "--mount"]

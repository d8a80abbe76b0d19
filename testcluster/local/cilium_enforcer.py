"""Cilium: an agent and a CNI plugin on each node, and its operator, which collects identities that nobody uses any more."""

import json
import os
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from testcluster import golang, packages
from testcluster.local.enforcer import Enforcer, Kubectl, etc
from testcluster.local.layout import BadSetting, Layout, node_name
from testcluster.progress import Progress, wait_until
from testcluster.shell import CommandFailed, run

_SOURCE = Path(__file__).resolve().parent / "cilium"
_MODULE = "github.com/cilium/cilium"
_CLANG = "clang-19"
_CNI = "05-cilium.conflist"

SETTINGS = "UNDERSTUDY_CILIUM_SETTINGS"
"""Environment with settings of the agents that replace those below, as JSON: names as in Cilium's ConfigMap, and texts."""


class Cilium(Enforcer):
    """Programs of eBPF, which the agent compiles on its node."""

    name = "cilium"
    users: ClassVar = {"cilium": "/CN=understudy:cilium", "cilium-operator": "/CN=understudy:cilium-operator"}

    @classmethod
    def ensure(cls, progress: Progress) -> "Cilium":
        """Build it unless it is there. Raises CommandFailed and MissingPrograms."""
        packages.ensure({_CLANG: _CLANG}, progress)
        programs = [f"{_MODULE}/{name}" for name in ("daemon", "operator", "plugins/cilium-cni", "cilium-dbg")]
        flags = ["-tags=osusergo", f"-ldflags=-s -w -X {_MODULE}/pkg/version.ciliumVersion={version()}"]
        estimate = "Cilium; 8 minutes on 2 cores, once"
        return cls(golang.build("cilium", _SOURCE, programs, flags, progress, estimate, finish=_add_sources))

    @property
    def plugins(self) -> str:
        return "/run/cilium-cni"

    @property
    def prepare(self) -> Path | None:
        return _SOURCE / "prepare-node.sh"

    def configure(self, layout: Layout, node: int) -> None:
        # From before the node was off: it must not be Ready before its agent is.
        (etc(layout, node) / "cni" / _CNI).unlink(missing_ok=True)
        own = {"write-cni-conf-when-ready": str(etc(layout, node) / "cni" / _CNI)}
        _write(etc(layout, node) / "cilium", _settings(layout, "cilium") | own | _chosen())

    def command(self, layout: Layout, node: int) -> Sequence[str | Path]:
        folder = self.link(layout, node)
        return [
            "env",
            f"PATH={folder}:{os.environ['PATH']}",
            f"K8S_NODE_NAME={node_name(node)}",
            "CILIUM_K8S_NAMESPACE=kube-system",
            # On another file system than the configuration of the plugin. Otherwise the agent moves that into its place from there, which
            # containerd 1.6 does not notice.
            "TMPDIR=/run/cilium",
            folder / "daemon",
            *self.words(layout, node),
        ]

    def words(self, layout: Layout, node: int) -> Sequence[str]:
        return [f"--config-dir={etc(layout, node) / 'cilium'}"]

    def control_plane(self, layout: Layout) -> Mapping[str, Sequence[str | Path]]:
        _write(layout.state / "cilium-operator", _settings(layout, "cilium-operator"))
        return {
            "operator": [
                "env",
                "CILIUM_K8S_NAMESPACE=kube-system",
                self.program / "operator",
                f"--config-dir={layout.state / 'cilium-operator'}",
            ]
        }

    def complete(self, layout: Layout, kubectl: Kubectl) -> None:
        """Write Cilium's kinds and its ConfigMap, which others read, and give each node the addresses of its pods."""
        crds = str(self.program / "crds")
        named = {
            "apiVersion": "v1",
            "kind": "ConfigMap",
            "metadata": {"name": "cilium-config", "namespace": "kube-system"},
        }
        data = _settings(layout, "cilium") | _chosen()
        kubectl("apply", "--server-side", "-f", "-", input=json.dumps({**named, "data": data}))
        kubectl("apply", "--server-side", "--force-conflicts", "--recursive", "-f", crds)

        def have_addresses() -> bool:
            listed = json.loads(kubectl("get", "nodes", "-o", "json"))
            present = {item["metadata"]["name"]: item["spec"].get("podCIDR") for item in listed["items"]}
            for node in layout.nodes:
                if node_name(node) in present and not present[node_name(node)]:
                    pods = str(layout.pod_network(node))
                    spec = json.dumps({"spec": {"podCIDR": pods, "podCIDRs": [pods]}})
                    kubectl("patch", "node", node_name(node), "--type=merge", "-p", spec)
            return len(present) >= layout.node_count

        wait_until(have_addresses, 120, "each node has addresses for its pods", interval=0.3, despite=CommandFailed)


def version() -> str:
    """Return the version of Cilium, without a leading v."""
    found = re.search(rf"{re.escape(_MODULE)} v(\S+)", (_SOURCE / "go.mod").read_text())
    if not found:
        raise ValueError(f"cilium/go.mod requires no {_MODULE}")
    return found[1]


def _add_sources(go: str, folder: Path) -> None:
    """Add what Cilium needs besides its programs: the sources that agents compile, a compiler, and its kinds."""
    module = Path(
        run(go, "list", "-m", "-f", "{{.Dir}}", _MODULE, cwd=_SOURCE, env={"GOFLAGS": "-mod=readonly"}).strip()
    )
    shutil.copytree(module / "bpf", folder / "bpf", copy_function=shutil.copyfile)
    shutil.copytree(module / "pkg/k8s/apis/cilium.io/client/crds", folder / "crds", copy_function=shutil.copyfile)
    (folder / "clang").symlink_to(packages.find(_CLANG) or _CLANG)


def _chosen() -> dict[str, str]:
    try:
        found = json.loads(os.environ.get(SETTINGS) or "{}")
        return {str(key): str(value) for key, value in found.items()}
    except (ValueError, AttributeError) as error:
        raise BadSetting(f'{SETTINGS}: {error}; JSON such as {{"policy-cidr-match-mode": "nodes"}} is needed') from None


def _settings(layout: Layout, user: str) -> dict[str, str]:
    return {
        "k8s-kubeconfig-path": str(layout.state / "pki" / f"{user}.conf"),
        "k8s-client-qps": "100",
        "k8s-client-burst": "200",
        "identity-allocation-mode": "crd",
        "cluster-name": layout.name,
        "ipam": "kubernetes",
        "devices": "eth0",
        # The nodes have routes to each other's pods, and the cluster's own kube-proxy serves.
        "routing-mode": "native",
        "ipv4-native-routing-cidr": str(layout.pods),
        "auto-direct-node-routes": "false",
        "enable-ipv4": "true",
        "enable-ipv6": "false",
        "enable-ipv4-masquerade": "false",
        "enable-bpf-masquerade": "false",
        "kube-proxy-replacement": "false",
        # One of them marks packets of the node. Without it, the probes of the kubelet are denied after a while.
        "install-iptables-rules": "true",
        "enable-l7-proxy": "false",
        "enable-envoy-config": "false",
        "enable-hubble": "false",
        "enable-health-checking": "false",
        "enable-endpoint-health-checking": "false",
        "enable-cilium-network-policy": "false",
        "enable-cilium-clusterwide-network-policy": "false",
        "enable-policy": "default",
        "cni-exclusive": "false",
        "cni-log-file": "/run/cilium/cilium-cni.log",
        "bpf-root": "/sys/fs/bpf",
        "bpf-map-dynamic-size-ratio": "0.0005",
        "monitor-aggregation": "medium",
        "annotate-k8s-node": "false",
    }


def _write(folder: Path, settings: Mapping[str, str]) -> None:
    """Write settings as Kubernetes mounts a ConfigMap: a file for each."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for key, value in settings.items():
        (folder / key).write_text(value)

"""The programs of a cluster, from Debian packages or built from Go modules."""

import re
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from testcluster import atomic, golang, packages
from testcluster.local.cilium_enforcer import Cilium
from testcluster.local.enforcer import Enforcer
from testcluster.local.layout import POOL
from testcluster.local.own_enforcer import OwnEnforcer
from testcluster.paths import cache
from testcluster.progress import Progress

_HERE = Path(__file__).resolve().parent
_HELM = "helm.sh/helm/v3/cmd/helm"

_DEBIAN = {
    "containerd": "containerd",
    "ctr": "containerd",
    "runc": "runc",
    "/usr/lib/cni/ptp": "containernetworking-plugins",
    "/usr/lib/cni/portmap": "containernetworking-plugins",
    "conntrack": "conntrack",
    "nft": "nftables",
    "iptables": "iptables",
    "ip": "iproute2",
    "unshare": "util-linux",
    "openssl": "openssl",
}


@dataclass(frozen=True)
class Programs:
    """Paths of the programs that were built."""

    hyperkube: Path
    pause: Path
    coredns: Path
    helm: Path
    enforcer: Enforcer


def _required(module: str) -> str:
    found = re.search(
        rf"^\s*(?:require )?{re.escape(module)} v(\S+)", (_HERE / "hyperkube" / "go.mod").read_text(), re.MULTILINE
    )
    if not found:
        raise ValueError(f"hyperkube/go.mod requires no {module}")
    return found[1]


def kubernetes_version() -> str:
    """Return the version of Kubernetes in the sources, without a leading v."""
    return _required("k8s.io/kubernetes")


def _version_flags() -> list[str]:
    version = kubernetes_version()
    major, minor, _ = version.split(".", 2)
    values = {"gitVersion": f"v{version}", "gitMajor": major, "gitMinor": minor, "gitTreeState": "clean"}
    named = [
        f"-X {package}.{name}={value}"
        for package in ("k8s.io/component-base/version", "k8s.io/client-go/pkg/version")
        for name, value in values.items()
    ]
    named.append(f"-X helm.sh/helm/v3/internal/version.version=v{_required('helm.sh/helm/v3')}")
    return [f"-ldflags=-s -w {' '.join(named)}"]


def _link_tools(hyperkube: Path, helm: Path) -> None:
    """Link kubectl and helm at a path that stays the same over versions, for people and scripts."""
    tools = tools_folder()
    tools.mkdir(exist_ok=True)
    for name, command in (("kubectl", [hyperkube, "kubectl"]), ("helm", [helm])):
        wrapper = f'''#!/bin/sh
# A proxy that the environment names does not know this machine's own networks.
export NO_PROXY="{POOL}${{NO_PROXY:+,$NO_PROXY}}"
exec {shlex.join(str(word) for word in command)} "$@"
'''
        program = tools / name
        if program.is_symlink() or not program.exists() or program.read_text() != wrapper:
            atomic.write(program, wrapper, 0o755)


def tools_folder() -> Path:
    """Return the folder with kubectl and helm."""
    return cache() / "tools"


ENFORCERS: Mapping[str, Callable[[Progress], Enforcer]] = {
    OwnEnforcer.name: OwnEnforcer.ensure,
    Cilium.name: Cilium.ensure,
}
"""What can enforce network policies, by name: functions that build it."""


def ensure(progress: Progress, enforcer: str) -> Programs:
    """Install and build the programs that are missing. ``enforcer`` is a key of :data:`ENFORCERS`.

    Raises:
        CommandFailed, MissingPrograms: a package could not be installed or a program could not be built.
    """
    packages.ensure(_DEBIAN, progress)
    built = golang.build(
        "hyperkube",
        _HERE / "hyperkube",
        ["./cmd/...", _HELM],
        _version_flags(),
        progress,
        "Kubernetes, etcd, CoreDNS, kubectl and Helm; 5 to 8 minutes on 2 cores, once",
    )
    enforces = ENFORCERS[enforcer](progress)
    _link_tools(built / "hyperkube", built / "helm")
    return Programs(built / "hyperkube", built / "pause", built / "coredns", built / "helm", enforces)

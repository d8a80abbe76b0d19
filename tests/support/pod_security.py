"""The Pod Security level `restricted`, as the chart's policy of templates applies it, for tests without an API server.

`tests/cluster/strangers/test_templates.py` compares it with Kubernetes' own decisions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

Fields = Mapping[str, Any]

_EXAMPLES = Path(__file__).resolve().parents[2] / "examples"

BEYOND = {
    # Makes a node's device out of a file, which needs a host path. It is a Deployment, which the chart does not check.
    _EXAMPLES / "tracker" / "manifests" / "device.yaml",
    # In the network of the node.
    _EXAMPLES / "quickstart" / "manifests" / "mux" / "host-network" / "robotworkload.yaml",
}
"""Examples that are not within the level."""

_CAPABILITIES = ("NET_BIND_SERVICE",)
_VOLUMES = (
    "configMap",
    "csi",
    "downwardAPI",
    "emptyDir",
    "ephemeral",
    "image",
    "persistentVolumeClaim",
    "projected",
    "secret",
)
_PROFILES = ("RuntimeDefault", "Localhost")
_SELINUX = ("container_t", "container_init_t", "container_kvm_t", "container_engine_t")
_SYSCTLS = (
    "kernel.shm_rmid_forced", "net.ipv4.ip_local_port_range", "net.ipv4.ip_local_reserved_ports", "net.ipv4.ip_unprivileged_port_start",
    "net.ipv4.ping_group_range", "net.ipv4.tcp_fin_timeout", "net.ipv4.tcp_keepalive_intvl", "net.ipv4.tcp_keepalive_probes",
    "net.ipv4.tcp_keepalive_time", "net.ipv4.tcp_rmem", "net.ipv4.tcp_syncookies", "net.ipv4.tcp_wmem",
)  # fmt: skip
_APPARMOR = "container.apparmor.security.beta.kubernetes.io/"


def violations(template: Fields) -> list[str]:
    """Return what the level `restricted` refuses in a pod template; empty if it allows the pods."""
    spec = template["spec"]
    context: Fields = spec.get("securityContext") or {}
    found = [key for key in ("hostNetwork", "hostPID", "hostIPC") if spec.get(key)]
    found += [f"annotation {key}" for key in _unconfined((template.get("metadata") or {}).get("annotations") or {})]
    found += [f"sysctl {one['name']}" for one in context.get("sysctls") or [] if one["name"] not in _SYSCTLS]
    for volume in spec.get("volumes") or []:
        found += [f"{kind} of volume {volume['name']}" for kind in _sources(volume) if kind not in _VOLUMES]
    found += [f"{field} of the pod" for field in _context_violations(context)]
    if context.get("runAsNonRoot") is False:
        found.append("runAsNonRoot of the pod")
    for container in [*spec["containers"], *(spec.get("initContainers") or [])]:
        found += [f"{field} of container {container['name']}" for field in _container_violations(container, context)]
    return found


def _unconfined(annotations: Fields) -> Iterator[str]:
    for key, value in annotations.items():
        if key.startswith(_APPARMOR) and value not in ("", "runtime/default") and not value.startswith("localhost/"):
            yield key


def _sources(volume: Fields) -> list[str]:
    return [key for key, value in volume.items() if key != "name" and value is not None]


def _context_violations(context: Fields) -> Iterator[str]:
    """Yield the fields of a security context that are refused in pods and containers alike."""
    selinux = context.get("seLinuxOptions") or {}
    if selinux.get("user") or selinux.get("role") or (selinux.get("type") or _SELINUX[0]) not in _SELINUX:
        yield "seLinuxOptions"
    for field in ("seccompProfile", "appArmorProfile"):
        if (context.get(field) or {}).get("type", _PROFILES[0]) not in _PROFILES:
            yield field
    if (context.get("windowsOptions") or {}).get("hostProcess"):
        yield "hostProcess"
    if context.get("runAsUser") == 0:
        yield "runAsUser"


def _container_violations(container: Fields, pod: Fields) -> Iterator[str]:
    context: Fields = container.get("securityContext") or {}
    yield from _context_violations(context)
    if context.get("privileged"):
        yield "privileged"
    if context.get("allowPrivilegeEscalation") is not False:
        yield "allowPrivilegeEscalation"
    if (context.get("procMount") or "Default") != "Default":
        yield "procMount"
    capabilities = context.get("capabilities") or {}
    if "ALL" not in (capabilities.get("drop") or []) or set(capabilities.get("add") or []) - set(_CAPABILITIES):
        yield "capabilities"
    if context.get("runAsNonRoot", pod.get("runAsNonRoot")) is not True:
        yield "runAsNonRoot"
    if not (context.get("seccompProfile") or pod.get("seccompProfile") or {}).get("type"):
        yield "seccompProfile"
    if any(port.get("hostPort") for port in container.get("ports") or []):
        yield "hostPort"
    hooks = container.get("lifecycle") or {}
    probes = [container.get(f"{kind}Probe") for kind in ("liveness", "readiness", "startup")]
    for probe in [*probes, hooks.get("postStart"), hooks.get("preStop")]:
        if any(((probe or {}).get(kind) or {}).get("host") for kind in ("httpGet", "tcpSocket")):
            yield "host of a probe"

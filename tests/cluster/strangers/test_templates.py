"""What Pod Security refuses in a pod, the admission policy refuses in a template, also in namespaces without a level."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest

from tests.cluster.conftest import Release
from tests.cluster.monitor_accounts import refusal, until_refused
from tests.cluster.operators import Fleet, Operator, bare_template, policy, spare, template, workload
from tests.support.cluster import Cluster, Object, Refused
from tests.support.pod_security import violations
from understudy.api import names

ENFORCE = "pod-security.kubernetes.io/enforce"
LEVELS = ("privileged", "baseline", "restricted")


def _with(
    pod: Mapping[str, Any] | None = None, annotations: Mapping[str, str] | None = None, **container: Any
) -> Object:
    found = bare_template(**container)
    found["spec"] |= pod or {}
    found["metadata"]["annotations"] = dict(annotations or {})
    return found


def _hardened(pod: Mapping[str, Any] | None = None, **context: Any) -> Object:
    """A template at the level restricted, except for these fields of the pod, and of its security contexts."""
    secured: Object = {"runAsNonRoot": True, "seccompProfile": {"type": "RuntimeDefault"}}
    hardened = {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}
    found = bare_template(securityContext={**hardened, **context})
    found["spec"] |= {"securityContext": secured} | (pod or {})
    return found


def _context(**fields: Any) -> Object:
    return _with(securityContext=fields)


def _pod_context(**fields: Any) -> Object:
    return _with({"securityContext": fields})


def _initial(**fields: Any) -> Object:
    return _with(
        {"initContainers": [bare_template(securityContext=fields)["spec"]["containers"][0] | {"name": "first"}]}
    )


def _volume(**source: Any) -> Object:
    return _hardened({"volumes": [{"name": "data", **source}]})


_SECCOMP = {"seccompProfile": {"type": "RuntimeDefault"}}
_APPARMOR = "container.apparmor.security.beta.kubernetes.io/app"

TEMPLATES: dict[str, Object] = {
    "plain": _with(),
    "hardened": _hardened(),
    "hardened-with-service": _hardened(capabilities={"drop": ["ALL"], "add": ["NET_BIND_SERVICE"]}),
    "hardened-by-container": _hardened({"securityContext": {}}, runAsNonRoot=True, **_SECCOMP),
    "host-pid": _with({"hostPID": True}),
    "host-ipc": _with({"hostIPC": True}),
    "not-host-pid": _with({"hostPID": False}),
    "host-path": _volume(hostPath={"path": "/"}),
    "privileged": _context(privileged=True),
    "privileged-at-first": _initial(privileged=True),
    "not-privileged": _context(privileged=False),
    "capability": _context(capabilities={"add": ["SYS_ADMIN"]}),
    "capability-nice": _context(capabilities={"add": ["SYS_NICE"]}),
    "capability-chown": _context(capabilities={"add": ["CHOWN"]}),
    "capability-service": _context(capabilities={"add": ["NET_BIND_SERVICE"]}),
    "capabilities-kept": _hardened(capabilities={"drop": ["NET_RAW"]}),
    "host-port": _with(ports=[{"containerPort": 80, "hostPort": 80}]),
    "port": _with(ports=[{"containerPort": 80}]),
    "probe-of-another-host": _with(livenessProbe={"httpGet": {"host": "10.0.0.1", "port": 80}}),
    "probe-by-tcp": _with(readinessProbe={"tcpSocket": {"host": "10.0.0.1", "port": 80}}),
    "probe": _with(startupProbe={"httpGet": {"port": 80}}),
    "hook-of-another-host": _with(lifecycle={"preStop": {"httpGet": {"host": "10.0.0.1", "port": 80}}}),
    "hook": _with(lifecycle={"postStart": {"exec": {"command": ["true"]}}}),
    "apparmor-off": _context(appArmorProfile={"type": "Unconfined"}),
    "apparmor-off-for-pod": _pod_context(appArmorProfile={"type": "Unconfined"}),
    "apparmor-of-node": _context(appArmorProfile={"type": "Localhost", "localhostProfile": "p"}),
    "apparmor-annotation": _with(annotations={_APPARMOR: "unconfined"}),
    "apparmor-annotation-of-node": _with(annotations={_APPARMOR: "localhost/p"}),
    "selinux-type": _context(seLinuxOptions={"type": "spc_t"}),
    "selinux-user": _pod_context(seLinuxOptions={"user": "root"}),
    "selinux-role": _context(seLinuxOptions={"role": "r"}),
    "selinux-container": _context(seLinuxOptions={"type": "container_t", "level": "s0:c1"}),
    "proc-mount": _with({"hostUsers": False}, securityContext={"procMount": "Unmasked"}),
    "seccomp-off": _context(seccompProfile={"type": "Unconfined"}),
    "seccomp-off-for-pod": _pod_context(seccompProfile={"type": "Unconfined"}),
    "seccomp-of-node": _context(seccompProfile={"type": "Localhost", "localhostProfile": "p"}),
    "sysctl": _pod_context(sysctls=[{"name": "kernel.msgmax", "value": "1"}]),
    "safe-sysctl": _pod_context(sysctls=[{"name": "net.ipv4.tcp_rmem", "value": "1"}]),
    "escalation": _hardened(allowPrivilegeEscalation=True),
    "root": _hardened(runAsUser=0),
    "root-pod": _hardened({"securityContext": {"runAsNonRoot": True, "runAsUser": 0, **_SECCOMP}}),
    "may-be-root": _hardened({"securityContext": _SECCOMP}),
    "may-be-root-by-container": _hardened(runAsNonRoot=False),
    "may-be-root-by-pod": _hardened({"securityContext": {"runAsNonRoot": False, **_SECCOMP}}, runAsNonRoot=True),
    "no-seccomp": _hardened({"securityContext": {"runAsNonRoot": True}}),
    "initial-container": _hardened({"initContainers": [bare_template()["spec"]["containers"][0] | {"name": "first"}]}),
    "secret": _volume(secret={"secretName": "s"}),
    "claim": _volume(persistentVolumeClaim={"claimName": "c"}),
    "driver": _volume(csi={"driver": "d"}),
    "nfs": _volume(nfs={"server": "s", "path": "/"}),
    "image": _volume(image={"reference": "i:1"}),
    "null-context": _with(securityContext=None, ports=None),
    "null-pod": _with({"securityContext": None, "volumes": None, "initContainers": None, "hostPID": None}),
    "null-fields": _with(
        {"securityContext": {"sysctls": None}},
        securityContext={"privileged": None, "capabilities": {"add": None, "drop": None}},
        ports=[{"containerPort": 80, "hostPort": None}],
        livenessProbe=None,
    ),
    "null-lists": _hardened({"securityContext": None}, capabilities=None),
    "null-source": _volume(hostPath=None, emptyDir={}),
}


@pytest.fixture
def space(cluster: Cluster, release: Release, namespace: str) -> str:
    """A namespace without a level, once the admission policy is enforced."""
    until_refused(
        lambda: _create(cluster, namespace, TEMPLATES["privileged"]),
        "violates the Pod Security level",
        "the admission policy of templates to be enforced",
    )
    return namespace


def _label(cluster: Cluster, namespace: str, level: str | None) -> None:
    found = cluster.get("v1", "Namespace", namespace)
    cluster.patch(found, {"metadata": {"labels": {ENFORCE: level}}})


def _create(cluster: Cluster, namespace: str, of: Object) -> None:
    cluster.create(workload(template=of), namespace, dry_run=True)


def _refused(cluster: Cluster, namespace: str) -> set[str]:
    """Return which templates are refused."""
    return _refused_of(lambda item: _create(cluster, namespace, item), "violates the Pod Security level")


def _refused_by_kubernetes(cluster: Cluster, namespace: str) -> set[str]:
    """Return of which templates Kubernetes itself refuses the pod."""

    def create(item: Object) -> None:
        pod = {"apiVersion": "v1", "kind": "Pod", **item, "metadata": {**item["metadata"], "name": "pod"}}
        cluster.create(pod, namespace, dry_run=True)

    return _refused_of(create, "violates PodSecurity")


def _refused_of(create: Callable[[Object], None], words: str) -> set[str]:
    found = set()
    for name, item in TEMPLATES.items():
        try:
            create(item)
        except Refused as error:
            if (error.reason, words in error.message) != ("Forbidden", True):
                raise
            found.add(name)
    return found


@pytest.mark.parametrize("level", LEVELS)
def test_a_namespace_with_a_level_refuses_what_pod_security_refuses(cluster: Cluster, space: str, level: str) -> None:
    _label(cluster, space, level)
    expected = _refused_by_kubernetes(cluster, space)
    assert _refused(cluster, space) == expected
    assert ("privileged" in expected, "plain" in expected, "hardened" in expected) == {
        "privileged": (False, False, False),
        "baseline": (True, False, False),
        "restricted": (True, True, False),
    }[level]


def test_the_tests_without_an_api_server_go_by_the_same_rules(cluster: Cluster, namespace: str) -> None:
    _label(cluster, namespace, "restricted")
    assert {name for name, of in TEMPLATES.items() if violations(of)} == _refused_by_kubernetes(cluster, namespace)


def test_a_namespace_without_a_level_is_restricted(cluster: Cluster, space: str) -> None:
    found = _refused(cluster, space)
    assert "plain" in found
    _label(cluster, space, "restricted")
    assert found == _refused_by_kubernetes(cluster, space)
    _label(cluster, space, "baseline")
    _create(cluster, space, TEMPLATES["plain"])


@pytest.mark.parametrize("of", [workload, spare], ids=["workload", "pool"])
def test_a_refusal_names_all_that_is_refused(cluster: Cluster, space: str, of: Callable[..., Object]) -> None:
    item = of(template=_context(privileged=True, capabilities={"add": ["SYS_ADMIN"]}))
    item["spec"]["template"]["spec"]["volumes"] = [{"name": "root", "hostPath": {"path": "/"}}]
    message = refusal(lambda: cluster.create(item, space))
    assert f"spec.template of {item['kind']} {space}/{item['metadata']['name']} violates" in message
    assert f"level restricted for namespaces without the label {ENFORCE}" in message
    for words in ("hostPath of volume root", "privileged of container app", "capabilities.add of container app"):
        assert words in message


def test_only_a_changed_template_is_refused(cluster: Cluster, space: str) -> None:
    _label(cluster, space, "privileged")
    template = TEMPLATES["privileged"]
    made = cluster.create(workload(template=template), space)
    _label(cluster, space, None)
    cluster.patch(made, {"spec": {"poolPriority": 1}, "metadata": {"finalizers": None}})
    more = {"spec": {"template": {"metadata": {"labels": {"more": "yes"}}}}}
    assert "privileged of container app" in refusal(lambda: cluster.patch(made, more))
    cluster.patch(made, {"spec": {"template": TEMPLATES["hardened"]}})


@pytest.mark.parametrize("volume", [names.MEMORY_VOLUME, names.TOKEN_VOLUME, names.AGENT_VOLUME])
def test_a_template_that_mounts_a_volume_of_the_agent_is_not_followed(
    fleet: Fleet, operator: Operator, volume: str
) -> None:
    mounts = [{"name": volume, "mountPath": "/theirs"}]
    stolen = template(volumeMounts=mounts)
    fleet.create(policy("spare"), spare(1, template=stolen), workload(template=stolen))
    for kind, name in (("RobotWorkload", "w"), ("FallbackPool", "spare")):
        message = fleet.wait_condition(kind, name, "Accepted", "TemplateInvalid")["message"]
        assert "spec.template.spec.containers[0].volumeMounts[0]" in message
        assert volume in message
    assert not fleet.instances()
    assert not fleet.held()

"""The managed ROS discovery server of a workload: a Deployment, and the Service whose address all processes use."""

from __future__ import annotations

from collections.abc import Sequence

from understudy.api import names
from understudy.controller import plan
from understudy.controller.observed import kube_objects
from understudy.controller.plan import Images, Patch, Write, priority, pull_secrets
from understudy.controller.pods import pod_placement
from understudy.controller.pods.instance_pod import HARDENED
from understudy.kube.client import PODS, Object
from understudy.ros.rmw import MIDDLEWARE

_PORTS = {"discovery": names.DISCOVERY_PORT, "asked": names.DISCOVERY_ASKED_PORT}
"""For participants, and for other servers (ros/dds/sole_server.py)."""

_POD, _BESIDE = "/etc/understudy/pod", names.BESIDE.rpartition("/")[2]
"""Folder of the container with what is known of its pod, and the file in it with the annotation BESIDE."""

_REQUESTS = {"cpu": "10m", "memory": "32Mi"}

TOLERATIONS: list[Object] = [
    {"key": f"node.kubernetes.io/{state}", "operator": "Exists", "effect": "NoExecute", "tolerationSeconds": seconds}
    for state, seconds in (("not-ready", 10), ("unreachable", 2))
]
"""The server is replaced so many seconds after the loss of its node instead of the default of five minutes.

A node is unreachable only after it has been silent for some time. One that is not ready may only restart its kubelet.
"""


def _labels(workload: str) -> dict[str, str]:
    return {names.COMPONENT: "discovery", names.MONITORED: workload}


REMINDERS = (10, 30, 90)
"""Ages of a server, in seconds, at which its Service is written again.

After several outages of the API server in a row, Kubernetes gives up on the endpoints of a Service ("Retry budget exceeded, dropping
service out of the queue"). Processes that start then discover nobody, until an event brings the Service back into the queue.
"""


def reminder(pods: Sequence[Object], before: Object | None, now: float) -> tuple[str, float | None]:
    """Return the annotation with which the Service is written, and in how many seconds it is due to change; None if it is not.

    It is that of the newest server that is ready, or that of the Service ``before`` if none is.
    """
    servers = sorted(filter(kube_objects.ready, pods), key=kube_objects.sort_key)
    if not servers:
        return kube_objects.notes(before or {"metadata": {}}).get(names.SERVER, ""), None
    age = now - kube_objects.created(servers[-1])
    passed = [seconds for seconds in REMINDERS if seconds <= age]
    left = [seconds - age for seconds in REMINDERS if seconds > age]
    return f"{kube_objects.uid(servers[-1])}/{max(passed, default=0)}s", min(left, default=None)


def service(workload: str, address: str | None = None, *, server: str = "") -> Object:
    """Return the Service. ``address`` is a former address to request again, because running processes know no other.

    ``server`` is its annotation (see :func:`reminder`).
    """
    spec: Object = {
        "selector": _labels(workload),
        "ports": [{"name": name, "protocol": "UDP", "port": port, "targetPort": port} for name, port in _PORTS.items()],
    }
    if address:
        spec["clusterIP"] = address
    return {
        "apiVersion": "v1",
        "kind": "Service",
        "metadata": {
            "name": names.discovery(workload),
            "labels": _labels(workload),
            **({"annotations": {names.SERVER: server}} if server else {}),
        },
        "spec": spec,
    }


def deployment(workload: str, images: Images, address: str) -> Object:
    """Return the server's Deployment. The server announces the Service's address, which stays when the pod changes."""
    command = MIDDLEWARE.discovery_command(address, names.DISCOVERY_PORT)
    container = {
        "name": "discovery",
        "image": images.monitor,
        "imagePullPolicy": images.pull_policy,
        "command": command[:1],
        "args": command[1:],
        "env": [
            {"name": "HOME", "value": "/tmp"},
            {"name": names.DISCOVERY_ASKED_VARIABLE, "value": str(names.DISCOVERY_ASKED_PORT)},
            {"name": names.DISCOVERY_BESIDE_VARIABLE, "value": f"{_POD}/{_BESIDE}"},
        ],
        "ports": [{"name": name, "containerPort": port, "protocol": "UDP"} for name, port in _PORTS.items()],
        "resources": plan.resources(_REQUESTS, images.memory_limit),
        "securityContext": HARDENED,
        "volumeMounts": [
            {"name": "tmp", "mountPath": "/tmp"},
            {"name": "pod", "mountPath": _POD, "readOnly": True},
        ],
    }
    beside = {"path": _BESIDE, "fieldRef": {"fieldPath": f"metadata.annotations['{names.BESIDE}']"}}
    pod: Object = {
        "automountServiceAccountToken": False,
        "terminationGracePeriodSeconds": 2,
        "affinity": _apart(workload),
        "tolerations": TOLERATIONS,
        **priority(images),
        **pull_secrets(images.pull_secrets),
        "containers": [container],
        "volumes": [
            {"name": "tmp", "emptyDir": {}},
            {"name": "pod", "downwardAPI": {"items": [beside]}},
        ],
    }
    return plan.deployment(names.discovery(workload), _labels(workload), {}, pod)


def notes_of_predecessors(pods: Sequence[Object]) -> list[Write]:
    """Return the writes that note on a server's pod beside which other one it began: one on a lost node, which may live on and come back.

    The annotation shows the successor where to end that one (ros/dds/sole_server.py). It stays after the lost pod is gone, because the
    process may outlive its object.
    """
    present = {kube_objects.uid(pod) for pod in pods}
    lost = next((pod for pod in pods if kube_objects.evicted(pod)), None)
    if lost is None:
        return []
    note = f"{kube_objects.uid(lost)}/{(lost.get('status') or {}).get('podIP', '')}"
    patch = {"metadata": {"annotations": {names.BESIDE: note}}}
    successors = filter(kube_objects.alive, pods)
    return [Patch(PODS, pod, patch) for pod in successors if _predecessor(pod) not in present]


def _predecessor(server: Object) -> str:
    """Return the UID of the noted predecessor of a server; empty if there is none."""
    return kube_objects.notes(server).get(names.BESIDE, "").partition("/")[0]


def _apart(workload: str) -> Object:
    """Return a preference for nodes without instances, which would be lost together with the server.

    Without the server, the process that takes over may have to wait until it is found.
    """
    term = pod_placement.away_from({names.WORKLOAD: workload}, pod_placement.MOST)
    return {"podAntiAffinity": {"preferredDuringSchedulingIgnoredDuringExecution": [term]}}


def address(service_: Object | None) -> str | None:
    """Return the address of a Service, or None if it has none yet."""
    found: str | None = ((service_ or {}).get("spec") or {}).get("clusterIP")
    return found if found and found != "None" else None

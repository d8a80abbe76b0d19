"""Cuts a pod off from the network with an ephemeral container, which ends the fault by itself even if the caller is gone.

A NetworkPolicy cannot do it, because policies are additive. An ephemeral container shares the network of its pod, so its filter
applies to all containers of the pod, and none of them needs a tool or a permission.
"""

from __future__ import annotations

import ipaddress
import select
import subprocess
import time
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any

from understudy.cli.common.cluster_access.kubectl import Kubectl
from understudy.cli.common.cluster_access.kubectl_proxy import Api, Refused, proxied
from understudy.cli.common.errors import CommandError
from understudy.cli.inject import network_cut
from understudy.controller.desired import monitor_deployment
from understudy.controller.observed import kube_objects
from understudy.kube.client import PODS, STRATEGIC, Object
from understudy.kube.decoding import decode

MONITOR = "monitor"
"""Stands for the addresses of the workload's monitor."""

START_WITHIN = 60.0
"""Seconds within which the container must start. It cannot be removed from the pod, so it does nothing if it starts later."""

CHECK_PERIOD = 0.3
"""Seconds between two checks whether it started."""

PATIENCE = 30.0
"""Seconds that its output may take to arrive."""

_EARLY = 0.2
"""A fault that lasted at least this many seconds less than planned was ended by somebody."""

_UNDO = 'kill "$1"'


@dataclass(frozen=True)
class Method:
    """How a pod is cut off, and from which peers."""

    image: str
    pull_policy: str
    peers: tuple[str, ...]
    """Addresses and networks; empty for everything."""


def means(kubectl: Kubectl, name: str, whom: Sequence[str]) -> Method:
    """Determine the image, which is that of the monitor, and the peers. Raises CommandError."""
    selector = ",".join(f"{key}={value}" for key, value in monitor_deployment.labels(name).items())
    items: list[Object] = kubectl.get("pods", "-l", selector)["items"]
    if not items:
        raise CommandError(f"{name} has no monitor pod, whose image is needed: understudy explain {name}")
    monitor = max(items, key=kube_objects.sort_key)
    made_of = monitor["spec"]["containers"][0]
    peers = tuple(peer for one in whom for peer in _addresses(one, monitor))
    return Method(made_of["image"], made_of.get("imagePullPolicy") or "IfNotPresent", peers)


def _addresses(whom: str, monitor: Object) -> list[str]:
    if whom == MONITOR:
        own = [entry["ip"] for entry in (monitor.get("status") or {}).get("podIPs") or []]
        if not own:
            raise CommandError(f"--from {MONITOR}: pod {kube_objects.name(monitor)} does not have an address yet")
        return own
    try:
        ipaddress.ip_network(whom)
    except ValueError as error:
        raise CommandError(
            f'--from "{whom}": write {MONITOR}, an address, or a network such as 10.0.7.0/24 ({error})'
        ) from error
    return [whom]


def cut_off(kubectl: Kubectl, pod: str, means: Method, length: float) -> None:
    """Cut a pod off and wait until it is connected again. Raises CommandError."""
    name = f"partition-{uuid.uuid4().hex[:6]}"
    try:
        with proxied(kubectl) as api:
            _add_container(api, kubectl.namespace, pod, container(name, means, length))
            _wait_started(api, kubectl.namespace, pod, name)
        _follow(kubectl, pod, name, length, ", ".join(means.peers) or "the network")
    except KeyboardInterrupt:
        raise CommandError(f"container {name} may still cut pod {pod} off, for {length:g} s") from None


def container(name: str, means: Method, length: float) -> Object:
    """Build the container, without the time after which it must not start."""
    return {
        "name": name,
        "image": means.image,
        "imagePullPolicy": means.pull_policy,
        "command": ["python3", "-IS", "-c", Path(network_cut.__file__).read_text(), f"{length:g}", *means.peers],
        # Its error message is then in the pod's status.
        "terminationMessagePolicy": "FallbackToLogsOnError",
        "securityContext": {
            "runAsUser": 0,
            "runAsGroup": 0,
            "runAsNonRoot": False,
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"], "add": ["NET_ADMIN"]},
            "seccompProfile": {"type": "RuntimeDefault"},
        },
    }


def _add_container(api: Api, namespace: str, pod: str, made: Object) -> None:
    """Add the container to a pod. Raises CommandError, also if it would cut off more than the pod."""
    found = api.request("GET", PODS.path(namespace, pod))
    if found.body["spec"].get("hostNetwork"):
        raise CommandError(f"pod {pod} uses its node's network (hostNetwork): the whole node would be cut off")
    latest = parsedate_to_datetime(found.date).timestamp() + START_WITHIN
    body = {"spec": {"ephemeralContainers": [made | {"env": [{"name": network_cut.LATEST, "value": f"{latest:.0f}"}]}]}}
    try:
        api.request("PATCH", PODS.path(namespace, pod, "ephemeralcontainers"), body, kind=STRATEGIC)
    except Refused as refused:
        if "violates PodSecurity" in str(refused):
            raise CommandError(
                f"the Pod Security Standard of namespace {namespace} does not allow NET_ADMIN, which a partition requires. "
                f"To allow it: kubectl label --overwrite namespace {namespace} "
                f"pod-security.kubernetes.io/enforce=privileged ({refused})"
            ) from refused
        if refused.status == 403:
            raise CommandError(
                f"{refused}. A partition requires permission to patch pods/ephemeralcontainers; the ClusterRole edit lacks it"
            ) from refused
        raise


def _wait_started(api: Api, namespace: str, pod: str, name: str) -> None:
    """Wait until the container runs or has ended. Raises CommandError."""
    end = time.monotonic() + START_WITHIN
    while True:
        status = api.get(PODS.path(namespace, pod)).get("status") or {}
        statuses = status.get("ephemeralContainerStatuses") or []
        state: Object = next((one.get("state") or {} for one in statuses if one["name"] == name), {})
        if "running" in state:
            return
        if ended := state.get("terminated"):
            if ended.get("exitCode"):
                raise CommandError(_not_cut_off(pod, ended.get("message") or ended.get("reason") or ""))
            return
        if time.monotonic() > end:
            waiting = state.get("waiting") or {}
            text = ": ".join(filter(None, (waiting.get("reason"), waiting.get("message")))) or "no reason is reported"
            raise CommandError(
                f"container {name} of pod {pod} did not start within {START_WITHIN:g} s ({text}), and does nothing now"
            )
        time.sleep(CHECK_PERIOD)


_NO_LOG = "unable to retrieve container logs"
"""What kubectl prints in place of the log of a container that is gone; it ends as usual then."""


def _not_cut_off(pod: str, text: str) -> str:
    return f"pod {pod} was not cut off: {text.strip() or 'its container ended without a message'}"


def _follow(kubectl: Kubectl, pod: str, name: str, length: float, where: str) -> None:
    """Print when the pod is cut off and when it is connected again, as the container reports it. Raises CommandError."""
    command = kubectl.command("logs", "--follow", pod, "-c", name)
    # Ctrl-C must reach this process only, which still has to undo the fault.
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True) as running:
        started: dict[str, Any] = {}
        try:
            started = _next_report(pod, running, PATIENCE) or {}
            if not started:
                # A recovery may delete the pod before its log is read.
                found = kubectl.find("pods", pod)
                if found is None or found["metadata"].get("deletionTimestamp"):
                    print(f"{pod}: the pod was deleted while container {name} ran; the fault ended with it", flush=True)
                    return
                raise CommandError(_not_cut_off(pod, _errors(running)))
            print(f"{pod}: container {name} cut it off from {where}, for {length:g} s", flush=True)
            ended = _next_report(pod, running, length + PATIENCE)
        except KeyboardInterrupt:
            if not started:
                raise
            kubectl.execute(pod, name, "sh", "-c", _UNDO, "sh", str(started["process"]))
            print(f"\n{pod}: it is connected again", flush=True)
            return
        finally:
            running.terminate()
    if ended is None:
        print(
            f"{pod}: the container no longer reports; the fault ends by itself, or ended with the pod",
            flush=True,
        )
        return
    lasted = ended["back"] - started["cut"]
    early = ", because the container was stopped" if lasted < length - _EARLY else ""
    print(f"{pod}: it is connected again after {lasted:.1f} s{early}", flush=True)


def _errors(running: subprocess.Popen[bytes]) -> str:
    """End kubectl and return its error messages."""
    assert running.stderr is not None, "it is a pipe"
    running.terminate()
    return running.stderr.read().decode(errors="replace")


def _next_report(pod: str, running: subprocess.Popen[bytes], within: float) -> dict[str, Any] | None:
    """Read the container's next report; None if there is none. Raises CommandError with its output if that is an error."""
    assert running.stdout is not None, "it is a pipe"
    if not select.select([running.stdout], [], [], within)[0]:
        return None
    line = running.stdout.readline().decode(errors="replace")
    if not line or line.startswith(_NO_LOG):
        return None
    try:
        found = decode(line)
    except ValueError as error:
        raise CommandError(_not_cut_off(pod, line)) from error
    if not isinstance(found, dict):
        raise CommandError(_not_cut_off(pod, line))
    return found

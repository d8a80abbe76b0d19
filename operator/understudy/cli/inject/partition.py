"""A pod is cut off from the network by a container that is put into it, and that ends it by itself, whatever becomes of who asked.

A policy can't do it, since policies add up. An ephemeral container shares the network of its pod: what is dropped there is dropped for
all of the pod's containers, and none of them needs a tool or a right for it.
"""

from __future__ import annotations

import ipaddress
import json
import select
import subprocess
import time
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any

from understudy.cli.common.errors import CommandError
from understudy.cli.common.kubectl import Kubectl
from understudy.cli.common.kubectl_proxy import Api, Refused, proxied
from understudy.cli.inject import network_cut
from understudy.controller.desired import monitor_deployment
from understudy.controller.observed import kube_objects
from understudy.kube.client import PODS, STRATEGIC, Object

MONITOR = "monitor"
"""In the place of an address: those of the workload's monitor."""

START_WITHIN = 60.0
"""Seconds that the container has to start. It can't be taken out of the pod again, so it does nothing if it starts later."""

LOOK = 0.3
"""Seconds between two looks whether it has."""

PATIENCE = 30.0
"""Seconds that its words may take to come here."""

_EARLY = 0.2
"""Seconds by which it ends before its time where that was somebody's doing."""

_UNDO = 'kill "$1"'


@dataclass(frozen=True)
class Means:
    """What a pod is cut off by, and from whom."""

    image: str
    pull_policy: str
    peers: tuple[str, ...]
    """Addresses and networks; none where it is cut off from everything."""


def means(kubectl: Kubectl, name: str, whom: Sequence[str]) -> Means:
    """Find them for the instances of a workload: the image is that of its monitor. Raises CommandError."""
    selector = ",".join(f"{key}={value}" for key, value in monitor_deployment.labels(name).items())
    items: list[Object] = kubectl.get("pods", "-l", selector)["items"]
    if not items:
        raise CommandError(f"the monitor of {name} isn't there, and its image is needed: understudy explain {name}")
    monitor = max(items, key=kube_objects.sort_key)
    made_of = monitor["spec"]["containers"][0]
    peers = tuple(peer for one in whom for peer in _addresses(one, monitor))
    return Means(made_of["image"], made_of.get("imagePullPolicy") or "IfNotPresent", peers)


def _addresses(whom: str, monitor: Object) -> list[str]:
    if whom == MONITOR:
        own = [entry["ip"] for entry in (monitor.get("status") or {}).get("podIPs") or []]
        if not own:
            raise CommandError(f"--from {MONITOR}: pod {kube_objects.name(monitor)} has no address yet")
        return own
    try:
        ipaddress.ip_network(whom)
    except ValueError as error:
        raise CommandError(
            f'--from "{whom}": write {MONITOR}, an address, or a network such as 10.0.7.0/24 ({error})'
        ) from error
    return [whom]


def cut_off(kubectl: Kubectl, pod: str, given: Means, length: float) -> None:
    """Cut a pod off, and wait until that is over. Raises CommandError."""
    name = f"partition-{uuid.uuid4().hex[:6]}"
    try:
        with proxied(kubectl) as api:
            _put_in(api, kubectl.namespace, pod, container(name, given, length))
            _wait_started(api, kubectl.namespace, pod, name)
        _follow(kubectl, pod, name, length, ", ".join(given.peers) or "the network")
    except KeyboardInterrupt:
        raise CommandError(f"container {name} of pod {pod} may still cut it off, for {length:g} s") from None


def container(name: str, given: Means, length: float) -> Object:
    """The container, but for the moment after which it may not begin any more."""
    return {
        "name": name,
        "image": given.image,
        "imagePullPolicy": given.pull_policy,
        "command": ["python3", "-IS", "-c", Path(network_cut.__file__).read_text(), f"{length:g}", *given.peers],
        # What it says of an error is in the pod's status then.
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


def _put_in(api: Api, namespace: str, pod: str, made: Object) -> None:
    """Put the container into a pod. Raises CommandError, also where it would cut off more than the pod."""
    found = api.request("GET", PODS.path(namespace, pod))
    if found.body["spec"].get("hostNetwork"):
        raise CommandError(f"pod {pod} is in its node's network (hostNetwork): all of the node would be cut off")
    latest = parsedate_to_datetime(found.date).timestamp() + START_WITHIN
    body = {"spec": {"ephemeralContainers": [made | {"env": [{"name": network_cut.LATEST, "value": f"{latest:.0f}"}]}]}}
    try:
        api.request("PATCH", PODS.path(namespace, pod, "ephemeralcontainers"), body, kind=STRATEGIC)
    except Refused as refused:
        if "violates PodSecurity" in str(refused):
            raise CommandError(
                f"the Pod Security Standard of namespace {namespace} lets no container have NET_ADMIN, by which a pod is cut off. "
                f"Where it is for rehearsals: kubectl label --overwrite namespace {namespace} "
                f"pod-security.kubernetes.io/enforce=privileged ({refused})"
            ) from refused
        if refused.status == 403:
            raise CommandError(
                f"{refused}. To cut a pod off takes the right to patch pods/ephemeralcontainers, which the ClusterRole edit hasn't"
            ) from refused
        raise


def _wait_started(api: Api, namespace: str, pod: str, name: str) -> None:
    """Wait until the container runs, or has run. Raises CommandError."""
    end = time.monotonic() + START_WITHIN
    while True:
        status = api.get(PODS.path(namespace, pod)).get("status") or {}
        statuses = status.get("ephemeralContainerStatuses") or []
        state: Object = next((one.get("state") or {} for one in statuses if one["name"] == name), {})
        if "running" in state:
            return
        if ended := state.get("terminated"):
            if ended.get("exitCode"):
                raise CommandError(_last_words(pod, ended.get("message") or ended.get("reason") or ""))
            return
        if time.monotonic() > end:
            waiting = state.get("waiting") or {}
            said = ": ".join(filter(None, (waiting.get("reason"), waiting.get("message")))) or "nothing is said of it"
            raise CommandError(
                f"container {name} of pod {pod} hasn't started within {START_WITHIN:g} s ({said}), and does nothing now"
            )
        time.sleep(LOOK)


def _last_words(pod: str, said: str) -> str:
    return f"pod {pod} wasn't cut off: {said.strip() or 'its container ended without a word'}"


def _follow(kubectl: Kubectl, pod: str, name: str, length: float, where: str) -> None:
    """Say when it is cut off and when it is back, as the container says. Raises CommandError."""
    command = kubectl.command("logs", "--follow", pod, "-c", name)
    # Ctrl-C is for this process only, which then still has to undo it.
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as running:
        begun: dict[str, Any] = {}
        try:
            begun = _told(pod, running, PATIENCE) or {}
            if not begun:
                raise CommandError(_last_words(pod, ""))
            print(f"{pod}: container {name} has cut it off from {where}, for {length:g} s", flush=True)
            ended = _told(pod, running, length + PATIENCE)
        except KeyboardInterrupt:
            if not begun:
                raise
            kubectl.execute(pod, name, "sh", "-c", _UNDO, "sh", str(begun["process"]))
            print(f"\n{pod}: it is connected again", flush=True)
            return
        finally:
            running.terminate()
    if ended is None:
        print(
            f"{pod}: nothing is heard of the container any more; it ends by itself, or has ended with the pod",
            flush=True,
        )
        return
    lasted = ended["back"] - begun["cut"]
    early = ", since the container was ended" if lasted < length - _EARLY else ""
    print(f"{pod}: it is connected again after {lasted:.1f} s{early}", flush=True)


def _told(pod: str, running: subprocess.Popen[bytes], within: float) -> dict[str, Any] | None:
    """What the container says next; None where it says nothing more. Raises CommandError with other words than those of a success."""
    assert running.stdout is not None, "it is a pipe"
    if not select.select([running.stdout], [], [], within)[0]:
        return None
    line = running.stdout.readline().decode(errors="replace")
    if not line:
        return None
    try:
        found: dict[str, Any] = json.loads(line)
    except ValueError as error:
        raise CommandError(_last_words(pod, line)) from error
    return found

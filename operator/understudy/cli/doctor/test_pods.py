"""A short-lived pair of pods by which ``understudy doctor`` sees what the network does, and the policies that it puts on one of them.

All of it has one label, by which it is taken away again: at the end, after Ctrl-C and after an error. If this process is killed, its
pods end by themselves, and the next run clears them away.
"""

from __future__ import annotations

import contextlib
import copy
import json
import signal
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from understudy.api import names
from understudy.cli.common.errors import CommandError
from understudy.cli.common.kubectl import Kubectl
from understudy.cli.common.kubectl_proxy import Answer, Api
from understudy.cli.common.pod_session import Session, session
from understudy.cli.common.wording import unix
from understudy.cli.doctor import pod_program
from understudy.controller.observed import kube_objects
from understudy.controller.observed.pod_diagnosis import trouble
from understudy.controller.plan import Images, pull_secrets
from understudy.controller.pods.instance_pod import HARDENED
from understudy.controller.pods.pod_placement import away_from
from understudy.kube.client import MERGE, PODS, Object, Resource
from understudy.kube.gates import registry
from understudy.ros.rmw import MIDDLEWARE

LABEL = f"{names.GROUP}/doctor"
"""On everything that is made, with the name of the run. Not the labels of instances, which operator and monitors would look after."""

_WORKLOAD, _INSTANCE = f"{names.GROUP}/doctor-workload", f"{names.GROUP}/doctor-instance"
"""On the sender, in the place of an instance's own: what the policies select it by."""

LIFETIME = 300
"""Seconds after which a pod ends by itself, whatever became of who made it."""

START_WITHIN = 90.0
"""Seconds that the pods have to start."""

LOOK = 0.3
"""Seconds between two looks whether they have."""

_CONTAINER = "doctor"
_GATE = registry.DEFAULT

_KINDS = ",".join(["pods", *(resource.plural for resource in registry.FENCING_RESOURCES)])


@dataclass(frozen=True)
class Pods:
    """The pair while it runs."""

    api: Api
    kubectl: Kubectl
    run: str
    sender: Object
    receiver: Object

    @contextlib.contextmanager
    def talking(self, pod: Object, *arguments: str) -> Iterator[Session]:
        """A conversation with the doctor's program in a pod."""
        program = Path(pod_program.__file__).read_text()
        with session(self.kubectl, kube_objects.name(pod), _CONTAINER, "python3", "-c", program, *arguments) as made:
            yield made

    def fence(self) -> Answer:
        """Put the sender behind the closed gate of an instance; the answer to the last write."""
        answer = self._write("POST", _GATE.resource, None, self._as_the_doctors(_GATE.closed(self.run, epoch=0)))
        for resource, companion in self._companions:
            answer = self._write("POST", resource, None, self._as_the_doctors(companion))
        return answer

    def open_gate(self) -> Answer:
        """Let the sender through the gate."""
        return self._commit(kube_objects.name(self.sender))

    def close_gate(self) -> Answer:
        """Let nobody through the gate."""
        return self._commit("")

    def lift(self) -> Answer:
        """Delete the gate and what belongs to it; the answer to the last write."""
        answer = self._write("DELETE", _GATE.resource, names.gate(self.run))
        for resource, companion in self._companions:
            answer = self._write("DELETE", resource, kube_objects.name(companion))
        return answer

    @property
    def _companions(self) -> list[tuple[Resource, Object]]:
        return _GATE.companions(self.run, [], None)

    def _commit(self, active: str) -> Answer:
        patch = relabelled(_GATE.routing(self.run, active))
        return self._write("PATCH", _GATE.resource, names.gate(self.run), patch, kind=MERGE)

    def _as_the_doctors(self, item: Object) -> Object:
        made = relabelled(item)
        made["metadata"]["labels"] = {LABEL: self.run}
        return made

    def _write(
        self, method: str, resource: Resource, name: str | None, body: Any = None, *, kind: str = "application/json"
    ) -> Answer:
        return self.api.request(method, resource.path(self.kubectl.namespace, name), body, kind=kind)


@contextlib.contextmanager
def pair(kubectl: Kubectl, api: Api, images: Images, progress: Callable[[str], None]) -> Iterator[Pods]:
    """Two running pods on two nodes where there are two, gone when the context ends. Raises CommandError and Refused."""
    run = f"understudy-doctor-{uuid.uuid4().hex[:6]}"
    _sweep(kubectl)
    try:
        with _ended_as_by_ctrl_c():
            progress("making two pods")
            path = PODS.path(kubectl.namespace)
            for role in ("sender", "receiver"):
                api.request("POST", path, pod(run, role, images))
            yield Pods(api, kubectl, run, *_started(api, kubectl.namespace, run))
    finally:
        with _uninterrupted():
            progress("clearing up")
            _clear(kubectl, run)


def pod(run: str, role: str, images: Images) -> Object:
    """One of the pair. It does nothing by itself, and fits the Pod Security Standard ``restricted``."""
    name = f"{run}-{role}"
    sender = {_WORKLOAD: run, _INSTANCE: name} if role == "sender" else {}
    container = {
        "name": _CONTAINER,
        "image": images.monitor,
        "imagePullPolicy": images.pull_policy,
        "command": ["sleep", str(LIFETIME)],
        "env": [{"name": "HOME", "value": "/tmp"}, {"name": "RMW_IMPLEMENTATION", "value": MIDDLEWARE.implementation}],
        "resources": {"requests": {"cpu": "20m", "memory": "64Mi"}, "limits": {"cpu": "1", "memory": "256Mi"}},
        "securityContext": copy.deepcopy(HARDENED),
        "volumeMounts": [{"name": "tmp", "mountPath": "/tmp"}],
    }
    return {
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": {"name": name, "labels": {LABEL: run, **sender}},
        "spec": {
            "restartPolicy": "Never",
            "activeDeadlineSeconds": LIFETIME,
            "terminationGracePeriodSeconds": 1,
            "automountServiceAccountToken": False,
            "enableServiceLinks": False,
            "affinity": {
                "podAntiAffinity": {"preferredDuringSchedulingIgnoredDuringExecution": [away_from({LABEL: run}, 100)]}
            },
            **pull_secrets(images.pull_secrets),
            "containers": [container],
            "volumes": [{"name": "tmp", "emptyDir": {}}],
        },
    }


def _started(api: Api, namespace: str, run: str) -> tuple[Object, Object]:
    """Sender and receiver, once both run."""
    end = time.monotonic() + START_WITHIN
    while True:
        items = [api.get(PODS.path(namespace, f"{run}-{role}")) for role in ("sender", "receiver")]
        if all(kube_objects.ready(item) for item in items):
            return items[0], items[1]
        troubles = [found.message for found in map(trouble, items) if found is not None]
        if troubles or time.monotonic() > end:
            raise CommandError(troubles[0] if troubles else f"its pods had not started after {START_WITHIN:g} s")
        time.sleep(LOOK)


def relabelled(item: Object) -> Object:
    """What the operator creates for a workload, for pods with the labels of this check instead of an instance's."""
    text = json.dumps(item).replace(f'"{names.WORKLOAD}"', f'"{_WORKLOAD}"')
    made: Object = json.loads(text.replace(f'"{names.INSTANCE}"', f'"{_INSTANCE}"'))
    return made


def _sweep(kubectl: Kubectl) -> None:
    """Clear away what a run that was killed has left."""
    for item in kubectl.get(_KINDS, "-l", LABEL)["items"]:
        if time.time() - unix(item["metadata"]["creationTimestamp"]) > 2 * LIFETIME:
            _clear(kubectl, item["metadata"]["labels"][LABEL])


def _clear(kubectl: Kubectl, run: str) -> None:
    try:
        kubectl.delete(_KINDS, "-l", f"{LABEL}={run}")
    except CommandError as error:
        raise CommandError(
            f"its pods and policies are still there ({error}): kubectl delete {_KINDS} -n {kubectl.namespace} -l {LABEL}={run}"
        ) from error


@contextlib.contextmanager
def _ended_as_by_ctrl_c() -> Iterator[None]:
    """While the context lasts, end at a closed terminal and at SIGTERM as at Ctrl-C: not without clearing up."""
    numbers = (signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, signal.default_int_handler) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """While the context lasts, which is short, nothing but SIGKILL ends it."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, signal.SIG_IGN) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

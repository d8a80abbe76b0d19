"""Creates a short-lived pair of pods with which ``understudy doctor`` tests the network, and the policies for one of
them.

All these objects have one label, which selects them for deletion: at the end, after Ctrl-C and after an error. If this
process is killed, its pods end on their own, and the next run deletes them.
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
from understudy.cli.common.cluster_access.kubectl import Kubectl
from understudy.cli.common.cluster_access.kubectl_proxy import Answer, Api
from understudy.cli.common.cluster_access.pod_session import Session, session
from understudy.cli.common.errors import CommandError
from understudy.cli.common.text.wording import unix
from understudy.cli.doctor import pod_program
from understudy.controller.observed import kube_objects
from understudy.controller.observed.pod_diagnosis import trouble
from understudy.controller.plan import Images, pull_secrets
from understudy.controller.pods.instance_pod import HARDENED
from understudy.controller.pods.pod_placement import away_from
from understudy.kube.client import MERGE, PODS, Object, Resource
from understudy.kube.gates import registry
from understudy.kube.gates.base import Reach
from understudy.ros.rmw import MIDDLEWARE

LABEL = f"{names.GROUP}/doctor"
"""Label of every created object, with the name of the run. Instances' labels are not used: operator and monitors would
act on them."""

_WORKLOAD, _INSTANCE = f"{names.GROUP}/doctor-workload", f"{names.GROUP}/doctor-instance"
"""Labels of the sender in place of an instance's own. The policies select it with them."""

LIFETIME = 300
"""Seconds after which a pod ends on its own, also if its creator was killed."""

START_WITHIN = 90.0
"""Seconds within which the pods must start."""

CHECK_PERIOD = 0.3
"""Seconds between two checks whether the pods have started."""

_CONTAINER = "doctor"
_GATE = registry.DEFAULT

_KINDS = f"pods,{_GATE.resource.plural}"


@dataclass(frozen=True)
class Pods:
    """The pair of pods while it runs."""

    api: Api
    kubectl: Kubectl
    run: str
    sender: Object
    receiver: Object

    @contextlib.contextmanager
    def talking(self, pod: Object, *arguments: str) -> Iterator[Session]:
        """Start a session with the doctor's program in a pod."""
        program = Path(pod_program.__file__).read_text()
        with session(self.kubectl, kube_objects.name(pod), _CONTAINER, "python3", "-c", program, *arguments) as made:
            yield made

    def fence(self) -> Answer:
        """Put the sender behind the closed gate of an instance, and return the answer to the last write."""
        answer = self._write(
            "POST", _GATE.resource, None, self._as_the_doctors(_GATE.closed(self.run, Reach(), epoch=0))
        )
        for resource, companion in self._companions:
            answer = self._write("POST", resource, None, self._as_the_doctors(companion))
        return answer

    def open_gate(self) -> Answer:
        """Let the sender through the gate."""
        return self._commit(kube_objects.name(self.sender))

    def close_gate(self) -> Answer:
        """Close the gate for all pods."""
        return self._commit("")

    def lift(self) -> Answer:
        """Delete the gate and its other objects, and return the answer to the last write."""
        answer = self._write("DELETE", _GATE.resource, names.gate(self.run))
        for resource, companion in self._companions:
            answer = self._write("DELETE", resource, kube_objects.name(companion))
        return answer

    @property
    def _companions(self) -> list[tuple[Resource, Object]]:
        return _GATE.companions(self.run, Reach())

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
    """Run two pods, on two nodes if there are two, and delete them when the context ends. Raises CommandError and
    Refused."""
    run = f"understudy-doctor-{uuid.uuid4().hex[:6]}"
    _sweep(kubectl)
    try:
        # SIGTERM and a closed terminal end it like Ctrl-C, so that the pods are deleted.
        with _handling(signal.default_int_handler, signal.SIGTERM, signal.SIGHUP):
            progress("creating two test pods")
            path = PODS.path(kubectl.namespace)
            for role in ("sender", "receiver"):
                api.request("POST", path, pod(run, role, images))
            yield Pods(api, kubectl, run, *_started(api, kubectl.namespace, run))
    finally:
        with _handling(signal.SIG_IGN, signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            progress("deleting the test pods")
            _clear(kubectl, run)


def pod(run: str, role: str, images: Images) -> Object:
    """Build one pod of the pair. It does nothing on its own, and conforms to the Pod Security Standard
    ``restricted``."""
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
    """Return sender and receiver once both run."""
    end = time.monotonic() + START_WITHIN
    while True:
        items = [api.get(PODS.path(namespace, f"{run}-{role}")) for role in ("sender", "receiver")]
        if all(kube_objects.ready(item) for item in items):
            return items[0], items[1]
        troubles = [found.message for found in map(trouble, items) if found is not None]
        if troubles or time.monotonic() > end:
            raise CommandError(troubles[0] if troubles else f"its pods had not started after {START_WITHIN:g} s")
        time.sleep(CHECK_PERIOD)


def relabelled(item: Object) -> Object:
    """Return an object as the operator creates it for a workload, with this check's labels in place of an
    instance's."""
    text = json.dumps(item).replace(f'"{names.WORKLOAD}"', f'"{_WORKLOAD}"')
    made: Object = json.loads(text.replace(f'"{names.INSTANCE}"', f'"{_INSTANCE}"'))
    return made


def _sweep(kubectl: Kubectl) -> None:
    """Delete what a killed run left behind."""
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
def _handling(handler: Callable[..., None] | signal.Handlers, *numbers: signal.Signals) -> Iterator[None]:
    """Handle signals in this way for the duration of the context."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)

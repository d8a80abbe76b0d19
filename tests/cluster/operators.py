"""An operator and its objects on the test cluster, for tests."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import threading
import time
import urllib.request
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.support import gates
from tests.support.cluster import Cluster, Object, until
from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.controller.plan import Images
from understudy.controller.reconcile.reconciler import TOGETHER_SECONDS
from understudy.controller.runtime import process as running
from understudy.kube import claims
from understudy.kube.client import Client
from understudy.kube.gates.base import GateRecord
from understudy.kube.kubeconfig import load_access

APPS, CORE, NETWORK, RBAC = "apps/v1", "v1", "networking.k8s.io/v1", "rbac.authorization.k8s.io/v1"


POLICY = "policy/v1"


NOWHERE = "understudy.invalid/nowhere:1"


REPOSITORY = Path(__file__).resolve().parents[2]
IMAGES = Images(NOWHERE, "Never")


BUILT = (
    (CORE, "Service"),
    (CORE, "ConfigMap"),
    (CORE, "Secret"),
    (CORE, "ServiceAccount"),
    (APPS, "Deployment"),
    (APPS, "ReplicaSet"),
    (NETWORK, "NetworkPolicy"),
    (POLICY, "PodDisruptionBudget"),
    (RBAC, "Role"),
    (RBAC, "RoleBinding"),
)


def template(**container: Any) -> Object:
    """A template at the Pod Security level `restricted`."""
    hardened = {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}
    found = bare_template(**({"securityContext": hardened} | container))
    found["spec"]["securityContext"] = {"runAsNonRoot": True, "seccompProfile": {"type": "RuntimeDefault"}}
    return found


def bare_template(**container: Any) -> Object:
    """A template without security contexts, at the level `baseline`."""
    app = {"name": "app", "image": NOWHERE, "imagePullPolicy": "Never", "command": ["run"], **container}
    return {
        "metadata": {"labels": {"app": "nav"}},
        "spec": {"schedulerName": "nobody", "terminationGracePeriodSeconds": 0, "containers": [app]},
    }


def custom(kind: str, name: str, spec: Mapping[str, Any], labels: Mapping[str, str] | None = None) -> Object:
    metadata = {"name": name, "labels": dict(labels or {})}
    return {"apiVersion": API_VERSION, "kind": kind, "metadata": metadata, "spec": dict(spec)}


def workload(name: str = "w", **spec: Any) -> Object:
    found = {
        "template": template(),
        "outputs": [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}],
        "failurePolicyRef": {"name": "policy"},
        **spec,
    }
    if "workloadRef" in found:
        del found["template"]
    return custom("RobotWorkload", name, found, {"task": "critical"})


def policy(*strategies: str, name: str = "policy", yaml: Object | None = None) -> Object:
    tree = yaml or {"topic": {"name": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "gap": "500ms"}}
    listed: list[Object] = [
        {"type": "Restart"} if s == "Restart" else {"type": "Fallback", "poolRef": {"name": s}} for s in strategies
    ]
    return custom("FailurePolicy", name, {"monitoring": {"yaml": tree}, "strategies": listed})


SELECTOR = {"matchLabels": {"task": "critical"}}


def hot(per_workload: int = 1) -> Object:
    spec = {"readiness": "Executing", "perWorkload": per_workload, "workloadSelector": SELECTOR}
    return custom("FallbackPool", "hot", spec)


def spare(replicas: int = 2, **spec: Any) -> Object:
    found = {"readiness": "Uninitialized", "replicas": replicas, "workloadSelector": SELECTOR, **spec}
    if "templateFrom" not in found:
        found.setdefault("template", template())
    return custom("FallbackPool", "spare", found)


class Fleet:
    """One namespace of the cluster, as a user sees it."""

    def __init__(self, cluster: Cluster, namespace: str) -> None:
        self.cluster, self.namespace = cluster, namespace

    def create(self, *items: Object) -> None:
        for item in items:
            self.cluster.create(item, self.namespace, strict=True)

    def get(self, kind: str, name: str, api_version: str = API_VERSION) -> Object:
        return self.cluster.get(api_version, kind, name, self.namespace)

    def find(self, kind: str, name: str, api_version: str = API_VERSION) -> Object | None:
        return self.cluster.find(api_version, kind, name, self.namespace)

    def pods(self, labels: str) -> list[Object]:
        """Pods that are not on their way out."""
        found = self.cluster.list(CORE, "Pod", self.namespace, labels=labels)
        kind = {"apiVersion": CORE, "kind": "Pod"}  # which lists leave out
        return [{**kind, **pod} for pod in found if not pod["metadata"].get("deletionTimestamp")]

    def instances(self, workload: str = "w") -> list[Object]:
        return [*self.pods(f"{names.WORKLOAD}={workload}"), *self.pods(f"{names.CLAIMED_BY}={workload}")]

    def held(self, pool: str = "spare") -> list[Object]:
        return self.pods(f"{names.POOL}={pool},{names.HELD}=true,{names.CLAIMED_BY}=")

    def gate(self, workload: str = "w") -> Object:
        return self.get("NetworkPolicy", names.gate(workload), NETWORK)

    def condition(self, kind: str, name: str, type_: str) -> Object:
        found = (self.get(kind, name).get("status") or {}).get("conditions") or []
        return next((c for c in found if c["type"] == type_), {})

    def wait_condition(self, kind: str, name: str, type_: str, reason: str, status: str = "False") -> Object:
        def said() -> Object | None:
            found = self.condition(kind, name, type_)
            return found if (found.get("status"), found.get("reason")) == (status, reason) else None

        try:
            return until(said, f"{kind} {name} to be {type_}={status} ({reason})", seconds=20) or {}
        except AssertionError as error:
            raise AssertionError(f"{error}: {self.get(kind, name).get('status')}") from error

    def told(self, name: str, reason: str, type_: str = "") -> list[Object]:
        """The Events of a reason, and where it is given of a type, about an object that isn't a pod."""
        return [
            event
            for event in self.cluster.list(CORE, "Event", self.namespace)
            if event["involvedObject"]["name"] == name
            and event["involvedObject"]["kind"] != "Pod"
            and event["reason"] == reason
            and type_ in ("", event["type"])
        ]

    def wait_built(self, name: str = "w") -> None:
        self.wait_condition("RobotWorkload", name, "Reconciled", "Reconciled", "True")

    def make_ready(self, pod: Object, ready: bool = True) -> None:
        """What a kubelet would say."""
        conditions = [{"type": "Ready", "status": "True" if ready else "False"}]
        self.cluster.patch(pod, {"status": {"phase": "Running", "conditions": conditions}}, subresource="status")

    def make_parts_ready(self, workload: str = "w") -> None:
        """A monitor and a discovery server beside those whose image is nowhere."""
        for component in ("monitor", "discovery"):
            labels = {names.COMPONENT: component, names.MONITORED: workload}
            metadata = {"name": f"{workload}-{component}-here", "labels": labels}
            pod = {"apiVersion": CORE, "kind": "Pod", "metadata": metadata, "spec": template()["spec"]}
            self.make_ready(self.cluster.create(pod, self.namespace))

    def commit(self, pod: Object | None, workload: str = "w") -> None:
        """What the monitor does at a switch."""

        async def run() -> None:
            async with Client(load_access(str(self.cluster.kubeconfig))) as client:
                record = GateRecord.of(self.gate(workload))
                active, uid = (pod["metadata"]["name"], pod["metadata"]["uid"]) if pod else ("", "")
                await gates.commit(
                    client, self.namespace, workload, over=record, active=active, active_uid=uid, recovery=""
                )

        asyncio.run(run())

    def claim(self, pod: Object, workload: str = "w") -> None:
        """What the monitor does with a pod of a shared pool."""

        async def run() -> None:
            async with Client(load_access(str(self.cluster.kubeconfig))) as client:
                uid = self.get("RobotWorkload", workload)["metadata"]["uid"]
                await claims.claim(client, pod, workload=workload, workload_uid=uid, claim=f"{uid}/1")

        asyncio.run(run())

    def versions(self) -> dict[str, str]:
        """The versions of all that the operator has a hand in."""
        listed = [(API_VERSION, kind) for kind in ("RobotWorkload", "FailurePolicy", "FallbackPool")]
        found = {}
        for api_version, kind in [*listed, *BUILT]:
            for item in self.cluster.list(api_version, kind, self.namespace):
                name = item["metadata"]["name"]
                if kind == "Deployment":
                    found[f"{kind}/{name}"] = str(item["metadata"]["generation"])
                elif kind == "Service":  # written again on purpose (desired/discovery_server.py: REMINDERS)
                    found[f"{kind}/{name}"] = json.dumps(item["spec"], sort_keys=True)
                elif not name.endswith("-crt"):
                    found[f"{kind}/{name}"] = item["metadata"]["resourceVersion"]
        for pod in self.pods(names.COMPONENT):
            found[f"Pod/{pod['metadata']['name']}"] = pod["metadata"]["uid"]
        return found

    def settled(self) -> dict[str, str]:
        """The versions, once they have stayed the same for longer than the operator waits before it says something."""
        end = time.monotonic() + 40
        before = self.versions()
        while time.monotonic() < end:
            time.sleep(TOGETHER_SECONDS + 1)
            now = self.versions()
            if now == before:
                return now
            before = now
        raise AssertionError("something changes again and again")


class Operator:
    """An operator in a thread of this process, for one namespace."""

    def __init__(
        self, kubeconfig: Path, namespace: str, *, resync_every: float = 30.0, lease_namespace: str = ""
    ) -> None:
        self._access = load_access(str(kubeconfig))
        self._options = running.Options(
            images=IMAGES,
            lease_namespace=lease_namespace or namespace,
            identity=uuid.uuid4().hex[:8],
            namespaces=(namespace,),
            resync_every=resync_every,
            port=0,
        )
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self.status: int | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self.status = self._loop.run_until_complete(running.run(self._access, self._options, stop=self._stop))
        self._loop.close()

    def __enter__(self) -> Operator:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(30)
            assert not self._thread.is_alive(), "the operator didn't end within 30 s"


@contextmanager
def process(fleet: Fleet, identity: str, port: int = 0) -> Iterator[subprocess.Popen[bytes]]:
    """An operator in a process of its own, which says at a port how it is."""
    command = [
        sys.executable, "-m", "understudy", "operator", "--kubeconfig", str(fleet.cluster.kubeconfig),
        "--monitor-image", NOWHERE, "--image-pull-policy", "Never", "--watch-namespace", fleet.namespace,
        "--lease-namespace", fleet.namespace, "--identity", identity, "--port", str(port),
    ]  # fmt: skip
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "operator")}
    found = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
    try:
        yield found
    finally:
        found.kill()
        found.wait(10)


def ready(port: int) -> bool:
    """Whether the operator at a port of this machine says that it knows the cluster."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/ready", timeout=5) as answer:
            return bool(answer.status == 200)
    except OSError:  # not yet, or nobody is there yet
        return False


def leader(fleet: Fleet) -> str:
    lease = fleet.cluster.find("coordination.k8s.io/v1", "Lease", running.LEASE, fleet.namespace)
    found: str = ((lease or {}).get("spec") or {}).get("holderIdentity") or ""
    return found

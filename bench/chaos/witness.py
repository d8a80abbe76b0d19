"""Records a campaign while it goes on: instances, gates, recoveries, logs and memory."""

from __future__ import annotations

import contextlib
import json
import math
import re
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from understudy_demo.recovery import Recovered, unix
from urllib3.exceptions import HTTPError

from bench.chaos.judge import LAG, LEADS, Commit
from tests.e2e.conftest import SYSTEM
from tests.e2e.faults import pod_logs, process_ids
from tests.e2e.kubectl import Failed, Kubectl, Object
from tests.support.cluster import Cluster, Refused
from understudy.api import names
from understudy.controller.observed import kube_objects
from understudy.controller.runtime.process import LEASE
from understudy.failover.progress import Progress

PERIOD = 1.0
"""Seconds between two readings of pods and workloads."""

LOGS_PERIOD = 2.0

WRITTEN = 1.0
"""Seconds to which the API server notes when an object was written."""

STARTS_WITHIN = 5.0
"""Seconds from the creation of a pod until a kubelet begins to start it, which take less than one. After outages of the API server,
the controllers, the scheduler and the kubelets connect again after up to 30 s each."""

RENEWED_WITHIN = 6.0
"""Seconds between two renewals of the operator's lease, which are due every 2 s, up to which one leads."""

FOLLOWING = 40
"""Lines of a traceback that are kept."""

UNREACHABLE = (Failed, Refused, HTTPError, OSError, ValueError)


@dataclass(frozen=True)
class PodSeen:
    """A pod as it was last seen."""

    name: str
    uid: str
    node: str
    labels: Mapping[str, str]
    ready_since: float
    """Unix seconds; 0 if it is not ready."""
    owner: str
    address: str
    is_down: bool
    """Whether it is a monitor's and that container does not run, which the API server knows."""
    deleted: float
    """Unix seconds at which its grace period ends or ended; 0 if it is not being deleted."""


@dataclass(frozen=True)
class Traceback:
    """Something that a log reported and nobody expected."""

    source: str
    """The log's file."""
    at: float
    text: str

    @property
    def last(self) -> str:
        """The line that says what was raised."""
        return next((line for line in reversed(self.text.splitlines()) if re.match(r"\S*(Error|Exception|Handle)", line)),
                    self.text.splitlines()[0])  # fmt: skip


class Witness:
    """Watches a campaign's namespace from threads of its own, for the duration of the context.

    ``folder`` gets the logs of all containers: who looks into a violation needs them when the namespace is gone.
    """

    def __init__(self, kubectl: Kubectl, workloads: Sequence[str], folder: Path) -> None:
        self._kubectl, self._workloads, self._folder = kubectl, workloads, folder
        self._pods: dict[str, PodSeen] = {}
        self._operators: list[PodSeen] = []
        self._status: dict[str, Object] = {}
        self._recoveries: dict[tuple[str, int], Object] = {}
        self._commits: dict[str, list[Commit]] = {names.gate(workload): [] for workload in workloads}
        self._nodes: dict[str, str] = {}
        self._monitors: dict[str, dict[float, str]] = {workload: {} for workload in workloads}
        self._ran: dict[str, dict[tuple[str, float], tuple[float, float]]] = {workload: {} for workload in workloads}
        """From when to when each monitor of a workload was seen to run, by its pod's UID and by when it became ready."""
        self._servers: dict[str, dict[float, str]] = {workload: {} for workload in workloads}
        self._astray: dict[str, list[tuple[float, float]]] = {workload: [] for workload in workloads}
        """From when to when no ready discovery server of a workload was among the endpoints of its Service."""
        self._is_astray: set[str] = set()
        self._renewals: set[float] = set()
        self._begun: dict[str, tuple[set[str], float, float]] = {}
        """By the UID of a pod: the values of its labels, when it was created, and when a kubelet began to start it, or it was last seen."""
        self._deleted: dict[str, float] = {}
        self._created: dict[str, float] = {}
        self._evicted: dict[str, tuple[str, float]] = {}
        """By the UID of a monitor's pod: its workload, and when it was first seen to be evicted."""
        self._unmuxed: dict[str, set[tuple[float, float]]] = {}
        """By the label ``app`` of a robot: from when to when the container of its mux did not run."""
        self._read: dict[Path, int] = {}
        self.tracebacks: list[Traceback] = []
        self._ended = threading.Event()

    def __enter__(self) -> Witness:
        self._look()
        for work in (
            lambda: self._follow_gates("networking.k8s.io/v1", "NetworkPolicy"),
            lambda: self._follow_gates("coordination.k8s.io/v1", "Lease"),
            self._poll,
            self._follow_logs,
        ):
            threading.Thread(target=work, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()

    # -- what it knows ---------------------------------------------------------------------------------------------

    def active(self, workload: str) -> str:
        """Return the active instance, by the gate."""
        commits = self._commits[names.gate(workload)]
        return commits[-1].let_through[0] if commits and commits[-1].let_through else ""

    def instances(self, workload: str) -> list[PodSeen]:
        """Return the instances of a workload that run and are not being deleted."""
        return [pod for pod in self._living() if pod.labels.get(names.WORKLOAD) == workload]

    def parts(self, workload: str, component: str) -> list[PodSeen]:
        """Return its monitor or its discovery server."""
        found = [pod for pod in self._living() if pod.labels.get(names.MONITORED) == workload]
        return [pod for pod in found if pod.labels.get(names.COMPONENT) == component]

    def operators(self) -> list[PodSeen]:
        return list(self._operators)

    def pods(self) -> list[PodSeen]:
        """Return all pods of the namespace."""
        return list(self._pods.values())

    def nodes(self) -> Mapping[str, str]:
        """Return the node of each pod of the campaign."""
        return dict(self._nodes)

    def monitors(self, workload: str) -> list[tuple[float, str]]:
        """Return when a monitor of a workload became ready, and on which node, in order."""
        return sorted(self._monitors[workload].items())

    def unmonitored(self, workload: str) -> list[tuple[float, float]]:
        """Return from when to when no monitor of a workload was seen to run."""
        return list(between(self._ran[workload].values()))

    def evictions(self, workload: str) -> list[float]:
        """Return when Kubernetes evicted a monitor of a workload, in order."""
        return sorted(at for monitored, at in self._evicted.values() if monitored == workload)

    def unled(self) -> list[tuple[float, float]]:
        """Return from when to when no operator led."""
        return unled(self._renewals)

    def unstarted(self, robot: str) -> list[tuple[float, float]]:
        """Return from when to when a pod of a robot or of its pool existed that no kubelet had begun to start, if that was long."""
        return [
            (created, begun)
            for labels, created, begun in self._begun.values()
            if begun - created > STARTS_WITHIN and any(value.startswith(f"{robot}-") for value in labels)
        ]

    def unmuxed(self, robot: str) -> list[tuple[float, float]]:
        """Return from when to when the container of a robot's mux had ended, and a kubelet had not started it again."""
        return sorted(self._unmuxed.get(robot, set()))

    def servers(self, workload: str) -> list[tuple[float, str]]:
        """Return when a discovery server's pod of a workload became ready, and on which node, in order."""
        return sorted(self._servers[workload].items())

    def astray(self, workload: str) -> list[tuple[float, float]]:
        """Return from when to when a workload's Service led to no discovery server although one was ready, if that was long."""
        return [(begin, end) for begin, end in self._astray[workload] if end - begin > LEADS]

    def deleted(self) -> dict[str, float]:
        """Return when each pod was first seen to be deleted."""
        return dict(self._deleted)

    def created(self) -> dict[str, float]:
        """Return when each pod was created."""
        return dict(self._created)

    def _living(self) -> list[PodSeen]:
        return [pod for pod in self._pods.values() if not pod.deleted and pod.node]

    def status(self, workload: str) -> Object:
        return self._status.get(workload, {})

    def commits(self, workload: str) -> list[Commit]:
        return list(self._commits[names.gate(workload)])

    def recoveries(self, workload: str) -> list[Recovered]:
        """Return all recoveries, also those that the status no longer has."""
        return [Recovered.read(record) for record in self.records(workload)]

    def records(self, workload: str) -> list[Object]:
        """Return the same as they stood in the status."""
        return [self._recoveries[key] for key in sorted(self._recoveries) if key[0] == workload]

    def unwell(self) -> list[str]:
        """Return which workloads are not healthy and protected, and why."""
        self._look()
        found = []
        for workload in self._workloads:
            status = self.status(workload)
            false = [
                f"{c['type']}={c['status']} {c.get('reason', '')}"
                for c in status.get("conditions") or []
                if (c["type"], c["status"])
                in (("Protected", "False"), ("SoleDriver", "False"), ("GateEnforced", "False"))
            ]
            if status.get("health") != "Healthy" or false:
                found.append(f"{workload}: {status.get('health')} {', '.join(false)}")
        return found

    def memory(self) -> dict[tuple[str, int], float]:
        """Return the resident memory of our processes in MB, by pod and process."""
        found = {}
        ours = [pod for pod in self._living() if pod.labels.get(names.COMPONENT) == "monitor"]
        agents = [pod for pod in self._living() if names.WORKLOAD in pod.labels]
        for pod, words in [*((p, "") for p in [*ours, *self._operators]), *((p, "agent") for p in agents)]:
            for pid in process_ids(pod.uid, words):
                with contextlib.suppress(OSError, IndexError, ValueError):
                    text = Path(f"/proc/{pid}/status").read_text()
                    if (size := int(text.split("VmRSS:")[1].split()[0]) / 1024) > 15:
                        found[f"{words or pod.name.rsplit('-', 2)[0]}", pid] = size
        return found

    # -- how it knows ----------------------------------------------------------------------------------------------

    def _poll(self) -> None:
        while not self._ended.wait(PERIOD):
            with contextlib.suppress(*UNREACHABLE):
                self._look()

    def _look(self) -> None:
        for item in self._kubectl.list("robotworkloads"):
            name, status = item["metadata"]["name"], item.get("status") or {}
            self._status[name] = status
            for entry in status.get("recoveries") or []:
                self._recoveries[name, int(entry["number"])] = entry
        items = self._kubectl.list("pods")
        self._pods = {item["metadata"]["name"]: _pod(item) for item in items}
        for item in items:
            self._note_pod(item)
        self._nodes |= {pod.name: pod.node for pod in self._pods.values() if pod.node}
        for workload, ran in self._ran.items():
            for pod in self.parts(workload, "monitor"):
                if pod.ready_since:
                    self._monitors[workload][pod.ready_since] = pod.node
                    ran.setdefault((pod.uid, pod.ready_since), (pod.ready_since, pod.ready_since))
                # One that is not ready now, as on a node that is late, may run nevertheless.
                spans = [] if pod.is_down else [span for span in ran if span[0] == pod.uid]
                for span in spans[-1:]:
                    ran[span] = ran[span][0], time.time()
        self._note_servers()
        system = self._kubectl.in_namespace(SYSTEM).list("pods", "app.kubernetes.io/name=understudy")
        self._operators = [_pod(pod) for pod in system]
        if (lease := self._kubectl.in_namespace(SYSTEM).find("lease", LEASE)) is not None:
            self._renewals.add(unix(lease["spec"]["renewTime"]))

    def _note_servers(self) -> None:
        led: dict[str, set[str]] = {}
        for item in self._kubectl.list("endpointslices"):
            service = (item["metadata"].get("labels") or {}).get("kubernetes.io/service-name", "")
            led.setdefault(service, set()).update(a for one in item.get("endpoints") or [] for a in one["addresses"])
        services = {item["metadata"]["name"]: item["spec"].get("selector") for item in self._kubectl.list("services")}
        now = time.time()
        for workload, servers in self._servers.items():
            ready = [pod for pod in self.parts(workload, "discovery") if pod.ready_since]
            servers |= {pod.ready_since: pod.node for pod in ready}
            # A Service that is missing or selects something else is not Kubernetes' fault.
            selector = services.get(names.discovery(workload)) or {"": ""}
            ready = [pod for pod in ready if selector.items() <= pod.labels.items()]
            if not ready or led.get(names.discovery(workload), set()) & {pod.address for pod in ready}:
                self._is_astray.discard(workload)
                continue
            spans = self._astray[workload]
            if workload not in self._is_astray:
                self._is_astray.add(workload)
                spans.append((now, now))
            spans[-1] = spans[-1][0], now

    def _note_pod(self, item: Object) -> None:
        metadata, begun = item["metadata"], (item.get("status") or {}).get("startTime")
        labels = set((metadata.get("labels") or {}).values())
        now = time.time()
        self._begun[metadata["uid"]] = labels, unix(metadata["creationTimestamp"]), unix(begun) if begun else now
        self._created[metadata["name"]] = unix(metadata["creationTimestamp"])
        if metadata.get("deletionTimestamp"):
            self._deleted.setdefault(metadata["name"], now)
        found = metadata.get("labels") or {}
        self._unmuxed.setdefault(found.get("app", ""), set()).update(restarts(item, "mux"))
        if found.get(names.COMPONENT) == "monitor" and kube_objects.evicted(item):
            self._evicted.setdefault(metadata["uid"], (found.get(names.MONITORED, ""), now))

    def _follow_gates(self, version: str, kind: str) -> None:
        cluster, lost = Cluster(self._kubectl.kubeconfig), 0.0
        while not self._ended.is_set():
            known: set[str] = set()
            with contextlib.suppress(*UNREACHABLE):
                for type_, item in cluster.watch(version, kind, self._kubectl.namespace):
                    name = item["metadata"]["name"]
                    if name in self._commits and type_ != "DELETED":
                        # What is there when the watch begins may be as old as the end of the watch before.
                        self._note(name, commit_of(item, time.time(), 0.0 if name in known else lost))
                    known.add(name)
            if known:
                lost = time.time()
            self._ended.wait(0.2)

    def _note(self, gate: str, commit: Commit) -> None:
        commits = self._commits[gate]
        if not commits or (commit.epoch, commit.let_through) != (commits[-1].epoch, commits[-1].let_through):
            commits.append(commit)

    def _follow_logs(self) -> None:
        self._logs(keep=False)
        while not self._ended.wait(LOGS_PERIOD):
            with contextlib.suppress(OSError):
                self._logs(keep=True)

    def _logs(self, *, keep: bool) -> None:
        """Read what the logs have got since the last time. What other namespaces say is not ours."""
        for file in pod_logs():
            pod = file.parent.parent.name
            if not pod.startswith((f"{self._kubectl.namespace}_", f"{SYSTEM}_")):
                continue
            with contextlib.suppress(OSError), file.open(errors="replace") as opened:
                begin = self._read.get(file, 0 if keep else file.stat().st_size)
                if file.stat().st_size < begin:
                    begin = 0  # it was rotated
                opened.seek(begin)
                text = opened.read()
                self._read[file] = opened.tell()
                with (self._folder / f"{pod.split('_')[1]}-{file.parent.name}.log").open("a") as kept:
                    kept.write(text)
                self.tracebacks += tracebacks(text, f"{pod}/{file.parent.name}", time.time())


def between(spans: Iterable[tuple[float, float]]) -> Iterator[tuple[float, float]]:
    """Yield the times that none of the spans covers, without those before the first and after the last one."""
    reached = math.inf
    for begin, end in sorted(spans):
        if begin > reached:
            yield reached, begin
        reached = end if math.isinf(reached) else max(reached, end)


def restarts(pod: Object, container: str) -> Iterator[tuple[float, float]]:
    """Yield when a container of a pod ended, and when it was started again the last time. The seconds are whole."""
    for one in (pod.get("status") or {}).get("containerStatuses") or []:
        ended, begun = (one.get("lastState") or {}).get("terminated"), (one.get("state") or {}).get("running")
        if one["name"] == container and ended and begun:
            yield unix(ended["finishedAt"]), unix(begun["startedAt"])


def tracebacks(text: str, source: str, at: float) -> Iterator[Traceback]:
    """Yield the tracebacks in a container's log, whose lines begin with a time, a stream and a flag."""
    lines = [line.split(" ", 3)[-1] for line in text.splitlines()]
    for number, line in enumerate(lines):
        if "Traceback (most recent call last)" in line:
            found = [line]
            for following in lines[number + 1 : number + FOLLOWING]:
                found.append(following)
                if following and not following.startswith((" ", "\t")):
                    break
            yield Traceback(source, at, "\n".join(found))


def _pod(item: Object) -> PodSeen:
    metadata, status = item["metadata"], item.get("status") or {}
    owners: Any = metadata.get("ownerReferences") or [{}]
    ready = [c for c in status.get("conditions") or [] if c["type"] == "Ready"]
    return PodSeen(
        metadata["name"],
        metadata["uid"],
        item["spec"].get("nodeName", ""),
        metadata.get("labels") or {},
        max((unix(c["lastTransitionTime"]) for c in ready if c["status"] == "True"), default=0.0),
        owners[0].get("name", ""),
        status.get("podIP", ""),
        any(
            one["name"] == "monitor" and "running" not in (one.get("state") or {})
            for one in status.get("containerStatuses") or []
        ),
        unix(metadata["deletionTimestamp"]) if metadata.get("deletionTimestamp") else 0.0,
    )


def unled(renewals: Iterable[float]) -> list[tuple[float, float]]:
    """Return from when to when no operator led, from the times at which the Lease was renewed. One that renewed it once did not lead."""
    found: list[tuple[float, float]] = []
    for a, b in pairwise(sorted(renewals)):
        if b - a <= RENEWED_WITHIN:
            continue
        begin = found.pop()[0] if found and found[-1][1] == a else a
        found.append((begin, b))
    return found


def commit_of(item: Object, seen: float, lost: float) -> Commit:
    """Read the gate's record, which says who is let through whatever somebody made of its selector.

    On a busy machine this process sees a commit late, by seconds. The API server notes the second of a write, and the monitor the moment
    of its request.
    """
    record = item["metadata"].get("annotations") or {}
    among = tuple(name for key in (names.ACTIVE, names.ADMITTED) if (name := record.get(key)))
    epoch = int(record.get(names.EPOCH) or 0)
    written = max(
        (unix(one["time"]) for one in item["metadata"].get("managedFields", []) if "time" in one), default=seen
    )
    since = [lost] if lost else []
    since += [written] if written < seen - LAG - WRITTEN else []
    if (requested := _requested(record.get(names.RECOVERY, ""), among)) is not None:
        since.append(min(seen - LAG, max(written, requested)))
    return Commit(seen, epoch, among, min(since, default=math.nan))


def _requested(recovery: str, among: Sequence[str]) -> float | None:
    """Return when the monitor requested the commit of a recovery that opened the gate for its target; None if it did not."""
    try:
        progress = Progress.of_record(recovery)
    except ValidationError:
        return None
    if progress.target is None or progress.target.name not in among:
        return None
    return progress.moments.get("committing")


def dump(file: Path, **parts: Any) -> None:
    """Write what was recorded, to look at later."""
    file.write_text(json.dumps(parts, indent=1, default=str) + "\n")

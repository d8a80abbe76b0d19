"""What the processes of the operator and of monitors report meanwhile: logs, restarts, and long turns of their event loops."""

from __future__ import annotations

import json
import re
import subprocess
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from bench.fuzz.sending import Api
from bench.scaling.exposition import Reading, read
from tests.e2e.kubectl import Failed, Kubectl, Object
from understudy.kube.client import LEASES

BUSY = "understudy_event_loop_busy_seconds"
_TURN = re.compile(
    r"the event loop was busy for ([0-9.]+) s, of which ([0-9.]+) s were processor time, and ([0-9.]+) s"
)
START_UP = 15.0
"""Seconds after a process' first line in which it imports and reads what exists."""


@dataclass(frozen=True)
class Turn:
    """A long turn of an event loop."""

    process: str
    at: float
    elapsed: float
    processor: float
    collected: float
    """Processor time of garbage collection."""


@dataclass
class Watched:
    """One pod of the operator or of a monitor."""

    kind: str
    pod: str
    namespace: str
    log: Path
    following: subprocess.Popen[bytes]
    first: Reading | None = None
    last: Reading | None = None
    restarts: int = 0


@dataclass
class Found:
    """All that the processes reported."""

    turns: list[Turn] = field(default_factory=list)
    tracebacks: list[str] = field(default_factory=list)
    restarts: int = 0
    busy: dict[str, dict[str, float]] = field(default_factory=dict)
    """By kind of process, the number of turns by their least length and clock, such as ``0.1 processor``."""


class Processes(threading.Thread):
    """Follows the logs of all these pods, also of those that begin meanwhile, and reads their metrics."""

    def __init__(self, api: Api, places: list[tuple[str, Kubectl, str]], folder: Path) -> None:
        """``places`` has a name, a namespace and a selector for each kind of process."""
        super().__init__(daemon=True)
        self._api, self._places, self._folder = api, places, folder
        self._known: dict[str, Watched] = {}
        self._ended = threading.Event()

    def run(self) -> None:
        """Look every few seconds."""
        while not self._ended.wait(4.0):
            self.look()

    def look(self) -> None:
        """Find new pods, and read the metrics of all."""
        for kind, kubectl, selector in self._places:
            try:
                pods = kubectl.list("pods", selector)
            except Failed:
                continue
            for pod in pods:
                self._note(kind, kubectl, pod)

    def _note(self, kind: str, kubectl: Kubectl, pod: Object) -> None:
        name, states = pod["metadata"]["name"], (pod.get("status") or {}).get("containerStatuses") or []
        if not any(state.get("ready") for state in states):
            return
        if name not in self._known:
            log = self._folder / f"{name}.log"
            with log.open("wb") as out:
                following = _follow(kubectl, name, out)
            self._known[name] = Watched(kind, name, kubectl.namespace, log, following)
        watched = self._known[name]
        watched.restarts = sum(state["restartCount"] for state in states)
        status, body = self._api.send("GET", f"/api/v1/namespaces/{kubectl.namespace}/pods/{name}:9108/proxy/metrics")
        if status == 200:
            watched.last = read(body.decode(), (f"{BUSY}_bucket", f"{BUSY}_count", f"{BUSY}_sum"))
            watched.first = watched.first or watched.last

    def stop(self) -> Found:
        """End, and return what was found."""
        self._ended.set()
        self.join(timeout=60)
        self.look()
        time.sleep(1.0)
        found = Found()
        for watched in self._known.values():
            watched.following.terminate()
            found.restarts += watched.restarts
            _read_log(watched, found)
            _count(watched, found)
        return found


def _follow(kubectl: Kubectl, pod: str, out: IO[bytes]) -> subprocess.Popen[bytes]:
    command = kubectl.command("logs", pod, "--all-containers", "--follow", "--tail=-1")
    return subprocess.Popen(command, stdout=out, stderr=subprocess.DEVNULL)


def _read_log(watched: Watched, found: Found) -> None:
    begun: float | None = None
    for line in watched.log.read_text(errors="replace").splitlines():
        try:
            entry = json.loads(line)
        except ValueError:
            if "Traceback" in line:
                found.tracebacks.append(f"{watched.pod}: {line[:300]}")
            continue
        if not isinstance(entry, dict):
            continue
        at = _unix(entry)
        begun = begun or at
        if "traceback" in entry:
            found.tracebacks.append(f"{watched.pod}: {entry.get('message', '')[:200]}: {entry['traceback'][-400:]}")
        turn = _TURN.search(str(entry.get("message", "")))
        if turn and at - (begun or at) > START_UP:
            found.turns.append(Turn(watched.pod, at, *map(float, turn.groups())))


def _unix(entry: dict[str, Any]) -> float:
    from datetime import datetime

    try:
        return datetime.fromisoformat(entry["time"]).timestamp()
    except (KeyError, ValueError):
        return 0.0


def _count(watched: Watched, found: Found) -> None:
    if watched.first is None or watched.last is None:
        return
    grown = watched.last.since(watched.first)
    counts = found.busy.setdefault(watched.kind, {})
    for clock in ("elapsed", "processor"):
        every = grown.total(f"{BUSY}_count", time=clock)
        for bound in ("0.05", "0.1", "0.2", "0.5", "1.0"):
            key = f"{bound} {clock}"
            counts[key] = counts.get(key, 0.0) + every - grown.total(f"{BUSY}_bucket", time=clock, le=bound)


def lease_transitions(api: Api, namespace: str) -> int:
    """Return how often the operator's lease has changed its holder."""
    item = api.get(LEASES.path(namespace, "understudy-operator")) or {}
    return int((item.get("spec") or {}).get("leaseTransitions") or 0)

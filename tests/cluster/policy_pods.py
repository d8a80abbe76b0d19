"""The pods that policies are tested with, and the table of what they may do."""

from __future__ import annotations

import itertools
import json
import re
import subprocess
import threading
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from tests.support.cluster import Cluster, Object, until

REPOSITORY = Path(__file__).resolve().parents[2]
TABLE = REPOSITORY / "testcluster" / "local" / "netpol" / "conformance" / "cases.yaml"
AGENT = Path(__file__).with_name("policy_agent.py")
PORTS = (1, 53, 80, 1000, 7949, 7950, 8000, 8080, 8149, 8150, 8950, 9090, 9108, 11811, 65535)

Flow = tuple[str, str, str, int]  # from, to, protocol, port


def table() -> Object:
    """The table of policies and what they allow and deny, which the enforcer's own tests use too."""
    loaded: Object = yaml.safe_load(TABLE.read_text())
    return loaded


def flows(lines: list[str]) -> list[Flow]:
    """The lines of a table that any cluster can try: those by UDP and TCP."""
    found = []
    for line in lines:
        matched = re.fullmatch(r"(\S+) -> (\S+) (?:icmp|(tcp|udp|sctp)/(\d+))", line)
        assert matched, f"{TABLE.name}: {line!r} is not of the form 'FROM -> TO PROTOCOL/PORT'"
        source, target, protocol, port = matched.groups()
        if protocol in ("tcp", "udp"):
            found.append((source, target, protocol, int(port)))
    return found


def between_pods(lines: list[str]) -> list[Flow]:
    """The lines of a table that any cluster can try and that begin and end at a pod."""
    return [flow for flow in flows(lines) if "outside" not in flow[:2]]


class Agent:
    """policy_agent.py, over the standard streams of what starts it there: `kubectl exec` for a pod."""

    def __init__(self, name: str, start: Sequence[str], ports: Sequence[int] = PORTS) -> None:
        """``start`` is the beginning of the command."""
        self.name = name
        command = [*start, "python3", "-u", "-c", AGENT.read_text(), *map(str, ports)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._waiting: dict[int, Future[Any]] = {0: Future()}
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._reader = threading.Thread(target=self._read, daemon=True)
        ready = self._waiting[0]
        self._reader.start()
        ready.result(timeout=30)

    def call(self, do: str, **arguments: Any) -> Future[Any]:
        """Send a request; its answer comes with the future. Raises RuntimeError through it."""
        answer: Future[Any] = Future()
        assert self._process.stdin
        with self._lock:
            number = next(self._numbers)
            self._waiting[number] = answer
            self._process.stdin.write(json.dumps({"id": number, "do": do, "with": arguments}) + "\n")
            self._process.stdin.flush()
        return answer

    def ask(self, do: str, **arguments: Any) -> Any:
        """Send a request and wait for its answer."""
        return self.call(do, **arguments).result(timeout=20)

    def close(self) -> None:
        """End the agent."""
        assert self._process.stdin
        self._process.stdin.close()
        try:
            self._process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self._process.kill()

    def _read(self) -> None:
        assert self._process.stdout
        for line in self._process.stdout:
            answer = json.loads(line)
            with self._lock:
                waiting = self._waiting.pop(answer["id"])
            if "error" in answer:
                waiting.set_exception(RuntimeError(f"agent in {self.name}: {answer['error']}"))
            else:
                waiting.set_result(answer["result"])
        for waiting in self._waiting.values():
            waiting.set_exception(RuntimeError(f"the agent in {self.name} has ended"))


@dataclass
class World:
    """Pods of the table, each with an agent, in namespaces of their own."""

    cluster: Cluster
    spaces: dict[str, str]  # by the table's name
    image: str
    agents: dict[str, Agent] = field(default_factory=dict)
    pods: dict[str, Object] = field(default_factory=dict)
    nodes: list[str] = field(default_factory=list)
    outside: dict[str, str] = field(default_factory=dict)
    """Addresses of hosts that are no pods, by name. They are targets only."""

    def start(
        self,
        space: str,
        name: str,
        labels: dict[str, str],
        node: int,
        ports: list[Object],
        command: list[str] | None = None,
    ) -> None:
        """Create a pod on the node of that number, as far as there are so many."""
        container = {
            "name": "main",
            "image": self.image,
            "imagePullPolicy": "IfNotPresent",
            "command": command or ["python3", "-c", "import signal; signal.pause()"],
            "ports": [{"name": p["name"], "containerPort": p["port"], "protocol": p["protocol"]} for p in ports],
            "resources": {"requests": {"cpu": "5m", "memory": "20Mi"}},
            "securityContext": {"runAsUser": 0, "runAsNonRoot": False},
        }
        self.pods[name] = self.cluster.create(
            {
                "apiVersion": "v1",
                "kind": "Pod",
                "metadata": {"name": name, "namespace": self.spaces[space], "labels": labels},
                "spec": {
                    "nodeSelector": {"kubernetes.io/hostname": self.nodes[node % len(self.nodes)]},
                    "terminationGracePeriodSeconds": 0,
                    "automountServiceAccountToken": False,
                    "containers": [container],
                },
            }
        )

    def ready(self) -> None:
        """Wait until all pods run, and start their agents."""
        for name, pod in self.pods.items():
            found = until(partial(self._running, name), f"pod {name} with image {self.image} to run", seconds=120)
            assert found
            self.pods[name] = found
            if name not in self.agents and "pause" in pod["spec"]["containers"][0]["command"][-1]:
                command = ["kubectl", "--kubeconfig", str(self.cluster.kubeconfig), "exec", "-i", name]
                self.agents[name] = Agent(name, [*command, "-n", pod["metadata"]["namespace"], "--"])

    def _running(self, name: str) -> Object | None:
        pod = self.cluster.get("v1", "Pod", name, self.pods[name]["metadata"]["namespace"])
        statuses = pod.get("status", {}).get("containerStatuses", [])
        return pod if statuses and all(s["state"].get("running") for s in statuses) else None

    def address(self, name: str) -> str:
        """The address of a pod or a host."""
        address: str = self.outside.get(name) or self.pods[name]["status"]["podIP"]
        return address

    def policies(self, case: Object) -> list[Object]:
        """A case's policies with the names and addresses of this world."""
        text = json.dumps(case["policies"])
        for space, name in self.spaces.items():
            text = text.replace(f"${{{space}}}", name)
        text = re.sub(r"\$\{address:([a-z]+)\}", lambda m: self.address(m[1]), text)
        kind = {"apiVersion": "networking.k8s.io/v1", "kind": "NetworkPolicy"}
        return [{**kind, **item} for item in json.loads(text)]

    def enforce(self, wanted: list[Object]) -> None:
        """Make these, and only these, the policies of the namespaces."""
        kind = {"apiVersion": "networking.k8s.io/v1", "kind": "NetworkPolicy"}
        for space in self.spaces.values():
            # Deleted and created again: a change would keep what the API server has filled in for an earlier one.
            for item in self.cluster.list("networking.k8s.io/v1", "NetworkPolicy", space):
                self.cluster.delete({**kind, "metadata": item["metadata"]})
        for item in wanted:
            self.cluster.create(item)

    def unexpected(self, allowed: list[Flow], denied: list[Flow], address: str | None = None) -> list[str]:
        """Which flows are not as they should be; with an address, all of them go there instead of to the pod's own."""
        asked = [
            (f, want, self._probe(f, address)) for want, list_ in ((True, allowed), (False, denied)) for f in list_
        ]
        wrong = []
        for (source, target, protocol, port), want, answer in asked:
            if answer.result(timeout=20) != want:
                wrong.append(f"{source} -> {target} {protocol}/{port} is {'denied' if want else 'allowed'}")
        return wrong

    def _probe(self, flow: Flow, address: str | None) -> Future[Any]:
        source, target, protocol, port = flow
        return self.agents[source].call("probe", protocol=protocol, address=address or self.address(target), port=port)

    def expect(self, allowed: list[Flow], denied: list[Flow], address: str | None = None) -> None:
        """Wait until all flows are as they should be: how soon a policy is in force is up to the cluster."""
        seen: list[str] = []

        def right() -> bool:
            seen[:] = self.unexpected(allowed, denied, address)
            return not seen

        try:
            until(right, "the policies to be in force", seconds=75)  # Cilium reads changed labels up to 35 s late
        except AssertionError as error:
            raise AssertionError("; ".join(seen)) from error
        # Once more, so that a moment between two states cannot pass for the right one.
        wrong = self.unexpected(allowed, denied, address)
        assert not wrong, "; ".join(wrong)


def policy(world: World, name: str, spec: Object) -> Object:
    """A policy of the namespace of the instances."""
    metadata = {"name": name, "namespace": world.spaces["fleet"]}
    return {"apiVersion": "networking.k8s.io/v1", "kind": "NetworkPolicy", "metadata": metadata, "spec": spec}


def selector(**labels: str) -> Object:
    """A selector of pods by labels."""
    return {"matchLabels": labels}

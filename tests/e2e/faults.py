"""Faults that need no API server: the test that stops it can't ask it to do the rest. For the local provider only."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from testcluster.local import layout as layouts
from testcluster.local import network, processes
from testcluster.local import node as nodes
from tests.e2e.kubectl import Failed, Kubectl, Object, is_ready
from tests.e2e.scenario import eventually

_PROGRAM = Path(__file__).parents[2] / "scripts" / "cluster"


def cluster(*arguments: str) -> str:
    """What scripts/cluster says, of the cluster under test. Raises Failed."""
    done = subprocess.run([str(_PROGRAM), *arguments], capture_output=True, text=True, timeout=240, check=False)
    if done.returncode:
        raise Failed(f"scripts/cluster {' '.join(arguments)}: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout


def local_layout() -> layouts.Layout | None:
    """The layout of the cluster under test. None if it is not the local provider's."""
    return layouts.load(os.environ.get("UNDERSTUDY_CLUSTER_NAME") or layouts.DEFAULT_NAME)


def has_network_modes() -> bool:
    """Whether the cluster under test has the provider's own enforcer of network policies, which can be weakened."""
    layout = local_layout()
    return layout is not None and layout.enforcer == layouts.OWN


def api_server_process() -> int:
    """The process of the API server of the cluster under test. Raises Failed."""
    layout = local_layout()
    pid = processes.find(network.control_plane_group(layout), "kube-apiserver") if layout else None
    if pid is None:
        raise Failed("the API server does not run")
    return pid


def node_processes() -> Iterator[int]:
    """The first process of each node that is on; it has the node's mounts and network."""
    layout = local_layout()
    for number in layout.nodes if layout else ():
        if layout and (pid := nodes.init(layout, number)):
            yield pid


def pod_logs() -> Iterator[Path]:
    """The log files of all containers on the nodes that are on, as this machine sees them."""
    for pid in node_processes():
        yield from Path(f"/proc/{pid}/root/var/log/pods").glob("*/*/*.log")


@contextlib.contextmanager
def stopping(pids: Sequence[int], stopped: float = 0.0, running: float = 0.0) -> Iterator[None]:
    """Stop processes for the duration of the context; if ``stopped`` is given, in cycles of so many seconds."""

    def each(number: signal.Signals) -> None:
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)

    def cycles() -> None:
        while not ended.wait(running):
            each(signal.SIGSTOP)
            ended.wait(stopped)
            each(signal.SIGCONT)

    ended = threading.Event()
    worker = threading.Thread(target=cycles, daemon=True)
    if stopped:
        worker.start()
    else:
        each(signal.SIGSTOP)
    try:
        yield
    finally:
        ended.set()
        if stopped:
            worker.join()
        each(signal.SIGCONT)


class ApiServer:
    """The API server of the cluster under test."""

    def __init__(self, kubectl: Kubectl) -> None:
        self._kubectl = kubectl
        self.stopped = False

    def stop(self) -> None:
        """End it; everything else goes on."""
        self.stopped = True
        cluster("api", "stop")

    def start(self) -> None:
        """Start it, and wait until every node is known to be there."""
        cluster("api", "start")

        def ready() -> bool:
            return all(is_ready(node) for node in self._kubectl.list("nodes"))

        # A kubelet looks for what it missed less and less often, up to once in a minute, where outages follow each other.
        eventually(ready, within=240, what="every node is ready again")
        self.stopped = False


class Network:
    """The networks of the nodes of the cluster under test, which can be given modes (`scripts/cluster network --help`)."""

    def __init__(self) -> None:
        self._weak: set[str] = set()

    def weaken(self, node: str, *modes: str) -> None:
        """Give the network of a node these modes and no others."""
        self._weak.add(node)
        cluster("network", node, *modes)

    def restore(self) -> None:
        """Let all of them work as they should again."""
        for node in sorted(self._weak):
            cluster("network", node)
        self._weak.clear()


def staying(objects: list[Object]) -> list[Object]:
    """The objects with Deployments whose pods stay on a node that isn't ready: after a restart of the API server each node
    may be taken for lost, until it has given a sign of life. The robot isn't what is to fail.
    """
    for item in objects:
        if item["kind"] == "Deployment":
            keys = ("node.kubernetes.io/not-ready", "node.kubernetes.io/unreachable")
            item["spec"]["template"]["spec"]["tolerations"] = [{"key": key, "operator": "Exists"} for key in keys]
    return objects


def signal_processes(pod_uid: str, words: str, number: signal.Signals) -> int:
    """Send a signal to the processes of a pod on this machine whose command line has these words; how many there were."""
    found = 0
    for entry, command in _processes(pod_uid):
        if words in command:
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(entry.name), number)
                found += 1
    return found


def process_ids(pod_uid: str, words: str = "") -> list[int]:
    """The processes of a pod on this machine whose command line has these words. A pause process belongs to each pod."""
    return [int(entry.name) for entry, command in _processes(pod_uid) if words in command]


def process_states(pod_uid: str, words: str) -> dict[int, str]:
    """The processes of a pod on this machine whose command line begins with these words, each with its state (T is stopped)."""
    found = {}
    for entry, command in _processes(pod_uid):
        if command.startswith(words):
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                found[int(entry.name)] = (entry / "stat").read_text().rpartition(")")[2].split()[0]
    return found


def _processes(pod_uid: str) -> Iterator[tuple[Path, str]]:
    """The folders in /proc of a pod's processes on this machine, with their command lines."""
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            if pod_uid not in (entry / "cgroup").read_text():
                continue
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except (FileNotFoundError, ProcessLookupError):
            continue
        yield entry, command


@dataclass(frozen=True)
class Interface:
    """A network interface of a pod besides that of the pod network."""

    pid: int
    """A process of the pod."""
    name: str

    @property
    def received(self) -> int:
        """Packets that it has received."""
        lines = Path(f"/proc/{self.pid}/net/dev").read_text().splitlines()
        return next(int(line.split()[2]) for line in lines if line.split()[0] == f"{self.name}:")


def join(first_uid: str, second_uid: str, name: str = "net1") -> tuple[Interface, Interface]:
    """Give two pods an interface each, joined by a cable. Their processes use it once they are started again."""
    # The first process of a pod is its pause process, which lasts as long as the pod.
    ends = [Interface(min(process_ids(uid)), name) for uid in (first_uid, second_uid)]
    cable = ("ip", "link", "add", name, "netns", str(ends[0].pid), "type", "veth")
    subprocess.run([*cable, "peer", "name", name, "netns", str(ends[1].pid)], check=True)
    for number, end in enumerate(ends, 1):
        _ip(end.pid, "address", "add", f"10.77.0.{number}/24", "dev", name)
        _ip(end.pid, "link", "set", name, "up")
    return ends[0], ends[1]


def detour(pod_uid: str, address: str) -> None:
    """Let nothing that a pod sends to one address arrive any more."""
    _ip(min(process_ids(pod_uid)), "route", "add", "blackhole", f"{address}/32")


def _ip(pid: int, *arguments: str) -> None:
    subprocess.run(["nsenter", f"--net=/proc/{pid}/ns/net", "ip", *arguments], check=True)


class Switch:
    """Lets every new start of an application end at once, while it is on: its command looks for a file of a ConfigMap."""

    _NAME = "switch"
    _SCRIPT = '[ ! -e /switch/crash ] || { echo "told to crash"; exit 1; }; exec "$@"'

    def __init__(self, kubectl: Kubectl) -> None:
        self._kubectl = kubectl
        kubectl.apply([{"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": self._NAME}, "data": {}}])

    def put_into(self, template: Object) -> None:
        """Have the first container of a pod template look for it."""
        spec, container = template["spec"], template["spec"]["containers"][0]
        container["command"] = ["sh", "-c", self._SCRIPT, "sh", *container["command"]]
        container.setdefault("volumeMounts", []).append({"name": self._NAME, "mountPath": "/switch"})
        spec.setdefault("volumes", []).append({"name": self._NAME, "configMap": {"name": self._NAME}})

    def on(self) -> None:
        """What starts from now on in a new pod ends at once."""
        self._kubectl.patch("configmap", self._NAME, {"data": {"crash": "1"}})

    def off(self) -> None:
        """What starts from now on in a new pod lives."""
        self._kubectl.patch("configmap", self._NAME, {"data": {"crash": None}})


class Stage:
    """Nodes that only a robot's instances are on, so that losing one loses nothing else: all but the first.

    The robot, the monitor, the discovery server and the clients are on the first.
    """

    _KEY = "understudy.dev/stage"

    def __init__(self, kubectl: Kubectl) -> None:
        self._kubectl = kubectl
        self.house, *self.nodes = sorted(node["metadata"]["name"] for node in kubectl.list("nodes"))
        self._lost: dict[str, str] = {}
        """What undoes the fault, by node."""
        for node in self.nodes:
            kubectl("taint", "node", node, f"{self._KEY}=instances:NoSchedule", "--overwrite")

    def place(self, objects: list[Object]) -> None:
        """Have the instances among the objects run there."""
        for item in objects:
            if item["kind"] == "RobotWorkload":
                spec = item["spec"]["template"]["spec"]
                spec["tolerations"] = [{"key": self._KEY, "operator": "Exists", "effect": "NoSchedule"}]
                here = {"key": "kubernetes.io/hostname", "operator": "In", "values": self.nodes}
                terms = {"nodeSelectorTerms": [{"matchExpressions": [here]}]}
                spec["affinity"] = {"nodeAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": terms}}

    def node_of(self, pod: str) -> str:
        """Where a pod runs."""
        found: str = self._kubectl.get("pod", pod)["spec"]["nodeName"]
        assert found in self.nodes, f"{pod} is on {found}, not on one of {self.nodes}"
        return found

    def lose(self, node: str, how: str) -> None:
        """``down``: its power is cut. ``stop-runtime``: its kubelet and its container runtime are ended. ``cut``: its cable is
        pulled, and everything on it goes on.
        """
        self._lost[node] = {"down": "up", "stop-runtime": "start-runtime", "cut": "connect"}[how]
        cluster("node", how, node)

    def is_ready(self, node: str) -> bool:
        """Whether Kubernetes counts a node as ready."""
        return is_ready(self._kubectl.get("node", node))

    def restore(self) -> None:
        """Undo the faults, and wait until the nodes are ready."""
        for node, action in list(self._lost.items()):
            cluster("node", action, node)
            eventually(lambda node=node: self.is_ready(node), within=120, what=f"{node} is ready again")  # type: ignore[misc]
            del self._lost[node]

    def clear(self) -> None:
        """Restore everything, and let everybody onto all nodes again."""
        try:
            self.restore()
        finally:
            for node in self.nodes:
                self._kubectl("taint", "node", node, f"{self._KEY}-")

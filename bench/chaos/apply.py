"""Makes faults on the cluster, and undoes them. Only the local provider can do all of this.

Most faults need no API server, since another fault may have stopped that: processes are signalled and networks are disturbed from this
machine. Which pods there are is known from the witness.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager

from bench.chaos.judge import Injected
from bench.chaos.plan import ACTIVE, Fault
from bench.chaos.robots import HOUSE, CampaignRobot
from bench.chaos.witness import PodSeen, Witness
from tests.e2e.faults import api_server_process, cluster, process_ids, signal_processes, stopping
from tests.e2e.kubectl import Failed, Kubectl
from understudy.api import names
from understudy.kube.gates import policy_parts

CYCLE = 0.1
"""Seconds of one cycle of a slowed application."""

API_CYCLE = 1.0
FLAP = (2.5, 1.5)
"""Seconds for which a flapping API server does not answer, and for which it does."""

RATE = "100kbit"
"""What the link of a delayed pod carries: less than what an instance sends, so that its queue is full."""

FLOOD = """
import socket, sys, time
address, rate, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
sender, begun, sent = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), time.monotonic(), 0
while (now := time.monotonic() - begun) < seconds:
    while sent < now * rate:
        try:
            sender.sendto(bytes(1000), (address, 7410 + sent % 20))
        except OSError:
            pass
        sent += 1
    time.sleep(0.005)
"""
"""Sends datagrams that are no messages to the ports of a ROS domain, so many a second, for as long as it should."""

LABELS = (names.POOL, names.WORKLOAD, names.INSTANCE, names.COMPONENT)

LOSS = """
table netdev chaos {{
  chain out {{
    type filter hook egress device eth0 priority 0; policy accept;
    numgen random mod 100 < {percent} drop
  }}
  chain in {{
    type filter hook ingress device eth0 priority 0; policy accept;
    numgen random mod 100 < {percent} drop
  }}
}}
"""


class NotPossible(Exception):
    """The fault could not be made; the message says why."""


class Faults:
    """Makes the faults of a campaign on its robots."""

    def __init__(self, kubectl: Kubectl, robots: Sequence[CampaignRobot], witness: Witness) -> None:
        self._kubectl, self._robots, self._witness = kubectl, robots, witness
        self._made: dict[int, Injected] = {}
        self._threads: list[threading.Thread] = []

    def begin(self, fault: Fault) -> None:
        """Make a fault, which ends by itself after its time."""
        thread = threading.Thread(target=self._make, args=(fault,), daemon=True)
        self._threads.append(thread)
        thread.start()

    def wait(self) -> list[Injected]:
        """Wait until all have ended, and return them."""
        for thread in self._threads:
            thread.join()
        return [self._made[number] for number in sorted(self._made)]

    def _make(self, fault: Fault) -> None:
        kinds: dict[str, Callable[[Fault], AbstractContextManager[str]]] = {
            "kill": self._kill,
            "delete": self._delete,
            "freeze": self._freeze,
            "slow": self._slow,
            "packet-loss": self._loss,
            "packet-delay": self._delay,
            "flood": self._flood,
            "node-power": lambda one: self._node(one, "down", "up"),
            "node-cut": lambda one: self._node(one, "cut", "connect"),
            "monitor-kill": self._monitor_kill,
            "monitor-freeze": self._monitor_freeze,
            "monitor-disk-full": self._disk_full,
            "operator-kill": self._operator_kill,
            "operator-freeze": self._operator_freeze,
            "api-stop": self._api_stop,
            "api-slow": self._api_slow,
            "api-flap": self._api_flap,
            "discovery-kill": self._discovery_kill,
            "mux-kill": self._mux_kill,
            "mux-freeze": self._mux_freeze,
            "gate-delete": self._gate_delete,
            "gate-edit": self._gate_edit,
            "label-remove": self._label_remove,
            "label-exchange": self._label_exchange,
        }
        begun, told, refused, is_unsure = time.time(), "", "", False
        try:
            with kinds[fault.kind](fault) as told:
                print(f"{time.strftime('%H:%M:%S')} {fault}: {told}", flush=True)
                time.sleep(fault.seconds)
        except (NotPossible, Failed, OSError, subprocess.SubprocessError) as error:
            refused = " ".join(str(error).split())[-300:] or repr(error)
            is_unsure = isinstance(error, subprocess.TimeoutExpired)
            print(f"{time.strftime('%H:%M:%S')} {fault}: NOT MADE: {refused}", flush=True)
        self._made[fault.number] = Injected(fault, begun, time.time(), told, refused, is_unsure)

    # -- whom ------------------------------------------------------------------------------------------------------

    def _robot(self, fault: Fault) -> CampaignRobot:
        return self._robots[fault.robot]

    def _victim(self, fault: Fault) -> PodSeen:
        robot = self._robot(fault)
        active = self._witness.active(robot.workload)
        found = self._witness.instances(robot.workload)
        found = [pod for pod in found if (pod.name == active) == (fault.victim == ACTIVE)]
        if not found:
            raise NotPossible(f"{robot.name} has no {fault.victim} instance now")
        return found[int(fault.chance * len(found))]

    def _part(self, fault: Fault, component: str) -> PodSeen:
        robot = self._robot(fault)
        found = self._witness.parts(robot.workload, component)
        if not found:
            raise NotPossible(f"{robot.name} has no {component} now")
        return found[0]

    def _house_pods(self, robot: str) -> list[PodSeen]:
        """Return the pods of a robot on the node that is never lost, where the robot itself is."""
        return [pod for pod in self._witness.pods() if pod.name.startswith(f"{robot}-") and pod.node == HOUSE]

    @staticmethod
    def _processes(pod: PodSeen, words: str = "") -> list[int]:
        if not (found := process_ids(pod.uid, words)):
            raise NotPossible(f"{pod.name} has no such process")
        return found

    # -- instances -------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _kill(self, fault: Fault) -> Iterator[str]:
        pod = self._victim(fault)
        if not signal_processes(pod.uid, self._robot(fault).application, signal.SIGKILL):
            raise NotPossible(f"{pod.name} has no such process")
        yield pod.name

    @contextlib.contextmanager
    def _delete(self, fault: Fault) -> Iterator[str]:
        pod = self._victim(fault)
        options = ["--grace-period=0", "--force"] if fault.chance < 0.5 else []
        self._kubectl("delete", "pod", pod.name, "--wait=false", *options, timeout=20)
        yield f"{pod.name} {'by force' if options else ''}"

    @contextlib.contextmanager
    def _freeze(self, fault: Fault) -> Iterator[str]:
        pod = self._victim(fault)
        with stopping(self._processes(pod, self._robot(fault).application)):
            yield pod.name

    @contextlib.contextmanager
    def _slow(self, fault: Fault) -> Iterator[str]:
        pod, stopped = self._victim(fault), CYCLE * fault.strength / 100
        with stopping(self._processes(pod, self._robot(fault).application), stopped, CYCLE - stopped):
            yield pod.name

    @contextlib.contextmanager
    def _loss(self, fault: Fault) -> Iterator[str]:
        pod = self._victim(fault)
        inside = within(self._processes(pod)[0])
        _run(inside, "nft", "-f", "-", given=LOSS.format(percent=fault.strength))
        try:
            yield pod.name
        finally:
            _run(inside, "nft", "delete", "table", "netdev", "chaos", check=False)

    @contextlib.contextmanager
    def _delay(self, fault: Fault) -> Iterator[str]:
        # A slow link with a long queue: the kernel of a small machine has no netem.
        pod = self._victim(fault)
        inside = within(self._processes(pod)[0])
        queue = ["tbf", "rate", RATE, "burst", "4kb", "latency", f"{fault.strength}ms"]
        _run(inside, "tc", "qdisc", "replace", "dev", "eth0", "root", *queue)
        try:
            yield pod.name
        finally:
            _run(inside, "tc", "qdisc", "del", "dev", "eth0", "root", check=False)

    @contextlib.contextmanager
    def _flood(self, fault: Fault) -> Iterator[str]:
        pod, robot = self._victim(fault), self._robot(fault).name
        address = next((pod.address for pod in self._house_pods(robot)), "")
        if not address:
            raise NotPossible(f"{robot} has no address now")
        arguments = [address, str(fault.strength), str(fault.seconds)]
        inside = within(self._processes(pod)[0])
        with subprocess.Popen([*inside, sys.executable, "-c", FLOOD, *arguments]):
            yield f"{pod.name} -> {address}"

    # -- nodes -----------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _node(self, fault: Fault, how: str, undo: str) -> Iterator[str]:
        robot = self._robot(fault)
        active = self._witness.active(robot.workload)
        found = [pod.node for pod in self._witness.instances(robot.workload) if pod.name == active]
        if not found or found[0] in ("", HOUSE):
            raise NotPossible(f"{robot.name} has no active instance on a node that may be lost")
        cluster("node", how, found[0])
        try:
            yield found[0]
        finally:
            cluster("node", undo, found[0])

    # -- monitor, operator, discovery server -----------------------------------------------------------------------

    @contextlib.contextmanager
    def _monitor_kill(self, fault: Fault) -> Iterator[str]:
        pod = self._part(fault, "monitor")
        if fault.chance < 0.3:
            self._kubectl("delete", "pod", pod.name, "--wait=false", "--grace-period=0", "--force", timeout=20)
            yield f"{pod.name} deleted by force"
            return
        words = "tasks" if fault.chance < 0.5 and self._robot(fault).way.worker else "monitor"
        for pid in self._processes(pod, words):
            os.kill(pid, signal.SIGKILL)
        yield f"{pod.name}, container {words}"

    @contextlib.contextmanager
    def _monitor_freeze(self, fault: Fault) -> Iterator[str]:
        pod = self._part(fault, "monitor")
        with stopping(self._processes(pod, "monitor")):
            yield pod.name

    @contextlib.contextmanager
    def _disk_full(self, fault: Fault) -> Iterator[str]:
        # No byte can be added to any file: each write fails, as on a full disk, and nothing else of the machine is affected.
        pod = self._part(fault, "monitor")
        pids = self._processes(pod, "monitor")
        for pid in pids:
            _run(_as_owner(pid), "prlimit", "--pid", str(pid), "--fsize=0:unlimited")
        try:
            yield pod.name
        finally:
            for pid in pids:
                _run(_as_owner(pid), "prlimit", "--pid", str(pid), "--fsize=unlimited:unlimited", check=False)

    @contextlib.contextmanager
    def _operator_kill(self, fault: Fault) -> Iterator[str]:
        killed = []
        for pod in self._witness.operators():
            for pid in process_ids(pod.uid, "operator"):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                    killed.append(pod.name)
        if not killed:
            raise NotPossible("there is no operator now")
        yield ", ".join(sorted(set(killed)))

    @contextlib.contextmanager
    def _operator_freeze(self, fault: Fault) -> Iterator[str]:
        pids = [pid for pod in self._witness.operators() for pid in process_ids(pod.uid, "operator")]
        if not pids:
            raise NotPossible("there is no operator now")
        with stopping(pids):
            yield f"{len(pids)} processes"

    @contextlib.contextmanager
    def _discovery_kill(self, fault: Fault) -> Iterator[str]:
        pod = self._part(fault, "discovery")
        if fault.chance < 0.5:
            self._kubectl("delete", "pod", pod.name, "--wait=false", "--grace-period=0", "--force", timeout=20)
        else:
            for pid in self._processes(pod, "discovery"):
                os.kill(pid, signal.SIGKILL)
        yield pod.name

    # -- the mux ---------------------------------------------------------------------------------------------------

    def _mux(self, fault: Fault) -> list[int]:
        """Return the processes of a robot's mux: the last one forwards, and the first one keeps it running."""
        robot = self._robot(fault)
        pods = self._house_pods(robot.name) if robot.muxed else []
        pids = [pid for pod in pods for pid in process_ids(pod.uid, "mux")]
        if not pids:
            raise NotPossible(f"{robot.name} has no mux now")
        return sorted(pids)

    @contextlib.contextmanager
    def _mux_kill(self, fault: Fault) -> Iterator[str]:
        os.kill(self._mux(fault)[-1], signal.SIGKILL)
        yield self._robot(fault).name

    @contextlib.contextmanager
    def _mux_freeze(self, fault: Fault) -> Iterator[str]:
        with stopping(self._mux(fault)):
            yield self._robot(fault).name

    # -- API server ------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _api_stop(self, fault: Fault) -> Iterator[str]:
        cluster("api", "stop")
        try:
            yield ""
        finally:
            cluster("api", "start")

    @contextlib.contextmanager
    def _api_slow(self, fault: Fault) -> Iterator[str]:
        stopped = API_CYCLE * fault.strength / 100
        with stopping([api_server_process()], stopped, API_CYCLE - stopped):
            yield ""

    @contextlib.contextmanager
    def _api_flap(self, fault: Fault) -> Iterator[str]:
        with stopping([api_server_process()], *FLAP):
            yield ""

    # -- objects ---------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _gate_delete(self, fault: Fault) -> Iterator[str]:
        robot = self._robot(fault)
        if robot.muxed:
            kind, name = "lease", names.gate(robot.workload)
        else:
            kind = "networkpolicy"
            name = names.gate(robot.workload) if fault.chance < 0.6 else names.standby(robot.workload)
        self._kubectl("delete", kind, name, "--wait=false", timeout=20)
        yield name

    @contextlib.contextmanager
    def _gate_edit(self, fault: Fault) -> Iterator[str]:
        robot = self._robot(fault)
        gate, active = names.gate(robot.workload), self._witness.active(robot.workload)
        others = [pod.name for pod in self._witness.instances(robot.workload) if pod.name != active]
        if robot.muxed:
            holder = others[0] if others and fault.chance < 0.7 else None
            patch = json.dumps({"spec": {"holderIdentity": holder}})
            self._kubectl("patch", "lease", gate, "--type=merge", "-p", patch, timeout=20)
            yield f"names {holder or 'nobody'}"
            return
        if fault.chance < 0.4:
            every = {"key": names.WORKLOAD, "operator": "In", "values": [robot.workload]}
            told, spec = "selects every instance", {"podSelector": {"matchExpressions": [every]}}
        elif fault.chance < 0.7 and others:
            told, spec = f"selects {others[0]}", {"podSelector": {"matchExpressions": [policy_parts.named(others[:1])]}}
        else:
            told, spec = "lets nothing out", {"egress": []}  # type: ignore[dict-item]
        self._kubectl("patch", "networkpolicy", gate, "--type=merge", "-p", json.dumps({"spec": spec}), timeout=20)
        yield told

    @contextlib.contextmanager
    def _label_remove(self, fault: Fault) -> Iterator[str]:
        pod = self._victim(fault)
        labels = [label for label in LABELS if label in pod.labels]
        label = labels[int(fault.chance * 997) % len(labels)]
        self._kubectl("label", "pod", pod.name, f"{label}-", timeout=20)
        yield f"{label} of {pod.name}"

    @contextlib.contextmanager
    def _label_exchange(self, fault: Fault) -> Iterator[str]:
        robot = self._robot(fault)
        active = self._witness.active(robot.workload)
        others = [pod for pod in self._witness.instances(robot.workload) if pod.name != active]
        if not others or not active:
            raise NotPossible(f"{robot.name} has no standby now")
        if fault.chance < 0.6:
            change = f"{names.INSTANCE}={active}"
        else:
            change = f"{names.WORKLOAD}={self._robots[(fault.robot + 1) % len(self._robots)].workload}"
        self._kubectl("label", "--overwrite", "pod", others[0].name, change, timeout=20)
        yield f"{change} of {others[0].name}"


def _as_owner(pid: int) -> list[str]:
    # Limits of others need a capability that root of a container or of a small machine may lack.
    owner = os.stat(f"/proc/{pid}")
    return ["setpriv", f"--reuid={owner.st_uid}", f"--regid={owner.st_gid}", "--clear-groups"]


def within(pid: int) -> list[str]:
    """Return the prefix of a command that runs in the network namespace of a process."""
    return ["nsenter", f"--net=/proc/{pid}/ns/net"]


def _run(inside: Sequence[str], *command: str, given: str | None = None, check: bool = True) -> None:
    done = subprocess.run([*inside, *command], input=given, capture_output=True, text=True, timeout=10, check=False)
    if check and done.returncode:
        raise NotPossible(f"{' '.join(command)}: {done.stderr.strip()}")

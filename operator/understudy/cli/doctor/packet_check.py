"""Checks whether the network handles UDP as the gate needs it, and how fast, with packets between two pods.

The gate consists of the same objects as the operator's (kube/gates), so the result is valid for an instance's gate too.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from understudy.api import names
from understudy.cli.common.cluster_access.kubectl_proxy import Answer
from understudy.cli.common.cluster_access.pod_session import Session
from understudy.cli.common.text.tree_text import rough
from understudy.cli.doctor.clock_check import Clock, of_session
from understudy.cli.doctor.findings import Finding
from understudy.cli.doctor.test_pods import Pods
from understudy.controller.observed import kube_objects
from understudy.kube.client import Object
from understudy.kube.gates.probes import ProbeReceiver
from understudy.kube.gates.registry import DEFAULT as GATE

CHECK = "gate"

OPEN_PORT = names.GATE_RANGE[1] + 1
"""A port that no gate closes."""

WITHIN = 10.0
"""Seconds within which a change of the gate must be enforced."""

SLOW = 1.0
"""Seconds above which a change of the gate is worth a warning, because they are part of every recovery."""

QUIET = 0.5
"""Seconds without a packet after which a path counts as closed. The sender never pauses for longer than a tenth of
it."""

BURST = 25.0
"""Seconds for which the sender sends. Each change starts a new burst, because the pauses grow."""

CHECK_PERIOD = 0.05
"""Seconds between two questions to the receiver."""

_POLICIES = "docs/how-to/network-policies.md"


@dataclass
class GateTest:
    """What the receiver got. Times are seconds since the request to the API server; None if it did not happen."""

    nodes: tuple[str, str]
    before: bool = False
    """Whether packets arrived before there was a gate."""
    established: float | None = None
    """Until the packets of an established flow stopped."""
    fresh: bool = True
    """Whether packets arrived of a flow that began behind the closed gate."""
    others: bool = False
    """Whether the ports that the gate leaves open stayed open."""
    opened: float | None = None
    """Until packets arrived again after the gate was opened for the sender."""
    closed: float | None = None
    """Until packets stopped after the gate was closed again."""
    lifted: float | None = None
    """Until packets arrived again after the gate was deleted."""
    clocks: dict[str, Clock] = field(default_factory=dict)
    """The clocks of the nodes."""


def measure(pods: Pods, progress: Callable[[str], None]) -> GateTest:
    """Send through a gate that closes and opens, and return the result. Raises CommandError."""
    nodes = (pods.sender["spec"]["nodeName"], pods.receiver["spec"]["nodeName"])
    with pods.talking(pods.sender) as sender, pods.talking(pods.receiver) as receiver:
        gate_test = GateTest(nodes)
        progress("reading the clocks of their nodes")
        gate_test.clocks = {nodes[0]: of_session(sender), nodes[1]: of_session(receiver)}
        _Measurement(pods, sender, receiver, gate_test, progress).run()
        return gate_test


def clocks(pods: Pods, progress: Callable[[str], None]) -> dict[str, Clock]:
    """Return the clocks of the pods' nodes without sending packets. Raises CommandError."""
    progress("reading the clocks of their nodes")
    found: dict[str, Clock] = {}
    for pod in (pods.sender, pods.receiver):
        with pods.talking(pod) as talk:
            found[pod["spec"]["nodeName"]] = of_session(talk)
    return found


class _Measurement:
    def __init__(
        self, pods: Pods, sender: Session, receiver: Session, gate_test: GateTest, progress: Callable[[str], None]
    ) -> None:
        self._pods, self._sender, self._receiver, self._gate_test, self._progress = (
            pods,
            sender,
            receiver,
            gate_test,
            progress,
        )
        self._host = pods.receiver["status"]["podIP"]
        self._uid = kube_objects.uid(pods.sender)
        self._clock = gate_test.clocks[gate_test.nodes[1]]

    def run(self) -> None:
        """Run the steps. Each needs the one before, so the first that fails ends the measurement."""
        gate_test = self._gate_test
        for port in (names.PROBE_PORT, OPEN_PORT):
            self._receiver.ask("listen", port=port, host="::" if ":" in self._host else "0.0.0.0")
        self._progress("sending packets without a gate")
        sent = self._send(OPEN_PORT), self._send(names.PROBE_PORT, self._uid)
        gate_test.before = all(
            self._begins(0.0, port, uid) is not None
            for port, uid in zip((OPEN_PORT, names.PROBE_PORT), sent, strict=True)
        )
        if not gate_test.before:
            return
        self._progress("sending packets to a closed gate")
        gate_test.established = self._ends(self._asking(self._pods.fence))
        gate_test.fresh = (
            self._begins(0.0, names.PROBE_PORT, self._send(names.PROBE_PORT), within=2 * QUIET) is not None
        )
        gate_test.others = self._begins(0.0, OPEN_PORT, self._send(OPEN_PORT), within=5 * QUIET) is not None
        if gate_test.fresh:
            return
        self._progress("opening the gate")
        gate_test.opened = self._begins(self._asking(self._pods.open_gate), names.PROBE_PORT, self._uid)
        self._progress("closing it again")
        gate_test.closed = self._ends(self._asking(self._pods.close_gate))
        self._progress("deleting the test policies")
        gate_test.lifted = self._begins(self._asking(self._pods.lift), names.PROBE_PORT, self._uid)

    def _asking(self, write: Callable[[], Answer]) -> float:
        """Change the gate while packets are being sent, and return the time of the request."""
        self._send(names.PROBE_PORT, self._uid)
        return write().asked

    def _send(self, port: int, uid: str = "") -> str:
        """Start to send packets for BURST seconds, and return the UID in them. A new UID sends from a port that the
        network has not seen."""
        uid = uid or str(uuid.uuid4())
        self._sender.ask("send", uid=uid, host=self._host, port=port, seconds=BURST)
        return uid

    def _begins(self, since: float, port: int, uid: str, within: float = WITHIN) -> float | None:
        """Return how many seconds after a time the first packet arrived; None if none did."""
        for arrivals in self._poll(since, uid, port, within):
            if arrivals["first"] is not None:
                return max(0.0, self._ours(arrivals["first"]) - since)
        return None

    def _ends(self, since: float) -> float | None:
        """Return how many seconds after a time the last packet arrived; None if packets went on arriving."""
        for arrivals in self._poll(since, self._uid, names.PROBE_PORT, WITHIN):
            last = arrivals["last"]
            if last is not None and arrivals["now"] - last > QUIET and self._ours(arrivals["now"]) - since > QUIET:
                return max(0.0, self._ours(last) - since)
        return None

    def _poll(self, since: float, uid: str, port: int, within: float) -> Iterator[dict[str, Any]]:
        end = time.monotonic() + within
        while time.monotonic() < end:
            yield self._receiver.ask("heard", uid=uid, port=port, since=since + self._clock.ahead)
            time.sleep(CHECK_PERIOD)

    def _ours(self, moment: float) -> float:
        """Convert a time of the receiver's clock to this machine's clock."""
        return moment - self._clock.ahead


def judge(gate_test: GateTest) -> list[Finding]:
    """Turn the measurement into findings for a person."""
    where = (
        f"from {gate_test.nodes[0]} to {gate_test.nodes[1]}"
        if len(set(gate_test.nodes)) == 2
        else f"on {gate_test.nodes[0]} only"
    )
    if not gate_test.before:
        return [
            Finding(
                CHECK,
                "FAIL",
                f"UDP packets do not get from one pod to another at all ({where})",
                f"look for a {GATE.object_kind} that denies UDP to all pods of this namespace (kubectl get {GATE.resource.plural}), "
                "and allow UDP between them: robots and their applications need it. If there is none, the network between these nodes "
                "carries no UDP",
            )
        ]
    if gate_test.fresh:
        return [
            Finding(
                CHECK,
                "FAIL",
                f"gates are not enforced for UDP ({where}): packets to a gated port got through a closed gate",
                f"two instances could drive a robot. {ProbeReceiver.leak_hint} See {_POLICIES}",
            )
        ]
    return [*_ways(gate_test), *_times(gate_test, where)]


def _ways(gate_test: GateTest) -> Iterator[Finding]:
    if not gate_test.others:
        yield Finding(
            CHECK,
            "FAIL",
            "a closed gate also stops UDP to other ports: the network plugin does not support ranges of ports (endPort), or peers by "
            "namespaceSelector",
            f"a standby would neither receive nor discover anything. Use a network plugin that supports them: {_POLICIES}",
        )
    if gate_test.established is None:
        yield Finding(
            CHECK,
            "WARN",
            f"an established flow still gets through {rough(WITHIN)} after the gate was closed; new flows do not",
            "the network keeps established flows open, so a failed pod can command the robot until the pod is deleted, which "
            f"Understudy does right after the switch: {_POLICIES}",
        )


def _times(gate_test: GateTest, where: str) -> Iterator[Finding]:
    for word, took in (("opened for a pod", gate_test.opened), ("taken away", gate_test.lifted)):
        if took is None:
            yield Finding(
                CHECK,
                "FAIL",
                f"packets did not come through within {rough(WITHIN)} after the gate was {word}",
                (
                    "the outputs of a new instance would never reach the robot: see the logs of the network plugin "
                    f"on {gate_test.nodes[0]} and {gate_test.nodes[1]}"
                ),
            )
    if gate_test.established is not None and gate_test.closed is None:
        yield Finding(
            CHECK,
            "WARN",
            f"packets still came {rough(WITHIN)} after an open gate was closed",
            f"the network keeps established flows open, so a failed pod can command the robot until the pod is deleted: {_POLICIES}",
        )
    moments = {
        "closed": gate_test.established,
        "opened": gate_test.opened,
        "closed again": gate_test.closed,
        "lifted": gate_test.lifted,
    }
    known = {word: took for word, took in moments.items() if took is not None}
    if not known:
        return
    slow = max(known.values()) > SLOW
    words = ", ".join(f"{word} {rough(took)}" for word, took in known.items())
    yield Finding(
        CHECK,
        "WARN" if slow else "OK",
        f"gates are enforced for UDP ({where}); time after the request to the API server: {words}",
        f"they are a part of every recovery. Give the network plugin's agents more CPU, or use another one: {_POLICIES}"
        if slow
        else "",
    )


def to_wire(gate_test: GateTest) -> Object:
    """Return the measurement for scripts, in seconds."""
    times = {
        "closed": gate_test.established,
        "opened": gate_test.opened,
        "closedAgain": gate_test.closed,
        "lifted": gate_test.lifted,
    }
    return {
        "nodes": list(gate_test.nodes),
        "seconds": {key: round(took, 4) if took is not None else None for key, took in times.items()},
    }

"""What a flood goes to: the ports at which the pods of a robot receive."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from bench.flood.flooder import Plan
from bench.flood.series import address
from tests.e2e.kubectl import Object
from tests.e2e.scenario import Robot
from understudy.api import names

DDS = "dds"
"""The ports of participants in monitor and instances."""

PARTS = ("agents", "probes", "pages", DDS, "discovery")
"""What can be flooded of Understudy."""

ROBOT = "robot"
"""The robot's own ports."""

EPHEMERAL = 32768
"""From here on, a port of a socket is that of a sender."""


class Targets:
    """The ports at which the pods of a robot receive."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._ports: dict[str, list[int]] = {}
        """UDP ports of pods by what they are: all instances have the same."""

    def plan(self, parts: Sequence[str], processes: int) -> Plan:
        """Return a plan that floods parts of all pods that exist now."""
        instances = [pod for pod in self._robot.pods() if address(pod)]
        monitors = [pod for pod in self._robot.monitor_pods() if address(pod)]
        found = Plan(processes=processes)
        if "agents" in parts:
            for pod in instances:
                manners = ("syn", "silent", "garbage", "slow")
                found.tcp += [(address(pod), names.AGENT_PORT, manner) for manner in manners]
        if "probes" in parts:
            uids = [pod["metadata"]["uid"] for pod in instances]
            for pod in monitors:
                kinds = ["random", "probe", *(f"unsigned:{uid}" for uid in uids)]
                found.udp += [(address(pod), names.PROBE_PORT, kind) for kind in kinds]
                found.tcp += [(address(pod), names.PROBE_PORT, "syn")]
        if "pages" in parts:
            pages = [(address(pod), names.METRICS_PORT) for pod in monitors]
            pages += [(address(pod), names.AGENT_HEALTH_PORT) for pod in instances]
            found.tcp += [(*page, manner) for page in pages for manner in ("syn", "silent", "garbage", "slow", "pages")]
        if DDS in parts:
            found.udp += self._graph(monitors, "monitor", "monitor") + self._graph(instances, "instance", "drive")
        if "discovery" in parts:
            selector = f"{names.COMPONENT}=discovery,{names.MONITORED}={self._robot.workload}"
            for pod in self._robot.kubectl.list("pods", selector):
                for port in (names.DISCOVERY_PORT, names.DISCOVERY_ASKED_PORT):
                    found.udp += [(address(pod), port, kind) for kind in ("random", "rtps")]
        if ROBOT in parts:
            pods = self._robot.kubectl.list("pods", f"app={self._robot.name}")
            found.udp += self._graph(pods, "robot", "robot")
        return found

    def _graph(self, pods: Iterable[Object], what: str, container: str) -> list[tuple[str, int, str]]:
        """Return the ports at which the DDS participants of pods receive."""
        found = []
        for pod in pods:
            if what not in self._ports:
                text = self._robot.kubectl.shell(pod["metadata"]["name"], container, "cat /proc/net/udp")
                self._ports[what] = [port for port in receiving(text) if port != names.PROBE_PORT]
            found += [(address(pod), port, "rtps") for port in self._ports[what]]
        return found


def receiving(text: str) -> list[int]:
    """Return the ports in /proc/net/udp at which somebody receives."""
    ports = {int(line.split()[1].rpartition(":")[2], 16) for line in text.splitlines()[1:] if line.strip()}
    return sorted(port for port in ports if port < EPHEMERAL)


def udp_counters(text: str) -> dict[str, int]:
    """Return the counters of UDP in /proc/net/snmp."""
    head, values = (line.split()[1:] for line in text.splitlines() if line.startswith("Udp:"))
    return dict(zip(head, map(int, values), strict=True))

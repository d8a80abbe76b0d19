"""Judges whether the robot reads the outputs at ports that the gate controls, from the readers and their ports."""

from __future__ import annotations

import ipaddress
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from understudy.api import names
from understudy.monitor.notices import ConditionReport
from understudy.ros.middleware import Locator

TOOLS = ("_", "rosbag2_recorder", "understudy_watch_", "understudy_init_")
"""Prefixes of the names of nodes that only observe: hidden nodes such as those of the ROS command line, rosbag2, and our own commands."""


UNGATED = "ReaderWithoutProfile"
"""Reason if a reader of the robot listens at a port that no gate controls."""


@dataclass(frozen=True)
class Reading:
    """A subscription of an output that belongs neither to the monitor nor to an instance."""

    topic: str
    node: str
    """Fully qualified name; empty if unknown."""
    places: tuple[Locator, ...]
    """The addresses and ports at which it listens."""

    @property
    def gated(self) -> bool:
        """Whether it listens only at ports that the gate controls."""
        first, last = names.GATE_RANGE
        return all(first <= place.port <= last for place in self.places)

    @property
    def is_tool(self) -> bool:
        """Whether it only observes, according to its node's name."""
        return self.node.rpartition("/")[2].startswith(TOOLS)

    def __str__(self) -> str:
        places = ", ".join(f"{place.address}:{place.port}" for place in self.places)
        return f"{self.topic} by {self.node or 'an unnamed node'} at {places}"


def judge(
    workload: str,
    topics: Sequence[str],
    readings: Sequence[Reading],
    unreported: Collection[str],
    robots: Sequence[str],
) -> ConditionReport:
    """Return status, reason and message of the condition OutputsRead.

    ``unreported`` are the topics with readers whose locators DDS has not reported; ``robots`` are the addresses of robots outside
    the cluster, as CIDRs.

    A reader outside the gate counts as the robot, unless it is a tool, or the robot also reads that output at a gated port. In that
    case the reader may be a recorder or a display, and is reported without an alarm.
    """
    ungated: list[Reading] = []
    harmless: list[Reading] = []
    unread: list[str] = []
    for topic in topics:
        here = [one for one in readings if one.topic == topic]
        gated = [one for one in here if one.gated]
        harmful = [one for one in here if not (one.gated or one.is_tool or _is_read(gated, one, robots))]
        ungated += harmful
        harmless += [one for one in here if not one.gated and one not in harmful]
        if not gated and not harmful and topic not in unreported:
            unread.append(topic)
    past = [_past(harmless)] if harmless else []
    if ungated:
        return "False", UNGATED, " ".join([_without_profile(workload, ungated), *past])
    if unread:
        return "Unknown", "NobodyReads", " ".join([_unread(unread), *past])
    if unreported:
        listed = ", ".join(topic for topic in topics if topic in unreported)
        return (
            "Unknown",
            "ReadersUnknown",
            " ".join([f"DDS discovery did not report the ports of all subscriptions of {listed}.", *past]),
        )
    if past:
        return "True", "ReadPastTheGate", past[0]
    return "True", "AtGatedPorts", f"The robot reads at ports that the gate controls: {'; '.join(map(str, readings))}."


def _is_read(gated: Sequence[Reading], besides: Reading, robots: Sequence[str]) -> bool:
    """Return whether the robot also reads the output at a gated port. A robot outside the cluster must do so on the same host."""
    hosts = {place.address for place in besides.places}
    if any(_within(host, robots) for host in hosts):
        return any(place.address in hosts for one in gated for place in one.places)
    return bool(gated)


def _within(address: str, ranges: Sequence[str]) -> bool:
    return any(ipaddress.ip_address(address) in ipaddress.ip_network(one, strict=False) for one in ranges)


def _without_profile(workload: str, readings: Sequence[Reading]) -> str:
    return (
        f"These subscriptions are not behind the gate: {'; '.join(map(str, readings))}. They receive the messages of every instance, not "
        "only of the active pod. Start their processes with the robot's DDS profile: see understudy robot-profile "
        f"{workload}, and for a pod docs/how-to/own-application.md."
    )


def _unread(topics: Sequence[str]) -> str:
    return (
        f"No process of the robot reads {', '.join(topics)}. Check that its driver runs in this robot's ROS graph "
        "and uses this topic name. If it is in another namespace, name its pods in spec.gate.peers; if it is outside the cluster or on "
        "its node's network, name its address in spec.gate.robots."
    )


def _past(readings: Sequence[Reading]) -> str:
    return (
        f"These subscriptions are not behind the gate: {'; '.join(map(str, readings))}. They also receive messages of standbys. That is "
        "right for recorders and displays, but not for a node that moves the robot."
    )

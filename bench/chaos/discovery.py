"""What is kept about discovery for who looks into a robot that is not well at the end of a campaign.

A participant that discovers nothing reports nothing, so its packets and the translations of the Service are written down:

    discovery.txt     the namespace's pods, its EndpointSlices, and the connections to discovery servers that each node tracks
    NAME.pcap         the packets of discovery of a pod, for some seconds
"""

from __future__ import annotations

import contextlib
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from bench.chaos.apply import within
from bench.chaos.witness import PodSeen
from tests.e2e.faults import node_processes, process_ids
from tests.e2e.kubectl import Kubectl
from understudy.api import names

SECONDS = 15.0
"""How long packets are captured: five announcements of each participant (Fast DDS repeats them every 3 s)."""

STARTS_WITHIN = 30.0
"""Seconds that the start of a capture may take on a busy machine."""

SERVER = b"DS\0_EPROSIMA"
"""The GUID prefix of a discovery server."""

_IPV4, _UDP = 0x0800, 17
_PCAP = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)


def keep(kubectl: Kubectl, pods: Sequence[PodSeen], folder: Path) -> None:
    """Write down how discovery is, with the packets of some pods. Takes SECONDS."""
    report = [kubectl("get", "pods", "-o", "wide"), kubectl("get", "endpointslices", "-o", "yaml")]
    for node in node_processes():
        tracked = subprocess.run(
            [*within(node), "conntrack", "-L", "-p", "udp"], capture_output=True, text=True, check=False
        )
        lines = [line for line in tracked.stdout.splitlines() if f"dport={names.DISCOVERY_PORT}" in line]
        report.append("\n".join([f"node of process {node}:", *lines]))
    (folder / "discovery.txt").write_text("\n\n".join(report))
    captures = []
    for pod in pods:
        for pid in process_ids(pod.uid)[:1]:
            command = [*within(pid), sys.executable, __file__, str(folder / f"{pod.name}.pcap")]
            captures.append(subprocess.Popen(command))
    for capture in captures:
        try:
            capture.wait(SECONDS + STARTS_WITHIN)
        except subprocess.TimeoutExpired:  # the campaign is judged without these packets
            capture.kill()
            capture.wait()


def _capture(file: Path) -> None:
    """Write this network namespace's packets of discovery to a file."""
    end = time.monotonic() + SECONDS
    with file.open("wb") as out, socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0x0003)) as wire:
        out.write(_PCAP)
        wire.settimeout(0.5)
        while time.monotonic() < end:
            with contextlib.suppress(TimeoutError):
                frame = wire.recv(65535)
                if _is_of_discovery(frame):
                    now = time.time()
                    out.write(struct.pack("<IIII", int(now), int(now % 1 * 1e6), len(frame), len(frame)) + frame)


def _is_of_discovery(frame: bytes) -> bool:
    """Whether a frame goes to a discovery server, or comes from one."""
    if len(frame) < 42 or struct.unpack_from(">H", frame, 12)[0] != _IPV4 or frame[23] != _UDP:
        return False
    start = 14 + (frame[14] & 15) * 4
    source, port = struct.unpack_from(">HH", frame, start)
    return names.DISCOVERY_PORT in (source, port) or SERVER in frame


if __name__ == "__main__":
    _capture(Path(sys.argv[1]))

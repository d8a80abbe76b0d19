"""A small network of namespaces: a switch in the middle, hosts with one address each, none of it in this machine's own.

A participant's host id comes from its addresses, so the machine's own interfaces are left alone: other nodes that run
here would get another id.
"""

from __future__ import annotations

import contextlib
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from understudy.api import names


class Network:
    """Hosts that reach each other over one switch."""

    def __init__(self) -> None:
        self._holders: list[subprocess.Popen[bytes]] = []
        self._ports: dict[str, str] = {}
        """By address, the host's port at the switch."""
        self._switch = self._namespace()
        self._inside(self._switch, "ip", "link", "add", "br0", "type", "bridge")
        self._inside(self._switch, "ip", "link", "set", "br0", "type", "bridge", "mcast_snooping", "0")
        self._inside(self._switch, "ip", "link", "set", "br0", "up")

    def host(self, ip: str) -> list[str]:
        """A host with this address (/16); the command to put before what is to run on it."""
        host = self._namespace()
        port = f"p{len(self._holders)}"
        self._inside(
            host, "ip", "link", "add", "eth0", "type", "veth", "peer", "name", port, "netns", str(self._switch)
        )
        self._inside(host, "ip", "link", "set", "lo", "up")
        self._inside(host, "ip", "addr", "add", f"{ip}/16", "dev", "eth0")
        self._inside(host, "ip", "link", "set", "eth0", "up")
        self._inside(self._switch, "ip", "link", "set", port, "master", "br0", "up")
        self._ports[ip] = port
        return ["nsenter", f"--net=/proc/{host}/ns/net"]

    def cut_off(self, ip: str) -> None:
        """Drop everything to and from the host with this address: nobody is sent a reset."""
        self._inside(self._switch, "ip", "link", "set", self._ports[ip], "down")

    def close(self) -> None:
        """End it; the namespaces go with their last process."""
        for holder in self._holders:
            holder.kill()
            holder.wait()

    def _namespace(self) -> int:
        own = Path("/proc/self/ns/net").readlink()
        holder = subprocess.Popen(["unshare", "--net", "sleep", "300"])
        self._holders.append(holder)
        end = time.monotonic() + 10
        while Path(f"/proc/{holder.pid}/ns/net").readlink() == own:
            assert time.monotonic() < end, "unshare made no network namespace"
            time.sleep(0.005)
        return holder.pid

    @staticmethod
    def _inside(pid: int, *command: str) -> None:
        subprocess.run(["nsenter", f"--net=/proc/{pid}/ns/net", *command], check=True)


def fence(host: list[str], closed: bool) -> None:
    """What the gate does: nothing leaves this host for the gated ports."""
    first, last = names.GATE_RANGE
    rule = ["pref", "10", "ipproto", "udp", "dport", f"{first}-{last}", "blackhole"]
    subprocess.run([*host, "ip", "rule", "add" if closed else "del", *rule], check=True)


@contextlib.contextmanager
def network() -> Iterator[Network]:
    """A network for the length of a test."""
    made = Network()
    try:
        yield made
    finally:
        made.close()

"""Machines outside of the cluster, such as a robot: no kubelet, no pods, no policies.

Each has a network namespace, with an address on the network of the nodes and routes to the pods through their nodes. Pods reach it
through their node. Nobody translates addresses in between.
"""

from collections.abc import Sequence
from pathlib import Path

from testcluster.local import cgroups, network, processes
from testcluster.local.layout import Layout
from testcluster.shell import run


class Machine:
    """One of them, known by its number."""

    def __init__(self, layout: Layout, number: int) -> None:
        self._layout, self._number = layout, number
        self._group = f"{layout.cgroup}/machine{number}"
        self._holder = 0
        self.address = layout.machine_ip(number)

    def up(self) -> None:
        """Switch it on. It replaces the one that an interrupted run has left with this number."""
        self.down()
        cgroups.create(self._group)
        cgroups.weigh(self._group, network.WEIGHT)
        log = self._layout.log / f"machine{self._number}.log"
        self._holder = processes.start(self._group, ["unshare", "--net", *network.HOLDER], log)
        network.attach_machine(self._layout, self._number, self._holder)

    def down(self) -> None:
        """End all that runs on it, and its network."""
        network.detach_machine(self._layout, self._number)
        cgroups.kill(self._group)
        cgroups.remove(self._group)

    def start(self, command: Sequence[str | Path], log: Path) -> int:
        """Start a program on it, append its output to a file, and return its process id."""
        return processes.start(self._group, [*network.inside(self._holder), *command], log)

    def run(self, *command: str | Path, input: str | None = None) -> str:
        """Run a program on it, and return its standard output. Raises CommandFailed."""
        return run(*network.inside(self._holder), *command, input=input)

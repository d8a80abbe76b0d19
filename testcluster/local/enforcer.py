"""What gives the pods of a node their network and enforces network policies there: this provider's own program, or Cilium."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from testcluster import atomic
from testcluster.local.layout import Layout

Kubectl = Callable[..., str]
"""Runs kubectl as the cluster's administrator: takes its arguments, and ``input`` as a keyword."""


def etc(layout: Layout, node: int) -> Path:
    """Return the folder with the configuration of a node."""
    return layout.node_state(node) / "etc"


class Enforcer(ABC):
    """One way to enforce network policies, as it was built."""

    name: ClassVar[str]
    users: ClassVar[Mapping[str, str]]
    """Subjects of the certificates of its programs; the keys are the names of their kubeconfigs."""

    def __init__(self, program: Path) -> None:
        """``program`` is the program of a node, or the folder that contains it."""
        self.program = program

    @property
    @abstractmethod
    def plugins(self) -> str:
        """The folder of a node with its CNI plugins."""

    @abstractmethod
    def configure(self, layout: Layout, node: int) -> None:
        """Write its configuration for a node that is off."""

    @abstractmethod
    def command(self, layout: Layout, node: int) -> Sequence[str | Path]:
        """Return the command of its program on a node."""

    @abstractmethod
    def words(self, layout: Layout, node: int) -> Sequence[str]:
        """Return words of the command line that no other process of the node has."""

    @property
    def prepare(self) -> Path | None:
        """A shell script that makes the mounts that it needs on a node, if any. It may use the variables of node-init.sh."""
        return None

    def control_plane(self, layout: Layout) -> Mapping[str, Sequence[str | Path]]:
        """Return the commands of its programs beside the control plane, by their names."""
        return {}

    @abstractmethod
    def complete(self, layout: Layout, kubectl: Kubectl) -> None:
        """Write the objects of the cluster that it needs. The API server runs, and the nodes start."""

    def link(self, layout: Layout, node: int) -> Path:
        """Return the link to the program. It is replaced when that is built again, so that a running node gets the new build."""
        return etc(layout, node) / f"{self.name}-program"

    def exchange(self, layout: Layout, node: int) -> bool:
        """Give a node the present program, and return whether it had another one."""
        link = self.link(layout, node)
        if link.is_symlink() and link.readlink() == self.program:
            return False
        atomic.link(link, self.program)
        return True

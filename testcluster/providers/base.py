"""The interface of a provider of clusters."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from testcluster.modes import NetworkModes


class ClusterError(RuntimeError):
    """The cluster, or this machine, does not allow the operation; the message says what would help."""


class NotSupported(ClusterError):
    """This provider does not have that operation at all."""


@dataclass(frozen=True)
class Status:
    """The state of a cluster.

    Attributes:
        ready: whether everything in it can be used.
        summary: one line for people.
        details: further lines.
    """

    ready: bool
    summary: str
    details: Sequence[str] = field(default_factory=tuple)


class Provider(ABC):
    """A way to have a cluster. Every operation may be repeated, and may follow one that was interrupted."""

    name: str
    # The builder whose images this provider accepts; None for any.
    engine: str | None = None

    @abstractmethod
    def up(self) -> None:
        """Make the cluster, or what is missing of it, and wait until it can be used."""

    @abstractmethod
    def down(self) -> None:
        """Remove everything that `up` made, and nothing else."""

    @abstractmethod
    def status(self) -> Status:
        """Return the present state of the cluster."""

    @abstractmethod
    def load_images(self, images: Sequence[str]) -> None:
        """Bring images to every node that lacks them.

        Args:
            images: for each, the path of an archive in the format of `docker save`, or the name of an image that was
            built here.
        """

    @abstractmethod
    def kubeconfig(self) -> Path:
        """Return the path of a kubeconfig with an administrator's rights.

        Raises:
            ClusterError: there is no cluster.
        """

    def _not_supported(self, operation: str) -> NotSupported:
        return NotSupported(f"provider {self.name} cannot {operation}; provider local can")

    def nodes(self) -> Sequence[str]:
        """Return the names of nodes that can have the faults below."""
        raise self._not_supported("cause faults of nodes")

    def node_down(self, node: str) -> None:
        """Cut a node's power: everything on it ends at once."""
        raise self._not_supported("cut a node's power")

    def node_up(self, node: str) -> None:
        """Switch a node on again; it becomes Ready later. This also ends a freeze and a disconnection."""
        raise self._not_supported("switch a node on")

    def node_freeze(self, node: str, frozen: bool) -> None:
        """Freeze every process of a node, or let them continue."""
        raise self._not_supported("freeze a node")

    def node_runtime(self, node: str, running: bool) -> None:
        """Stop a node's kubelet and container runtime, or start them again. Its containers continue meanwhile."""
        raise self._not_supported("stop a node's kubelet and container runtime")

    def node_network(self, node: str, modes: NetworkModes) -> None:
        """Give a node's network these modes and no others. They are in force when this returns."""
        raise self._not_supported("weaken a node's network")

    def api_stop(self) -> None:
        """End the API server at once; everything else continues without it."""
        raise self._not_supported("stop the API server")

    def api_start(self) -> None:
        """Start the API server again, and wait until it answers."""
        raise self._not_supported("start the API server")

    def node_link(self, node: str, connected: bool) -> None:
        """Disconnect a node from the network, or connect it again. Its pods continue."""
        raise self._not_supported("cut a node off")

"""What a provider of clusters can do."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path


class ClusterError(RuntimeError):
    """The cluster, or this machine, does not allow what was asked; the message says what would."""


class NotSupported(ClusterError):
    """This provider cannot do that at all."""


@dataclass(frozen=True)
class Status:
    """How a cluster is.

    Attributes:
        ready: it can be used in full.
        summary: one line for people.
        details: further lines.
    """

    ready: bool
    summary: str
    details: Sequence[str] = field(default_factory=tuple)


class Provider(ABC):
    """A way to have a cluster. Every operation may be repeated, and may follow one that was interrupted."""

    name: str
    # The builder whose images this provider can take, or None when any will do.
    engine: str | None = None

    @abstractmethod
    def up(self) -> None:
        """Makes the cluster, or what is missing of it, and returns when it can be used."""

    @abstractmethod
    def down(self) -> None:
        """Removes all that `up` made, and nothing else."""

    @abstractmethod
    def status(self) -> Status:
        """How the cluster is, now."""

    @abstractmethod
    def load_images(self, images: Sequence[str]) -> None:
        """Brings images to every node, as far as they are not there.

        Args:
            images: for each, the path of an archive in the format of `docker save`, or the name of an image that was
            built here.
        """

    @abstractmethod
    def kubeconfig(self) -> Path:
        """The path of a kubeconfig with an administrator's rights.

        Raises:
            ClusterError: there is no cluster.
        """

    def nodes(self) -> Sequence[str]:
        """The names of nodes that the faults below can be done to."""
        raise NotSupported(f"provider {self.name} cannot do faults to nodes")

    def node_down(self, node: str) -> None:
        """Cuts a node's power: everything on it is gone at once."""
        raise NotSupported(f"provider {self.name} cannot cut a node's power")

    def node_up(self, node: str) -> None:
        """Switches a node on again; it becomes Ready later. Also ends a freeze and puts the cable back."""
        raise NotSupported(f"provider {self.name} cannot switch a node on")

    def node_freeze(self, node: str, frozen: bool) -> None:
        """Stops every process of a node where it stands, or lets them go on."""
        raise NotSupported(f"provider {self.name} cannot freeze a node")

    def node_runtime(self, node: str, running: bool) -> None:
        """Stops a node's kubelet and container runtime, or starts them again. Its containers go on meanwhile."""
        raise NotSupported(f"provider {self.name} cannot stop a node's kubelet and container runtime")

    def api_stop(self) -> None:
        """Ends the API server at once; everything else goes on without it."""
        raise NotSupported(f"provider {self.name} cannot stop the API server")

    def api_start(self) -> None:
        """Starts the API server again, and returns when it answers."""
        raise NotSupported(f"provider {self.name} cannot start the API server")

    def node_link(self, node: str, connected: bool) -> None:
        """Pulls a node's network cable, or puts it back. Its pods go on running."""
        raise NotSupported(f"provider {self.name} cannot cut a node off")

"""Provider `kind`: Kubernetes in Docker (https://kind.sigs.k8s.io), for machines that have both.

A node of kind is a container, so it can have most faults of nodes. Its network plugin, kindnet, enforces network
policies.
"""

import contextlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from testcluster import packages
from testcluster.images.engines import Docker
from testcluster.paths import cache
from testcluster.progress import Progress, wait_until
from testcluster.providers.base import ClusterError, Provider, Status
from testcluster.shell import CommandFailed, run

API_WITHIN = 120.0
"""Seconds within which the API server of a cluster that was switched on answers."""

_NETWORK = "kind"

# kind applies patches without a version to each version of kubeadm's configuration, and translates `extraArgs` for it.
# The times for the loss of a node are those of the local provider; see its control plane for upstream's times.
_CONFIGURATION = """kind: Cluster
apiVersion: kind.x-k8s.io/v1alpha4
nodes:
- role: control-plane
- role: worker
- role: worker
- role: worker
kubeadmConfigPatches:
- |
  kind: ClusterConfiguration
  apiServer:
    extraArgs:
      default-not-ready-toleration-seconds: "5"
      default-unreachable-toleration-seconds: "5"
  controllerManager:
    extraArgs:
      node-monitor-period: 1s
      node-monitor-grace-period: 6s
      node-eviction-rate: "10"
- |
  kind: KubeletConfiguration
  nodeStatusUpdateFrequency: 2s
  nodeLeaseDurationSeconds: 4
  syncFrequency: 10s
"""


@dataclass(frozen=True)
class _Container:
    """The container of a node.

    Attributes:
        status: Docker's word for its state, such as `running`, `paused` or `exited`.
        connected: whether it has the network of kind.
    """

    status: str
    connected: bool

    @property
    def on(self) -> bool:
        return self.status in ("running", "paused")


class KindProvider(Provider):
    """A kind cluster with a control plane and three nodes."""

    name = "kind"
    engine = "docker"

    def __init__(self, cluster: str | None, progress: Progress) -> None:
        self._cluster = cluster or "understudy"
        self._progress = progress

    @staticmethod
    def obstacle() -> str | None:
        """Return why this provider cannot be used here; None if it can."""
        for program in ("kind", "docker"):
            if not packages.find(program):
                return f"the program `{program}` is missing"
        try:
            run("docker", "version", "--format", "{{.Server.Version}}", timeout=20)
        except CommandFailed as error:
            reason = error.output.strip().splitlines() or [str(error)]
            return f"Docker does not answer ({reason[-1]})"
        return None

    def _require(self) -> None:
        obstacle = self.obstacle()
        if obstacle:
            raise ClusterError(f"provider kind: {obstacle}; --provider local works without either, as root on Linux")

    @property
    def _kubeconfig(self) -> Path:
        return cache() / "kind" / f"{self._cluster}.conf"

    def _exists(self) -> bool:
        return self._cluster in run("kind", "get", "clusters").split()

    def _missing(self) -> ClusterError:
        return ClusterError(f"cluster {self._cluster}: there is none; `scripts/cluster up --provider kind` makes it")

    def _kubectl(self, *arguments: str) -> str:
        # From inside the control plane, for people without kubectl.
        return run(
            "docker",
            "exec",
            f"{self._cluster}-control-plane",
            "kubectl",
            "--kubeconfig=/etc/kubernetes/admin.conf",
            *arguments,
        )

    def up(self) -> None:
        self._require()
        if self._exists():
            for node in self._containers():
                self._switch_on(node)
            if not self._whole():
                self._progress(f"cluster {self._cluster}: an earlier run left it unfinished; it is created again")
                self.down()
        if not self._exists():
            with self._progress.step(f"cluster {self._cluster}: making it with kind"):
                self._create()
        run("kind", "export", "kubeconfig", "--name", self._cluster, "--kubeconfig", self._kubeconfig)
        wait_until(
            lambda: bool(self._kubectl("get", "nodes", "-o", "name")),
            API_WITHIN,
            f"cluster {self._cluster}: the API server answers (`scripts/cluster down` removes a broken cluster)",
            interval=1.0,
            despite=CommandFailed,
        )
        self._kubectl("wait", "--for=condition=Ready", "nodes", "--all", "--timeout=120s")
        self._kubectl("-n", "kube-system", "rollout", "status", "deployment/coredns", "--timeout=120s")
        self._progress(f"cluster {self._cluster} is ready: export KUBECONFIG={self._kubeconfig}")

    def _create(self) -> None:
        configuration = self._kubeconfig.with_name("configuration.yaml")
        configuration.parent.mkdir(exist_ok=True)
        configuration.write_text(_CONFIGURATION)
        # One of an earlier cluster would make an unfinished one look whole.
        self._kubeconfig.unlink(missing_ok=True)
        create = ["kind", "create", "cluster", "--name", self._cluster, "--config", str(configuration)]
        try:
            run(*create, "--wait", "180s", "--kubeconfig", self._kubeconfig)
        except CommandFailed as error:
            raise ClusterError(
                f"{error}\nkind removes the nodes of a cluster that it cannot make. `{' '.join(create)} --retain` keeps them, "
                f"and `kind export logs --name {self._cluster}` shows their logs. "
                "--provider local works without kind, as root on Linux"
            ) from error

    def _whole(self) -> bool:
        """Return whether kind finished making the cluster.

        The last that kind writes is the kubeconfig. If that was deleted since, a cluster that answers is whole if all nodes
        have joined.
        """
        if self._kubeconfig.exists():
            return True
        with contextlib.suppress(CommandFailed):
            return len(self._kubectl("get", "nodes", "-o", "name").split()) == _CONFIGURATION.count("- role:")
        return False

    def _containers(self) -> list[str]:
        return run("kind", "get", "nodes", "--name", self._cluster).split()

    def down(self) -> None:
        self._require()
        run("kind", "delete", "cluster", "--name", self._cluster, "--kubeconfig", self._kubeconfig)
        self._kubeconfig.unlink(missing_ok=True)
        self._progress(f"cluster {self._cluster} is gone")

    def status(self) -> Status:
        self._require()
        if not self._exists():
            return Status(False, f"cluster {self._cluster}: there is none")
        try:
            listed = self._kubectl("get", "nodes", "--no-headers").splitlines()
        except CommandFailed as error:
            return Status(False, f"cluster {self._cluster}: its API server does not answer", [str(error)])
        whole = bool(listed) and all(line.split()[1].split(",")[0] == "Ready" for line in listed)
        return Status(
            whole,
            f"cluster {self._cluster} (kind) {'is ready' if whole else 'is not ready'}",
            [*listed, f"kubeconfig: {self._kubeconfig}"],
        )

    def load_images(self, images: Sequence[str]) -> None:
        self._require()
        if not self._exists():
            raise self._missing()
        for image in images:
            if Path(image).is_file():
                run("kind", "load", "image-archive", "--name", self._cluster, image)
            else:
                if Docker().identity(image) is None:
                    raise ClusterError(
                        f"image {image}: neither an archive nor an image that Docker has; "
                        "scripts/images builds the project's own"
                    )
                run("kind", "load", "docker-image", "--name", self._cluster, image)
            self._progress(f"{image}: loaded")

    def kubeconfig(self) -> Path:
        if not self._kubeconfig.exists():
            raise self._missing()
        return self._kubeconfig

    def nodes(self) -> Sequence[str]:
        self._require()
        containers = self._containers()
        if not containers:
            raise self._missing()
        return [node for node in containers if not node.endswith("-control-plane")]

    def _known(self, node: str) -> str:
        nodes = self.nodes()
        if node not in nodes:
            raise ClusterError(f"cluster {self._cluster}: no node {node!r}; it has {', '.join(nodes)}")
        return node

    def _inspect(self, node: str) -> _Container:
        [found] = json.loads(run("docker", "container", "inspect", node))
        return _Container(found["State"]["Status"], _NETWORK in found["NetworkSettings"]["Networks"])

    def _inspect_on(self, node: str) -> _Container:
        container = self._inspect(self._known(node))
        if not container.on:
            raise ClusterError(f"node {node} is off; `scripts/cluster node up {node}` switches it on")
        return container

    def _switch_on(self, node: str) -> None:
        container = self._inspect(node)
        if container.status == "paused":
            run("docker", "unpause", node)
        if not container.connected:
            # Before the start: the first program of a node ends at once if the node has lost its address.
            run("docker", "network", "connect", _NETWORK, node)
        if container.on:
            # In a node that kind has not finished, these services may be missing.
            run("docker", "exec", node, *_services("start"), check=False)
        else:
            run("docker", "start", node)

    def node_down(self, node: str) -> None:
        if self._inspect(self._known(node)).on:
            run("docker", "kill", node)

    def node_up(self, node: str) -> None:
        self._switch_on(self._known(node))

    def node_freeze(self, node: str, frozen: bool) -> None:
        if (self._inspect_on(node).status == "paused") != frozen:
            run("docker", "pause" if frozen else "unpause", node)

    def node_runtime(self, node: str, running: bool) -> None:
        self._inspect_on(node)
        run("docker", "exec", node, *_services("start" if running else "stop"))

    def node_link(self, node: str, connected: bool) -> None:
        if self._inspect(self._known(node)).connected != connected:
            run("docker", "network", "connect" if connected else "disconnect", _NETWORK, node)


def _services(action: str) -> list[str]:
    """Return the command that starts or stops the container runtime and the kubelet of a node."""
    return ["systemctl", action, "containerd", "kubelet"]

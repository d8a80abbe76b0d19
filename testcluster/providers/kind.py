"""Provider `kind`: Kubernetes in Docker (https://kind.sigs.k8s.io), for machines that have both.

A node of kind is a container, so it can have most faults of nodes. Its network plugin, kindnet, enforces network
policies.
"""

import contextlib
from collections.abc import Sequence
from pathlib import Path

from testcluster import packages
from testcluster.images.engines import Docker, docker_works
from testcluster.paths import cache
from testcluster.progress import Progress
from testcluster.providers.base import ClusterError, Provider, Status
from testcluster.shell import CommandFailed, run, succeeds

_NETWORK = "kind"

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
        if not packages.find("kind"):
            return "the program `kind` is missing"
        if not docker_works():
            return "Docker does not answer"
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
        if self._exists() and not self._whole():
            self._progress(f"cluster {self._cluster}: an earlier run left it unfinished; it is created again")
            self.down()
        if not self._exists():
            with self._progress.step(f"cluster {self._cluster}: making it with kind"):
                configuration = cache() / "kind" / "configuration.yaml"
                configuration.parent.mkdir(exist_ok=True)
                configuration.write_text(_CONFIGURATION)
                run(
                    "kind",
                    "create",
                    "cluster",
                    "--name",
                    self._cluster,
                    "--config",
                    configuration,
                    "--wait",
                    "180s",
                    "--kubeconfig",
                    self._kubeconfig,
                )
        else:
            for node in self._containers():
                run("docker", "start", node)
        self._kubeconfig.parent.mkdir(exist_ok=True)
        run("kind", "export", "kubeconfig", "--name", self._cluster, "--kubeconfig", self._kubeconfig)
        self._kubectl("wait", "--for=condition=Ready", "nodes", "--all", "--timeout=120s")
        self._kubectl("-n", "kube-system", "rollout", "status", "deployment/coredns", "--timeout=120s")
        self._progress(f"cluster {self._cluster} is ready: export KUBECONFIG={self._kubeconfig}")

    def _whole(self) -> bool:
        """Return whether kind finished making the cluster: its last step is to label the nodes that joined."""
        for node in self._containers():
            run("docker", "start", node, check=False)
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
        whole = bool(listed) and all(line.split()[1] == "Ready" for line in listed)
        return Status(
            whole,
            f"cluster {self._cluster} (kind) {'is ready' if whole else 'is not ready'}",
            [*listed, f"kubeconfig: {self._kubeconfig}"],
        )

    def load_images(self, images: Sequence[str]) -> None:
        self._require()
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
            raise ClusterError(f"cluster {self._cluster}: there is none; `scripts/cluster up --provider kind` makes it")
        return self._kubeconfig

    def nodes(self) -> Sequence[str]:
        return [node for node in self._containers() if not node.endswith("-control-plane")]

    def _known(self, node: str) -> str:
        if node not in self.nodes():
            raise ClusterError(f"cluster {self._cluster}: no node {node!r}; it has {', '.join(self.nodes())}")
        return node

    def node_down(self, node: str) -> None:
        run("docker", "kill", self._known(node))

    def node_up(self, node: str) -> None:
        succeeds("docker", "unpause", self._known(node))
        run("docker", "start", node)
        succeeds("docker", "network", "connect", _NETWORK, node)

    def node_freeze(self, node: str, frozen: bool) -> None:
        run("docker", "pause" if frozen else "unpause", self._known(node))

    def node_runtime(self, node: str, running: bool) -> None:
        run("docker", "exec", self._known(node), "systemctl", "start" if running else "stop", "containerd", "kubelet")

    def node_link(self, node: str, connected: bool) -> None:
        run("docker", "network", "connect" if connected else "disconnect", _NETWORK, self._known(node))

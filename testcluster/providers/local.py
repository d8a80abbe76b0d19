"""Provider `local`: everything from source and packages, on this machine, without Docker. Linux and root only."""

import contextlib
import os
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from datetime import UTC, datetime, timedelta
from pathlib import Path

from testcluster import locks
from testcluster.images import containerd, engines, store
from testcluster.images.catalog import PRESENT
from testcluster.local import cgroups, controlplane, golden, limits, network, pki, system
from testcluster.local import layout as layouts
from testcluster.local import node as nodes
from testcluster.local import programs as tools
from testcluster.local.layout import Layout, node_name, node_number
from testcluster.modes import NetworkModes
from testcluster.paths import cache
from testcluster.progress import Progress
from testcluster.providers.base import ClusterError, NotSupported, Provider, Status
from testcluster.shell import CommandFailed

_OWN_IMAGES = "localhost/understudy-"


class LocalProvider(Provider):
    """A control plane and some nodes, each node in its own namespaces with its own container runtime and kubelet."""

    name = "local"
    engine = "buildah"

    def __init__(self, cluster: str | None, progress: Progress, network: str | None = None) -> None:
        """``network`` is what enforces network policies in a new cluster (programs.ENFORCERS)."""
        self._cluster, self._network = cluster or layouts.DEFAULT_NAME, network
        if not self._cluster.replace("-", "").isalnum() or len(self._cluster) > 30:
            raise ClusterError(f"cluster name {self._cluster!r}: letters, digits and dashes, 30 at most, are needed")
        self._progress = progress

    @staticmethod
    def obstacle() -> str | None:
        """Return why this provider cannot be used here; None if it can."""
        if os.uname().sysname != "Linux":
            return "it needs Linux"
        if os.geteuid() != 0:
            return "it needs root"
        return None

    def _require_root(self) -> None:
        obstacle = self.obstacle()
        if obstacle:
            raise ClusterError(
                f"provider local: {obstacle}; with Docker and kind installed, --provider kind works without"
            )

    def _locked(self) -> AbstractContextManager[None]:
        """Return the lock that allows one change of a cluster at a time."""
        return locks.held(f"cluster-{self._cluster}", self._progress)

    def _layout(self) -> Layout:
        found = layouts.load(self._cluster)
        if found is None:
            raise ClusterError(f"cluster {self._cluster}: there is none; `scripts/cluster up` makes it")
        return found

    def up(self) -> None:
        self._require_root()
        with self._locked():
            # Building comes first: it takes longest, and is most likely to fail because the machine lacks something.
            found = layouts.load(self._cluster)
            present = found.enforcer if found is not None else layouts.OWN
            programs = tools.ensure(self._progress, self._network or present)
            if found is not None and network.holder(found) is None and found.state.exists():
                self._progress(f"cluster {self._cluster}: removing what is left of an earlier one")
                self._remove(found)
                found = None
            if found is not None and found.enforcer != programs.enforcer.name:
                raise ClusterError(
                    f"cluster {self._cluster} has network {found.enforcer}; `scripts/cluster down` removes it"
                )
            # The lock lasts until the new cluster has saved its network and slot, so that no other new cluster chooses
            # them.
            with locks.held("clusters"):
                layout = found or layouts.decide(self._cluster, programs.enforcer.name)
                if found is None:
                    # The cache may have been removed under a running cluster.
                    cgroups.kill(layout.cgroup)
                layout.save()
                limits.ensure(self._progress)
            self._start(layout, programs)
            self._progress(f"cluster {self._cluster} is ready: export KUBECONFIG={layout.kubeconfig}")

    def _start(self, layout: Layout, programs: tools.Programs) -> None:
        self._progress(f"cluster {layout.name}: control plane at {layout.api}")
        certificates = pki.create(layout, programs.enforcer.users)
        if not all(nodes.has_images(layout, node) for node in layout.nodes):
            golden.ensure(programs, self._progress)
        holder = network.up(layout)
        started = [node for node in layout.nodes if nodes.up(layout, node, programs)]
        # A node that was running sends its heartbeat every second. A node that was started now counts from its first
        # heartbeat.
        since = datetime.now(UTC) if started else datetime.now(UTC) - timedelta(seconds=10)
        controlplane.up(layout, programs, certificates, holder)
        system.apply(layout, programs)
        if started:
            self._progress(
                f"cluster {layout.name}: waiting for {', '.join(node_name(node) for node in started)} and for DNS"
            )
        system.wait_ready(layout, programs, since)

    def _remove(self, layout: Layout) -> None:
        cgroups.kill(layout.cgroup)
        cgroups.remove(layout.cgroup)
        network.remove_host_link(layout)
        # Last, so that an interrupted removal can be repeated.
        shutil.rmtree(layout.state)

    def down(self) -> None:
        self._require_root()
        with self._locked():
            layout = layouts.load(self._cluster)
            if layout is None:
                shutil.rmtree(layouts.folder(self._cluster), ignore_errors=True)
                self._progress(f"cluster {self._cluster}: there is none")
                return
            self._remove(layout)
            with locks.held("clusters"):
                if not layouts.names():
                    limits.restore()
            self._progress(f"cluster {self._cluster} is gone; what was built stays in {cache()}")

    def status(self) -> Status:
        layout = layouts.load(self._cluster)
        if layout is None:
            return Status(False, f"cluster {self._cluster}: there is none")
        programs = tools.ensure(self._progress, layout.enforcer)
        details = [
            f"{name}: {'runs' if runs else 'does not run'}" for name, runs in controlplane.running(layout).items()
        ]
        answers = controlplane.answers(layout)
        ready: set[str] = set()
        if answers:
            with contextlib.suppress(CommandFailed):
                ready = system.ready_nodes(layout, programs) & {node_name(node) for node in layout.nodes}
        for node in layout.nodes:
            power = "on" if nodes.init(layout, node) else "off"
            cable = "" if network.node_connected(layout, node) else ", cable out"
            readiness = "Ready" if node_name(node) in ready else "not Ready"
            frozen = ", frozen" if cgroups.frozen(nodes.group(layout, node)) else ""
            modes = nodes.network_modes(layout, node)
            weak = f", network: {modes}" if modes != NetworkModes() else ""
            details.append(f"{node_name(node)} ({layout.node_ip(node)}): {power}{cable}{frozen}{weak}, {readiness}")
        whole = answers and len(ready) == layout.node_count
        details.append(f"kubeconfig: {layout.kubeconfig}")
        how = "is ready" if whole else "is not ready"
        version = f"Kubernetes {tools.kubernetes_version()}, network {layout.enforcer},"
        summary = f"cluster {layout.name}: {version} at {layout.api} {how}"
        return Status(whole, summary, details)

    def load_images(self, images: Sequence[str]) -> None:
        layout = self._layout()
        on = [node for node in layout.nodes if nodes.init(layout, node)]
        if not on:
            raise ClusterError(f"cluster {layout.name}: no node is on")
        with locks.held("images", self._progress):
            wanted = [reference for image in images for reference in self._take(image)]
            store.prune()

            def load(node: int) -> list[store.Reference]:
                # The container runtime's socket is in the node's own mounts.
                return containerd.load([*nodes.mounts(layout, node), "ctr"], wanted)

            with ThreadPoolExecutor() as pool:
                loaded = list(pool.map(load, on))
            for reference in wanted:
                if not (reference.name.startswith(_OWN_IMAGES) and reference.name.endswith(f":{PRESENT.tag}")):
                    # Only the present images of the project are kept, for new nodes.
                    store.forget(reference)
        for reference in wanted:
            news = [node_name(node) for node, missing in zip(on, loaded, strict=True) if reference in missing]
            self._progress(f"{reference.name}: {'loaded into ' + ', '.join(news) if news else 'was there'}")

    def _take(self, image: str) -> list[store.Reference]:
        """Add an image to the store, from an archive or from the builder."""
        if Path(image).is_file():
            return store.add(Path(image))
        engine = engines.choose(self.engine, self._progress)
        identity = engine.identity(image)
        if identity is None:
            raise ClusterError(
                f"image {image}: neither an archive nor an image that {engine.name} has; "
                "scripts/images builds the project's own"
            )
        known = store.get(image)
        if known and known.config == identity:
            return [known]
        archive = cache() / "images" / f"export.{os.getpid()}.tar"
        try:
            engine.export(image, archive)
            return store.add(archive)
        finally:
            archive.unlink(missing_ok=True)

    def kubeconfig(self) -> Path:
        return self._layout().kubeconfig

    def nodes(self) -> Sequence[str]:
        return [node_name(node) for node in self._layout().nodes]

    def node_down(self, node: str) -> None:
        layout = self._layout()
        with self._locked():
            nodes.down(layout, node_number(node, layout))

    def node_up(self, node: str) -> None:
        layout = self._layout()
        with self._locked():
            number = node_number(node, layout)
            cgroups.freeze(nodes.group(layout, number), False)
            nodes.start_runtime(layout, number)
            if nodes.init(layout, number) and not network.node_connected(layout, number):
                network.set_node_link(layout, number, True)
            nodes.up(layout, number, tools.ensure(self._progress, layout.enforcer))

    def node_freeze(self, node: str, frozen: bool) -> None:
        layout = self._layout()
        cgroups.freeze(nodes.group(layout, node_number(node, layout)), frozen)

    def node_runtime(self, node: str, running: bool) -> None:
        layout = self._layout()
        number = node_number(node, layout)
        with self._locked():
            if running:
                nodes.start_runtime(layout, number)
            else:
                nodes.stop_runtime(layout, number)

    def node_network(self, node: str, modes: NetworkModes) -> None:
        layout = self._layout()
        if layout.enforcer != layouts.OWN:
            raise NotSupported(f"network {layout.enforcer} has no modes")
        nodes.set_network_modes(layout, node_number(node, layout), modes)

    def api_stop(self) -> None:
        with self._locked():
            controlplane.stop_api(self._layout())

    def api_start(self) -> None:
        with self._locked():
            layout = self._layout()
            holder = network.holder(layout)
            if holder is None:
                raise ClusterError(f"cluster {self._cluster} does not run; `scripts/cluster up` starts it")
            programs = tools.ensure(self._progress, layout.enforcer)
            controlplane.up(layout, programs, pki.create(layout, programs.enforcer.users), holder)

    def node_link(self, node: str, connected: bool) -> None:
        layout = self._layout()
        network.set_node_link(layout, node_number(node, layout), connected)

"""etcd and the Kubernetes control plane, in the network namespace of the cluster's switch."""

import contextlib
import os
import signal
import ssl
import urllib.request
from pathlib import Path

from testcluster.local import network, processes
from testcluster.local.layout import API_PORT, Layout
from testcluster.local.programs import Programs
from testcluster.progress import wait_until
from testcluster.shell import run

_ETCD = "http://127.0.0.1:2379"
_ETCD_PEER = "http://127.0.0.1:2380"


def _etcd(layout: Layout) -> list[str]:
    return [
        "etcd",
        f"--data-dir={layout.state}/etcd",
        f"--listen-client-urls={_ETCD}",
        f"--advertise-client-urls={_ETCD}",
        f"--listen-peer-urls={_ETCD_PEER}",
        f"--initial-advertise-peer-urls={_ETCD_PEER}",
        f"--initial-cluster=default={_ETCD_PEER}",
        # After a crash of the machine a test cluster is made again, so its writes need not survive one.
        "--unsafe-no-fsync",
        "--log-level=warn",
    ]


def _apiserver(layout: Layout, pki: Path) -> list[str]:
    return [
        "kube-apiserver",
        f"--etcd-servers={_ETCD}",
        f"--service-cluster-ip-range={layout.services}",
        f"--advertise-address={layout.control_plane_ip}",
        "--bind-address=0.0.0.0",
        f"--secure-port={API_PORT}",
        f"--tls-cert-file={pki}/apiserver.crt",
        f"--tls-private-key-file={pki}/apiserver.key",
        f"--client-ca-file={pki}/ca.crt",
        f"--service-account-key-file={pki}/service-accounts.pub",
        f"--service-account-signing-key-file={pki}/service-accounts.key",
        "--service-account-issuer=https://kubernetes.default.svc.cluster.local",
        "--authorization-mode=Node,RBAC",
        "--enable-admission-plugins=NodeRestriction",
        "--allow-privileged",
        # Node names cannot be resolved; logs and exec use addresses.
        "--kubelet-preferred-address-types=InternalIP",
        f"--kubelet-client-certificate={pki}/apiserver-kubelet-client.crt",
        f"--kubelet-client-key={pki}/apiserver-kubelet-client.key",
        f"--kubelet-certificate-authority={pki}/ca.crt",
        # A robot cannot wait the usual five minutes for pods of a lost node.
        "--default-not-ready-toleration-seconds=5",
        "--default-unreachable-toleration-seconds=5",
    ]


def _controller_manager(layout: Layout, pki: Path) -> list[str]:
    # A node counts as lost six seconds after its last heartbeat (upstream: 50), and its pods are evicted at once.
    # Simulated nodes never count as lost, because only the simulator can be late with their heartbeats.
    losses = ["--node-monitor-period=1s", "--node-monitor-grace-period=6s"] if layout.node_count else []
    return [
        "kube-controller-manager",
        f"--kubeconfig={pki}/controller-manager.conf",
        f"--service-account-private-key-file={pki}/service-accounts.key",
        f"--root-ca-file={pki}/ca.crt",
        f"--cluster-signing-cert-file={pki}/ca.crt",
        f"--cluster-signing-key-file={pki}/ca.key",
        "--use-service-account-credentials",
        "--leader-elect=false",
        *losses,
        "--node-eviction-rate=10",
        "--kube-api-qps=200",
        "--kube-api-burst=400",
    ]


def _scheduler(pki: Path) -> list[str]:
    return [
        "kube-scheduler",
        f"--kubeconfig={pki}/scheduler.conf",
        "--leader-elect=false",
        "--kube-api-qps=200",
        "--kube-api-burst=400",
    ]


def kubectl(layout: Layout, programs: Programs, *arguments: str, input: str | None = None) -> str:
    """Run kubectl as the cluster's administrator."""
    return run(
        programs.hyperkube,
        "kubectl",
        f"--kubeconfig={layout.kubeconfig}",
        *arguments,
        input=input,
        timeout=120,
        env={"NO_PROXY": "*"},
    )


def answers(layout: Layout) -> bool:
    """Return whether the API server reports that it is ready."""
    pki = layout.state / "pki"
    try:
        trust = ssl.create_default_context(cafile=str(pki / "ca.crt"))
        trust.load_cert_chain(pki / "admin.crt", pki / "admin.key")
        # Do not use the environment's proxy, which cannot reach this machine's own networks.
        direct = urllib.request.build_opener(
            urllib.request.ProxyHandler({}), urllib.request.HTTPSHandler(context=trust)
        )
        with direct.open(f"{layout.api}/readyz", timeout=3) as reply:
            return bool(reply.status == 200)
    except OSError:
        return False


def running(layout: Layout) -> dict[str, bool]:
    """Return which programs of the control plane run."""
    group = network.control_plane_group(layout)
    names = ("etcd", "kube-apiserver", "kube-controller-manager", "kube-scheduler")
    return {name: processes.find(group, name) is not None for name in names}


def stop_api(layout: Layout) -> None:
    """End the API server as a crash would, and wait until it is gone. It is no error if it is gone already.

    Raises:
        TimeoutError: the kernel does not end it.
    """
    group = network.control_plane_group(layout)

    def gone() -> bool:
        pid = processes.find(group, "kube-apiserver")
        if pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return pid is None

    wait_until(gone, 20, "the API server has ended")


def up(layout: Layout, programs: Programs, pki: Path, holder: int) -> None:
    """Start the programs that do not run, and wait until the API server answers.

    Raises:
        TimeoutError: it does not answer in time; the message names its log.
    """
    group = network.control_plane_group(layout)
    runs = running(layout)

    def start(arguments: list[str]) -> None:
        if not runs[arguments[0]]:
            processes.start(
                group,
                [*network.inside(holder), programs.hyperkube, *arguments],
                layout.log / f"{arguments[0]}.log",
                prompt=arguments[0] in ("etcd", "kube-apiserver"),
            )

    start(_etcd(layout))
    start(_apiserver(layout, pki))
    wait_until(lambda: answers(layout), 180, f"the API server answers (its log: {layout.log}/kube-apiserver.log)")
    start(_controller_manager(layout, pki))
    start(_scheduler(pki))
    for name, command in programs.enforcer.control_plane(layout).items():
        if processes.find(group, *map(str, command[-2:])) is None:
            processes.start(group, [*network.inside(holder), *command], layout.log / f"{name}.log")
    layout.api_ready.touch()

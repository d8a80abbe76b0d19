"""The local provider makes a real cluster: what its network carries, how it loses nodes, and that it leaves nothing.

On clusters of their own, beside the one under test: losing a node there would disturb the others.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from kubernetes import client, config
from kubernetes.client import CoreV1Api
from kubernetes.stream import stream

from testcluster.local import cgroups, layout, network, node, processes, programs
from testcluster.local.layout import Layout
from testcluster.local.machines import Machine
from testcluster.shell import run

pytestmark = [
    pytest.mark.local_only,
    pytest.mark.long,  # a second cluster takes the processors of the first one, and all other tests here use a local provider too
    pytest.mark.timeout(600),
    pytest.mark.xdist_group("a cluster of their own"),
]

REPOSITORY = Path(__file__).resolve().parents[2]
NAME = "provider-tests"
IMAGE = "localhost/understudy-operator:dev"

ECHO = """
import socket
channel = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
channel.bind(("", 7000))
while True:
    data, sender = channel.recvfrom(1500)
    channel.sendto(data, sender)
"""

ASK = """
import socket, sys
channel = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
channel.settimeout(0.5)
answered = 0
for number in range(20):
    channel.sendto(str(number).encode(), (sys.argv[1], 7000))
    try:
        answered += channel.recv(1500) == str(number).encode()
    except TimeoutError:
        pass
print(answered)
"""


def program(name: str, *arguments: str, cluster: str = NAME, check: bool = True, **environment: str) -> str:
    """Runs one of the project's scripts for a cluster."""
    done = subprocess.run(
        [str(REPOSITORY / "scripts" / name), *arguments],
        env={**os.environ, "UNDERSTUDY_CLUSTER_PROVIDER": "local", "UNDERSTUDY_CLUSTER_NAME": cluster, **environment},
        capture_output=True,
        text=True,
    )
    if check and done.returncode:
        raise AssertionError(f"scripts/{name} {' '.join(arguments)} ended with {done.returncode}: {done.stderr}")
    return done.stdout


def until(condition: Callable[[], object], what: str, seconds: float) -> float:
    """Waits for a condition; returns after how many seconds it held."""
    start = time.monotonic()
    while not condition():
        took = time.monotonic() - start
        assert took < seconds, f"{what}: not so within {seconds:g} s"
        time.sleep(0.1)
    return time.monotonic() - start


class OwnCluster:
    """A cluster of these tests alone."""

    def __init__(self) -> None:
        found = layout.load(NAME)
        assert found is not None
        self.layout: Layout = found
        api = config.new_client_from_config(str(found.kubeconfig))
        self.core = CoreV1Api(api)
        self.apps = client.AppsV1Api(api)
        self.networking = client.NetworkingV1Api(api)

    def fault(self, action: str, name: str) -> None:
        program("cluster", "node", action, name)

    def ready(self, name: str) -> bool:
        conditions = self.core.read_node(name).status.conditions
        return any(condition.type == "Ready" and condition.status == "True" for condition in conditions)

    def pod(
        self, namespace: str, name: str, command: list[str], on: str | None = None, labels: dict[str, str] | None = None
    ) -> None:
        """Makes a pod and waits until it is ready."""
        self.core.create_namespaced_pod(
            namespace,
            {
                "metadata": {"name": name, "labels": labels or {}},
                "spec": {**template(command), **({"nodeSelector": {"kubernetes.io/hostname": on}} if on else {})},
            },
        )
        until(lambda: ready(self.core.read_namespaced_pod(name, namespace)), f"pod {name} ready", 30)

    def address(self, namespace: str, name: str) -> str:
        return str(self.core.read_namespaced_pod(name, namespace).status.pod_ip)

    def execute(self, namespace: str, name: str, *command: str) -> str:
        return str(
            stream(
                self.core.connect_get_namespaced_pod_exec,
                name,
                namespace,
                command=list(command),
                stdout=True,
                stderr=True,
                stdin=False,
                tty=False,
            )
        )


def template(command: list[str]) -> dict[str, object]:
    return {
        "terminationGracePeriodSeconds": 0,
        "containers": [
            {
                "name": "main",
                "image": IMAGE,
                "imagePullPolicy": "Never",
                "command": command,
                "resources": {"requests": {"cpu": "50m"}, "limits": {"cpu": "200m"}},
            }
        ],
    }


def ready(pod: client.V1Pod) -> bool:
    conditions = pod.status.conditions or []
    return pod.metadata.deletion_timestamp is None and any(
        condition.type == "Ready" and condition.status == "True" for condition in conditions
    )


@pytest.fixture(scope="module")
def own() -> Iterator[OwnCluster]:
    program("cluster", "up")
    program("images", "--load", "operator")
    yield OwnCluster()
    program("cluster", "down")


@pytest.fixture
def namespace(own: OwnCluster) -> Iterator[str]:
    made = own.core.create_namespace({"metadata": {"generateName": "provider-"}}).metadata.name
    yield made
    own.core.delete_namespace(made, grace_period_seconds=0)


@pytest.fixture
def deployed(own: OwnCluster, namespace: str) -> Callable[[], list[client.V1Pod]]:
    """A deployment with one pod; the function lists its pods."""
    own.apps.create_namespaced_deployment(
        namespace,
        {
            "metadata": {"name": "single"},
            "spec": {
                "replicas": 1,
                "selector": {"matchLabels": {"app": "single"}},
                "template": {"metadata": {"labels": {"app": "single"}}, "spec": template(["sleep", "infinity"])},
            },
        },
    )

    def pods() -> list[client.V1Pod]:
        return list(own.core.list_namespaced_pod(namespace, label_selector="app=single").items)

    until(lambda: any(ready(pod) for pod in pods()), "the deployment's pod ready", 30)
    return pods


def test_every_node_is_ready_and_runs_the_requested_version(own: OwnCluster) -> None:
    nodes = own.core.list_node().items
    assert sorted(item.metadata.name for item in nodes) == ["node1", "node2", "node3"]
    assert all(own.ready(item.metadata.name) for item in nodes)
    assert {item.status.node_info.kubelet_version for item in nodes} == {f"v{programs.kubernetes_version()}"}


def test_nodes_together_promise_no_more_memory_than_the_machine_has(own: OwnCluster) -> None:
    promised = 0
    for item in own.core.list_node().items:
        quantity = item.status.allocatable["memory"]
        assert quantity.endswith("Ki")
        promised += int(quantity.removesuffix("Ki"))
    machine = int(Path("/proc/meminfo").read_text().split()[1])
    assert promised < machine


def test_names_resolve_in_a_pod(own: OwnCluster, namespace: str) -> None:
    own.pod(namespace, "asking", ["sleep", "infinity"])
    ask = "import socket; print(socket.gethostbyname('kubernetes.default.svc'))"
    answered = own.execute(namespace, "asking", "python3", "-c", ask)
    assert answered.strip() == own.layout.kubernetes_ip


def test_udp_crosses_between_pods_on_different_nodes(own: OwnCluster, namespace: str) -> None:
    own.pod(namespace, "echo", ["python3", "-c", ECHO], on="node1")
    own.pod(namespace, "asking", ["sleep", "infinity"], on="node2")
    answered = own.execute(namespace, "asking", "python3", "-c", ASK, own.address(namespace, "echo"))
    assert int(answered) == 20


def test_a_machine_outside_exchanges_packets_with_pods_and_leaves_nothing(
    own: OwnCluster, namespace: str, tmp_path: Path
) -> None:
    machine = Machine(own.layout, 1)
    own.pod(namespace, "echo", ["python3", "-c", ECHO])
    machine.up()
    try:
        asked = machine.run(sys.executable, "-c", ASK, own.address(namespace, "echo"))
        assert int(asked) == 20
        machine.start([sys.executable, "-c", ECHO], tmp_path / "echo.log")
        time.sleep(0.5)
        assert int(own.execute(namespace, "echo", "python3", "-c", ASK, machine.address)) == 20
    finally:
        machine.down()
    assert int(own.execute(namespace, "echo", "python3", "-c", ASK, machine.address)) == 0
    links = run(*network.inside(network.holder(own.layout) or 0), "ip", "link")
    assert "machine1" not in links
    assert not cgroups.pids(f"{own.layout.cgroup}/machine1")


def test_a_policy_stops_and_readmits_an_established_flow_between_nodes(own: OwnCluster, namespace: str) -> None:
    own.pod(namespace, "echo", ["python3", "-c", ECHO], on="node1", labels={"app": "echo"})
    own.pod(namespace, "asking", ["sleep", "infinity"], on="node2")
    address = own.address(namespace, "echo")
    assert int(own.execute(namespace, "asking", "python3", "-c", ASK, address)) == 20
    own.networking.create_namespaced_network_policy(
        namespace,
        {
            "metadata": {"name": "closed"},
            "spec": {"podSelector": {"matchLabels": {"app": "echo"}}, "policyTypes": ["Ingress"]},
        },
    )
    time.sleep(0.5)
    assert int(own.execute(namespace, "asking", "python3", "-c", ASK, address)) == 0
    own.networking.delete_namespaced_network_policy("closed", namespace)
    time.sleep(0.5)
    assert int(own.execute(namespace, "asking", "python3", "-c", ASK, address)) == 20


def test_logs_of_a_pod_can_be_read(own: OwnCluster, namespace: str) -> None:
    own.pod(namespace, "talking", ["sh", "-c", "echo said; sleep infinity"])

    def log() -> bytes:  # as the kubelet sends it: the client makes a text of Python's notation of it
        return own.core.read_namespaced_pod_log("talking", namespace, _preload_content=False).data

    until(lambda: log() == b"said\n", "the log is there", 30)


def test_a_pod_is_resized_in_place(own: OwnCluster, namespace: str) -> None:
    own.pod(namespace, "growing", ["sleep", "infinity"], on="node3")
    resources = {"requests": {"cpu": "100m"}, "limits": {"cpu": "400m"}}
    own.core.patch_namespaced_pod_resize(
        "growing", namespace, {"spec": {"containers": [{"name": "main", "resources": resources}]}}
    )

    def limit() -> str | None:
        status = own.core.read_namespaced_pod("growing", namespace).status.container_statuses[0]
        assert status.restart_count == 0
        return status.resources.limits.get("cpu") if status.resources and status.resources.limits else None

    until(lambda: limit() == "400m", "the new limit is in force", 20)
    # Inside, the kernel says the same (by the version of control groups that the machine has).
    look = "cat /sys/fs/cgroup/cpu/cpu.cfs_quota_us 2>/dev/null || cut -d' ' -f1 /sys/fs/cgroup/cpu.max"
    assert own.execute(namespace, "growing", "sh", "-c", look).strip() == "40000"


def test_a_node_without_power_is_lost_its_pod_is_replaced_and_the_node_returns(
    own: OwnCluster, deployed: Callable[[], list[client.V1Pod]]
) -> None:
    (before,) = deployed()
    lost = before.spec.node_name
    own.fault("down", lost)
    assert node.init(own.layout, int(lost[-1])) is None
    assert not cgroups.pids(node.group(own.layout, int(lost[-1])))
    until(lambda: not own.ready(lost), "Kubernetes notices", 15)
    until(lambda: any(ready(pod) and pod.spec.node_name != lost for pod in deployed()), "the pod is replaced", 25)
    own.fault("up", lost)
    until(lambda: own.ready(lost), "the node is back", 20)
    until(lambda: len(deployed()) == 1, "the lost pod is gone", 30)


def test_a_frozen_node_is_lost_and_continues_after_the_thaw(own: OwnCluster) -> None:
    frozen = "node2"
    before = node.init(own.layout, 2)
    own.fault("freeze", frozen)
    try:
        until(lambda: not own.ready(frozen), "Kubernetes notices", 15)
        assert before is not None
        assert node.init(own.layout, 2) == before
    finally:
        own.fault("thaw", frozen)
    until(lambda: own.ready(frozen), "the node is back", 15)


def test_a_pod_on_a_node_that_is_cut_off_runs_on_until_the_node_is_back(
    own: OwnCluster, deployed: Callable[[], list[client.V1Pod]]
) -> None:
    (before,) = deployed()
    name = before.spec.node_name
    pods = f"{node.group(own.layout, int(name[-1]))}/pods"

    def runs() -> bool:
        uid = before.metadata.uid
        return any(
            uid in Path(f"/proc/{pid}/cgroup").read_text()
            for pid in cgroups.pids(pods)
            if processes.command_line(pid) == ["sleep", "infinity"]
        )

    own.fault("cut", name)
    try:
        until(lambda: any(ready(pod) and pod.spec.node_name != name for pod in deployed()), "a replacement", 30)
        assert runs(), "the pod on the node that is cut off ended; a real one would not"
    finally:
        own.fault("connect", name)
    until(lambda: own.ready(name), "the node is back", 20)
    until(lambda: not runs(), "the evicted pod has ended", 30)


def test_up_starts_missing_processes_again(own: OwnCluster) -> None:
    group = network.control_plane_group(own.layout)
    scheduler = processes.find(group, "kube-scheduler")
    assert scheduler is not None
    os.kill(scheduler, 9)
    own.fault("down", "node2")
    program("cluster", "up")
    assert processes.find(group, "kube-scheduler") is not None
    assert own.ready("node2")


def test_a_cluster_whose_start_was_killed_can_be_started_and_removed_completely() -> None:
    name = "provider-tests-killed"
    environment = {
        **os.environ,
        "UNDERSTUDY_CLUSTER_PROVIDER": "local",
        "UNDERSTUDY_CLUSTER_NAME": name,
        "UNDERSTUDY_CLUSTER_NODES": "1",
    }
    for seconds in (0.5, 1.5, 3.0):
        begun = subprocess.Popen(
            [str(REPOSITORY / "scripts" / "cluster"), "up"], env=environment, stderr=subprocess.DEVNULL
        )
        time.sleep(seconds)
        begun.kill()
        begun.wait()
    program("cluster", "up", cluster=name, UNDERSTUDY_CLUSTER_NODES="1")
    made = layout.load(name)
    assert made is not None
    assert program("cluster", "status", cluster=name).splitlines()[0].endswith("is ready")
    assert cgroups.pids(made.cgroup)

    program("cluster", "down", cluster=name)
    assert not cgroups.pids(made.cgroup)
    assert not list(Path("/sys/fs/cgroup").glob(f"**/{made.cgroup}"))
    assert not made.state.exists()
    links = json.loads(subprocess.check_output(["ip", "-j", "link"], text=True))
    assert made.host_link not in {link["ifname"] for link in links}
    routes = subprocess.check_output(["ip", "-4", "route", "show", "table", "all"], text=True)
    assert str(made.pod_network(1)) not in routes
    assert not [mount for mount in Path("/proc/mounts").read_text().splitlines() if str(made.state) in mount]
    assert program("cluster", "status", cluster=name, check=False).strip().endswith("there is none")

"""A control plane of the bench's own with simulated nodes: API server, etcd, controllers and scheduler are real, and
kwok simulates the kubelets.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Coroutine, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml

from bench.scaling import counting
from bench.scaling.fleets import Fleet, Robot, shared, workload
from understudy.api import names
from understudy.kube.client import (
    CRDS,
    MERGE,
    NAMESPACES,
    NODES,
    PODS,
    POLICIES,
    POOLS,
    SERVICE_ACCOUNTS,
    WORKLOADS,
    Access,
    ApiError,
    Client,
    Object,
    Resource,
)
from understudy.kube.kubeconfig import load_access

REPOSITORY = Path(__file__).resolve().parents[2]
NAME = "bench-scale"
NODE_COUNT = 10
SYSTEM, ACCOUNT = "understudy-system", "understudy-operator"
FLOWS = Resource("flowcontrol.apiserver.k8s.io", "v1", "flowschemas")
BINDINGS = Resource("rbac.authorization.k8s.io", "v1", "clusterrolebindings")
TOKEN_SECONDS = 6 * 3600
AT_ONCE = 16
"""Number of the bench's own requests that run at the same time."""

T = TypeVar("T")


def _script(*arguments: str) -> str:
    environment = {
        **os.environ,
        "UNDERSTUDY_CLUSTER_PROVIDER": "local",
        "UNDERSTUDY_CLUSTER_NAME": NAME,
        "UNDERSTUDY_CLUSTER_NODES": "0",
    }
    done = subprocess.run(
        [str(REPOSITORY / "scripts" / "cluster"), *arguments], env=environment, stdout=subprocess.PIPE, text=True
    )
    if done.returncode:
        raise SystemExit(f"scripts/cluster {' '.join(arguments)} ended with {done.returncode}")
    return done.stdout.strip()


@contextlib.contextmanager
def running(*, keep: bool) -> Iterator[Cluster]:
    """Provide a new and empty cluster for the duration of the context; with ``keep`` it continues to run afterwards."""
    kwok = shutil.which("kwok")
    if kwok is None:
        raise SystemExit("there is no kwok: run this by scripts/bench, which builds it")
    _script("down")
    try:
        _script("up")
        kubeconfig = Path(_script("kubeconfig"))
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "kwok.log"
            with log.open("wb") as out:
                # Real kubelets have their own machines, so their simulator has a lower priority than what is measured.
                command = [
                    "nice",
                    "-n",
                    "19",
                    kwok,
                    "--kubeconfig",
                    str(kubeconfig),
                    "--manage-all-nodes=true",
                    "--node-lease-duration-seconds=40",
                ]
                nodes = subprocess.Popen(command, stdout=out, stderr=out, env={**os.environ, "NO_PROXY": "*"})
            try:
                cluster = Cluster(kubeconfig, Path(folder))
                cluster.do(cluster.prepare)
                yield cluster
            finally:
                nodes.kill()
                nodes.wait()
    finally:
        if not keep:
            _script("down")


@dataclass(frozen=True)
class Cluster:
    """The bench's administrative access to the cluster."""

    kubeconfig: Path
    folder: Path
    """The folder for files of this run."""

    @property
    def access(self) -> Access:
        """The access of the administrator."""
        return load_access(str(self.kubeconfig))

    def do(self, work: Callable[[Client], Coroutine[Any, Any, T]]) -> T:
        """Run some work with a client of its own, and return its result."""

        async def run() -> T:
            async with Client(self.access, timeout=120) as client:
                return await work(client)

        return asyncio.run(run())

    def counted(self) -> counting.Reading:
        """Return what the API server has counted so far."""
        return asyncio.run(counting.fetch(self.access))

    def collect(self) -> None:
        """Let the API server collect its garbage now, so that garbage from the creation of fleets does not count in the
        next measurement."""
        self.do(lambda client: client.read("/debug/pprof/heap", params={"gc": "1"}))

    async def prepare(self, client: Client) -> None:
        """Create the nodes, the product's kinds and the operator's account."""
        for number in range(NODE_COUNT):
            node = {"apiVersion": "v1", "kind": "Node", "metadata": {"name": f"simulated-{number}"}}
            await _made(client, NODES, None, node)
        for file in sorted((REPOSITORY / "crds").glob("*.yaml")):
            for crd in yaml.safe_load_all(file.read_text()):
                await _made(client, CRDS, None, crd)
        for resource in (WORKLOADS, POLICIES, POOLS):
            await _until_served(client, resource)
        await _made(client, NAMESPACES, None, {"metadata": {"name": SYSTEM}})
        await _made(client, SERVICE_ACCOUNTS, SYSTEM, {"metadata": {"name": ACCOUNT}})
        binding = {
            "metadata": {"name": ACCOUNT},
            "roleRef": {"apiGroup": "rbac.authorization.k8s.io", "kind": "ClusterRole", "name": "cluster-admin"},
            "subjects": [{"kind": "ServiceAccount", "name": ACCOUNT, "namespace": SYSTEM}],
        }
        await _made(client, BINDINGS, None, binding)

    def count_apart(self, fleets: Sequence[Fleet]) -> None:
        """Count requests of the operator and of these fleets' monitors separately."""

        async def work(client: Client) -> None:
            for schema in counting.schemas([fleet.namespace for fleet in fleets], SYSTEM):
                await client.apply(FLOWS, None, schema, manager="bench")

        self.do(work)

    def operator_kubeconfig(self) -> Path:
        """Return a kubeconfig with the operator's token."""
        token = self.do(lambda client: _token(client, SYSTEM, ACCOUNT))
        config = yaml.safe_load(self.kubeconfig.read_text())
        config["users"][0]["user"] = {"token": token}
        file = self.folder / "operator.conf"
        file.write_text(yaml.safe_dump(config))
        return file

    def add(self, fleets: Iterable[Fleet], pool: int) -> None:
        """Create fleets."""

        async def work(client: Client) -> None:
            for fleet in fleets:
                await _made(client, NAMESPACES, None, {"metadata": {"name": fleet.namespace}})
                policy, spare = shared(pool)
                await _made(client, POLICIES, fleet.namespace, policy)
                await _made(client, POOLS, fleet.namespace, spare)
                await _each(fleet.robots, lambda robot: _made(client, WORKLOADS, robot.namespace, workload(robot)))

        self.do(work)

    def tokens(self, robots: Sequence[Robot]) -> list[tuple[str, str, str]]:
        """Return namespace and name of each robot, and the token of its monitor's account."""

        async def work(client: Client) -> list[tuple[str, str, str]]:
            async def one(robot: Robot) -> tuple[str, str, str]:
                account = names.monitor_account(robot.name)
                return robot.namespace, robot.name, await _token(client, robot.namespace, account)

            return await _each(robots, one)

        return self.do(work)

    def built(self) -> tuple[int, int]:
        """Return how many workloads the operator has built, and how many pods of shared pools are ready."""

        async def work(client: Client) -> tuple[int, int]:
            workloads = (await client.list(WORKLOADS))["items"]
            pools = (await client.list(POOLS))["items"]
            done = sum(_condition(item, "Reconciled") == "True" for item in workloads)
            return done, sum((pool.get("status") or {}).get("ready") or 0 for pool in pools)

        return self.do(work)

    def claimed(self) -> list[Object]:
        """Return the claimed pods that exist."""

        async def work(client: Client) -> list[Object]:
            pods = (await client.list(PODS, labels=names.POOL))["items"]
            return [pod for pod in pods if names.CLAIM in (pod["metadata"].get("annotations") or {})]

        return self.do(work)

    def delete(self, pods: Sequence[Object]) -> None:
        """Delete pods."""

        async def work(client: Client) -> None:
            async def one(pod: Object) -> None:
                metadata = pod["metadata"]
                await client.delete(PODS, metadata["namespace"], metadata["name"], uid=metadata["uid"])

            await _each(pods, one)

        self.do(work)


def _condition(item: Object, kind: str) -> str:
    found = (item.get("status") or {}).get("conditions") or []
    return next((c["status"] for c in found if c["type"] == kind), "")


async def _each(items: Sequence[Any], work: Callable[[Any], Coroutine[Any, Any, T]]) -> list[T]:
    some = asyncio.Semaphore(AT_ONCE)

    async def one(item: Any) -> T:
        async with some:
            return await work(item)

    return list(await asyncio.gather(*(one(item) for item in items)))


async def _made(client: Client, resource: Resource, namespace: str | None, item: Object) -> None:
    with contextlib.suppress(ApiError):
        await client.create(resource, namespace, item)
        return
    await client.patch(resource, namespace, item["metadata"]["name"], item, kind=MERGE)


async def _token(client: Client, namespace: str, account: str) -> str:
    body = {"spec": {"expirationSeconds": TOKEN_SECONDS}}
    path = SERVICE_ACCOUNTS.path(namespace, account, "token")
    answer = await client.request("POST", path, body=body)
    token: str = answer["status"]["token"]
    return token


async def _until_served(client: Client, resource: Resource) -> None:
    for _ in range(300):
        with contextlib.suppress(ApiError):
            await client.list(resource)
            return
        await asyncio.sleep(0.2)
    raise SystemExit(f"{resource.plural} are not served a minute after their CustomResourceDefinition was made")

"""The chart on the cluster under test, without a running operator: the kinds, the rights and the admission policy."""

from __future__ import annotations

import os
import subprocess
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.cluster.operators import APPS, CORE, Fleet, Operator
from tests.cluster.policy_pods import World, table
from tests.support.chart import SET_IMAGES
from tests.support.cluster import Cluster, Object, account, until
from tests.support.reruns import once_more
from tests.support.sharing import shared
from understudy.api.base import GROUP
from understudy.api.schema.printed_kinds import KINDS

REPOSITORY = Path(__file__).resolve().parents[2]
NAME = "understudy"
NAMESPACE = "understudy-system"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """A test that fails is run once more, and said to have been, but for the one that looks for what may never be."""
    for item in items:
        if "tests/cluster" in str(item.path) and item.path.name != "test_contention.py":
            item.add_marker(once_more(config))


@pytest.fixture(scope="session", autouse=True)
def _one_cluster(kubeconfig: Path) -> None:
    """Also for tests that only look at $KUBECONFIG."""


@dataclass(frozen=True)
class Release:
    """An installed chart."""

    name: str
    namespace: str

    @property
    def operator(self) -> str:
        """The operator's ServiceAccount and its roles."""
        return f"{self.name}-operator"

    @property
    def user(self) -> str:
        """The user that the operator's ServiceAccount is."""
        return account(self.namespace, self.operator)


CONFINED = Release("confined-understudy", "understudy-confined")
"""The chart for an operator of named namespaces, beside the one that all tests share."""


def _helm(helm: str, kubeconfig: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [helm, "--kubeconfig", str(kubeconfig), "--namespace", NAMESPACE, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


@pytest.fixture(scope="package")
def release(
    cluster: Cluster, helm: str, kubeconfig: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Release]:
    """The chart of this checkout, as an upgrade where it is installed; otherwise it is taken away again afterwards.

    Test processes that run side by side share it.
    """
    found = Release(NAME, NAMESPACE)
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent  # that of all of them
    with shared(
        folder,
        "release",
        lambda: _install(cluster, helm, kubeconfig, found),
        lambda before: _restore(cluster, helm, kubeconfig, found, before),
    ):
        yield found


@pytest.fixture(scope="package")
def image(pytestconfig: pytest.Config, kubeconfig: object) -> str:
    """An image with Python: UNDERSTUDY_TEST_IMAGE, or the operator's own, loaded where that can be done."""
    given = os.environ.get("UNDERSTUDY_TEST_IMAGE")
    if given:
        return given
    provider: str | None = pytestconfig.getoption("cluster")
    if provider == "current":
        return "python:3.12-slim"
    command = [str(REPOSITORY / "scripts" / "images"), "--load", "operator"]
    done = subprocess.run([*command, *(["--provider", provider] if provider else [])], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return "localhost/understudy-operator:dev"


@pytest.fixture(scope="package")
def world(cluster: Cluster, image: str) -> Iterator[World]:
    """The pods of the table of policies."""
    pods = table()
    unique = uuid.uuid4().hex[:6]
    world = World(cluster, {space: f"netpol-{unique}-{space}" for space in pods["namespaces"]}, image)
    ready = []
    for node in cluster.list("v1", "Node"):
        conditions = {c["type"]: c["status"] for c in node["status"]["conditions"]}
        if (
            conditions.get("Ready") == "True"
            and not node["spec"].get("unschedulable")
            and not node["spec"].get("taints")
        ):
            ready.append(node["metadata"]["labels"]["kubernetes.io/hostname"])
    assert ready, "the cluster has no node that pods may run on"
    world.nodes = ready
    created: list[Object] = []
    try:
        for space, labels in pods["namespaces"].items():
            metadata = {"name": world.spaces[space], "labels": labels}
            created.append(cluster.create({"apiVersion": "v1", "kind": "Namespace", "metadata": metadata}))
        for pod in pods["pods"]:
            world.start(pod["namespace"], pod["name"], pod["labels"], pod["node"], pod.get("ports", []))
        # Beside the table's, an instance on the other node: what is allowed to it hangs on another enforcer.
        world.start("fleet", "distant", {"app": "distant", "instance": "distant"}, 1, [])
        world.ready()
        yield world
    finally:
        for agent in world.agents.values():
            agent.close()
        for item in created:
            cluster.delete(item)


@pytest.fixture(scope="module")
def alone(cluster: Cluster, release: Release) -> Iterator[None]:
    """No other operator looks after the namespaces of these tests."""
    installed = cluster.find(APPS, "Deployment", release.operator, NAMESPACE)
    replicas = (installed or {}).get("spec", {}).get("replicas", 0)
    if not installed or not replicas:
        yield
        return
    cluster.patch(installed, {"spec": {"replicas": 0}}, subresource="scale")
    selector = ",".join(f"{k}={v}" for k, v in installed["spec"]["selector"]["matchLabels"].items())
    until(
        lambda: not cluster.list(CORE, "Pod", NAMESPACE, labels=selector),
        "the installed operator to be gone",
        seconds=60,
    )
    yield
    cluster.patch(installed, {"spec": {"replicas": replicas}}, subresource="scale")


@pytest.fixture
def fleet(alone: None, cluster: Cluster, namespace: str) -> Fleet:
    """A namespace without an operator."""
    return Fleet(cluster, namespace)


@pytest.fixture
def operator(fleet: Fleet) -> Iterator[Operator]:
    """An operator for the namespace."""
    with Operator(fleet.cluster.kubeconfig, fleet.namespace) as found:
        yield found


def _install(cluster: Cluster, helm: str, kubeconfig: Path, release: Release) -> Object:
    """Install the chart with an operator that rests; answers with what was there before."""
    chart = str(REPOSITORY / "charts" / "understudy")
    there = _helm(helm, kubeconfig, "status", NAME).returncode == 0
    values = ["--reset-then-reuse-values"] if there else ["--set", f"operator.replicas=0,{SET_IMAGES}"]
    # The operators and monitors of these tests run outside the cluster, with the rights of the tests or of another release.
    values += ["--set", "allNamespaces=true"]
    values += ["--set", f"admission.labelWriters={{{cluster.user},{CONFINED.user}}}"]
    done = _helm(
        helm, kubeconfig, "upgrade", "--install", NAME, chart, "--create-namespace", "--take-ownership", *values
    )
    assert done.returncode == 0, done.stderr
    for kind in KINDS:
        until(lambda kind=kind: _established(cluster, kind.plural), f"{kind.name} to be served")  # type: ignore[misc]
    # An operator that runs would look after the objects of these tests.
    deployment = _deployment(cluster, release)
    labels = ",".join(f"{key}={value}" for key, value in deployment["spec"]["selector"]["matchLabels"].items())
    cluster.patch(deployment, {"spec": {"replicas": 0}}, subresource="scale")
    until(
        lambda: not cluster.list("v1", "Pod", release.namespace, labels=labels),
        "the installed operator to be gone",
        seconds=60,
    )
    return {"there": there, "replicas": deployment["spec"]["replicas"]}


def _restore(cluster: Cluster, helm: str, kubeconfig: Path, release: Release, before: Object) -> None:
    if before["there"]:
        scale = {"spec": {"replicas": before["replicas"]}}
        cluster.patch(_deployment(cluster, release), scale, subresource="scale")
        return
    done = _helm(helm, kubeconfig, "uninstall", NAME, "--wait")
    assert done.returncode == 0, done.stderr
    leftovers = [_definition(cluster, kind.plural) for kind in KINDS]
    leftovers.append({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": NAMESPACE}})
    for item in leftovers:
        cluster.delete(item)
    # What is on its way out would be in the way of the next who installs.
    for item in leftovers:
        what = (item["apiVersion"], item["kind"], item["metadata"]["name"])
        until(lambda what=what: cluster.find(*what) is None, f"{what[2]} to be gone")  # type: ignore[misc]


def _deployment(cluster: Cluster, release: Release) -> Object:
    return cluster.get("apps/v1", "Deployment", release.operator, release.namespace)


def _definition(cluster: Cluster, plural: str) -> Object:
    return cluster.get("apiextensions.k8s.io/v1", "CustomResourceDefinition", f"{plural}.{GROUP}")


def _established(cluster: Cluster, plural: str) -> bool:
    conditions = _definition(cluster, plural).get("status", {}).get("conditions", [])
    return any(c["type"] == "Established" and c["status"] == "True" for c in conditions)

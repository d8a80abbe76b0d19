"""Those whom Understudy does not trust: a tenant, a pod without rights, a compromised monitor and a compromised standby."""

from __future__ import annotations

import subprocess
from collections.abc import AsyncIterator, Callable, Iterator

import pytest
import yaml

from tests.cluster import monitor_accounts
from tests.cluster.conftest import REPOSITORY, Release
from tests.cluster.monitor_accounts import allow, until_refused
from tests.cluster.operators import workload
from tests.support.chart import IMAGES
from tests.support.cluster import Cluster, Object
from understudy.api import names
from understudy.kube.client import Client
from understudy.kube.gates.base import GateKind
from understudy.kube.gates.registry import DEFAULT

KINDS: Object = {"apiGroups": [names.GROUP], "resources": ["*"], "verbs": ["*"]}
PODS: Object = {"apiGroups": [""], "resources": ["pods"], "verbs": ["create"]}


def refers(name: str = "nav2", kind: str = "Deployment", **spec: object) -> Object:
    """A RobotWorkload whose instances a controller of the user creates."""
    return workload(workloadRef={"kind": kind, "name": name}, **spec)


def user_with(cluster: Cluster, namespace: str, name: str, *rules: Object) -> str:
    """Return the name of a user with rights on the three kinds, and those of the rules."""
    allow(cluster, namespace, name, KINDS, *rules)
    until_refused(
        lambda: cluster.create(refers("no-such"), namespace, user=name, dry_run=True),
        "may not set spec.workloadRef",
        "the admission policy of authors to be enforced",
    )
    return name


@pytest.fixture
def tenant(cluster: Cluster, release: Release, namespace: str) -> str:
    """The name of a user with rights on the three kinds only."""
    return user_with(cluster, namespace, "tenant@example.com")


@pytest.fixture
def author(cluster: Cluster, release: Release, namespace: str) -> str:
    """The name of a user who may create pods, and has rights on the three kinds."""
    return user_with(cluster, namespace, "author@example.com", PODS)


@pytest.fixture
def gate(cluster: Cluster, release: Release, namespace: str) -> Object:
    """A gate, which is open for one instance."""
    return cluster.create(monitor_accounts.gate(), namespace)


@pytest.fixture
def kind() -> GateKind:
    """The kind of that gate."""
    return DEFAULT


@pytest.fixture
def compromised_monitor(cluster: Cluster, namespace: str, gate: Object, kind: GateKind) -> str:
    """The user name of the monitor of that gate, once the API server applies its rights and the admission policies."""
    user = monitor_accounts.create(cluster, namespace, monitor_accounts.MINE, kind=kind)
    until_refused(
        lambda: cluster.patch(gate, {"metadata": {"labels": {"effective": "no"}}}, user=user, dry_run=True),
        "of its gate only",
        "the admission policy of gates to be enforced",
    )
    return user


@pytest.fixture
async def correct_monitor(cluster: Cluster, namespace: str, compromised_monitor: str) -> AsyncIterator[Client]:
    """The API client of the same monitor, with a token of its account."""
    async with Client(monitor_accounts.access(cluster, namespace, monitor_accounts.MINE)) as client:
        yield client


@pytest.fixture
def author_policies(cluster: Cluster, release: Release, namespace: str, helm: str) -> Iterator[Callable[..., None]]:
    """A function that creates the policies for authors of another release, with these values of `admission`, for the namespace."""
    made: list[Object] = []

    def create(**admission: object) -> None:
        command = [helm, "template", f"for-{namespace}", str(REPOSITORY / "charts" / "understudy"), "--values", "-"]
        command += ["--kube-version", "1.34", "--show-only", "templates/admission-authoring.yaml"]
        values = yaml.safe_dump({"watchNamespaces": [namespace], "admission": admission, "images": IMAGES})
        rendered = subprocess.run(command, input=values, capture_output=True, text=True, timeout=60, check=True).stdout
        made.extend(cluster.create(item) for item in yaml.safe_load_all(rendered))

    yield create
    for item in made:
        cluster.delete(item)

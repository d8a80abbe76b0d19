"""An operator that has its rights in some namespaces only, as the chart gives them to it."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.cluster.conftest import CONFINED, REPOSITORY, Release
from tests.cluster.operators import Fleet, Operator, hot, policy, workload
from tests.support.chart import SET_IMAGES
from tests.support.cluster import Cluster, Object, Refused, until
from tests.support.golden import assert_golden
from tests.support.rights import as_lines, rights_of

RIGHTS = ("ServiceAccount", "ClusterRole", "ClusterRoleBinding", "Role", "RoleBinding")


@pytest.fixture
def confined(cluster: Cluster, helm: str, kubeconfig: Path, namespace: str, tmp_path: Path) -> Iterator[Path]:
    """The kubeconfig of an operator that the chart lets look after one namespace."""
    chart = str(REPOSITORY / "charts" / "understudy")
    settings = f"watchNamespaces={{{namespace}}},rbac.aggregate=false,{SET_IMAGES}"
    name, own = CONFINED.name, CONFINED.namespace
    command = [helm, "template", name, chart, "--namespace", own, "--kube-version", "1.34", "--set", settings]
    rendered = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    items: list[Object] = [i for i in yaml.safe_load_all(rendered) if i and i["kind"] in RIGHTS]
    items.insert(0, {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": own}})
    made = [cluster.create(item) for item in items]
    config = yaml.safe_load(kubeconfig.read_text())
    config["users"] = [
        {"name": "operator", "user": {"token": cluster.kubectl("create", "token", CONFINED.operator, "-n", own)}}
    ]
    config["contexts"][0]["context"]["user"] = "operator"
    config["current-context"] = config["contexts"][0]["name"]
    file = tmp_path / "kubeconfig"
    file.write_text(yaml.safe_dump(config))
    yield file
    for item in reversed(made):
        cluster.delete(item)
    # The test may run again.
    until(lambda: cluster.find("v1", "Namespace", own) is None, "the operator's namespace to be gone", seconds=60)


@pytest.mark.usefixtures("alone")
def test_an_operator_of_named_namespaces_sees_only_these(
    cluster: Cluster, release: Release, namespace: str, confined: Path
) -> None:
    fleet = Fleet(cluster, namespace)
    with Operator(confined, namespace, lease_namespace=CONFINED.namespace) as operator:
        fleet.create(policy("hot"), hot(), workload())
        fleet.wait_built()
        until(lambda: len(fleet.instances()) == 2, "a pod and a standby")
        assert operator.status is None, "it is at work still"
    user = CONFINED.user
    for place in (namespace, "default"):
        assert_golden("rights", as_lines(rights_of(cluster, place, user)))
    assert cluster.request("GET", cluster.path("v1", "Pod", namespace), user=user)["items"]
    for kind in ("Pod", "Secret", "ConfigMap"):
        with pytest.raises(Refused, match="cannot list resource"):
            cluster.request("GET", cluster.path("v1", kind, "default"), user=user)

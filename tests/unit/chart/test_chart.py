"""The chart as Helm renders it, and what it refuses.

In Python, and not as YAML for a plugin such as helm-unittest, since much of it is compared with what the code says: definitions, names,
rights. A real API server judges the objects in tests/cluster/test_chart.py.
"""

from __future__ import annotations

import json
import subprocess

import pytest
import yaml

from tests.unit.chart.conftest import CHART, Object, Render, Run, one
from understudy.api import names
from understudy.api.crds import definitions


@pytest.mark.parametrize("values", [(), ("--values", str(CHART / "production.yaml"))], ids=["as-it-is", "production"])
def test_lint_is_clean(helm: str, values: tuple[str, ...]) -> None:
    done = subprocess.run([helm, "lint", "--strict", str(CHART), *values], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout
    assert "[WARNING]" not in done.stdout
    assert "[ERROR]" not in done.stdout


def test_the_definitions_are_those_of_the_models_and_are_kept(render: Render) -> None:
    rendered = {item["metadata"]["name"]: item for item in render() if item["kind"] == "CustomResourceDefinition"}
    expected = {definition["metadata"]["name"]: definition for definition in definitions().values()}
    assert rendered.keys() == expected.keys()
    for name, definition in expected.items():
        assert rendered[name]["spec"] == definition["spec"]
        assert rendered[name]["metadata"]["annotations"] == {"helm.sh/resource-policy": "keep"}


def test_the_definitions_can_be_left_out_or_go_with_the_release(render: Render) -> None:
    assert not [item for item in render("crds.install=false") if item["kind"] == "CustomResourceDefinition"]
    going = [item for item in render("crds.keep=false") if item["kind"] == "CustomResourceDefinition"]
    assert len(going) == 3
    assert all("annotations" not in item["metadata"] for item in going)


def test_the_operator(render: Render) -> None:
    deployment = one(render(), "Deployment")
    assert deployment["spec"]["replicas"] == 2
    pod = deployment["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert container["args"] == ["operator"]
    assert container["image"] == "understudy/operator:0.1.0"
    environment = {entry["name"]: entry.get("value") or entry["valueFrom"] for entry in container["env"]}
    assert environment == {
        "UNDERSTUDY_MONITOR_IMAGE": "understudy/monitor:0.1.0",
        "UNDERSTUDY_IMAGE_PULL_POLICY": "IfNotPresent",
        "UNDERSTUDY_LOG_LEVEL": "info",
        "UNDERSTUDY_NAMESPACE": {"fieldRef": {"fieldPath": "metadata.namespace"}},
        "POD_NAME": {"fieldRef": {"fieldPath": "metadata.name"}},
    }
    assert container["ports"] == [{"name": "metrics", "containerPort": names.METRICS_PORT}]
    assert container["livenessProbe"]["httpGet"] == {"path": "/healthz", "port": "metrics"}
    assert container["readinessProbe"]["httpGet"] == {"path": "/ready", "port": "metrics"}
    assert (spread := pod["topologySpreadConstraints"][0])["topologyKey"] == "kubernetes.io/hostname"
    labels = deployment["spec"]["template"]["metadata"]["labels"]
    assert spread["labelSelector"]["matchLabels"].items() <= labels.items()
    assert deployment["spec"]["selector"]["matchLabels"].items() <= labels.items()


def test_the_operator_is_told_by_which_secrets_monitors_are_pulled(render: Render) -> None:
    secrets = ("images.monitorPullSecrets[0].name=registry", "images.monitorPullSecrets[1].name=other")
    (container,) = one(render(*secrets), "Deployment")["spec"]["template"]["spec"]["containers"]
    assert {"name": "UNDERSTUDY_IMAGE_PULL_SECRETS", "value": "registry,other"} in container["env"]


@pytest.mark.parametrize("kind", ["Deployment", "Pod"])
def test_its_pods_meet_the_restricted_pod_security_standard(render: Render, kind: str) -> None:
    found = one(render(tests=True), kind)["spec"]
    pod = found["template"]["spec"] if kind == "Deployment" else found
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    for container in pod["containers"]:
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
    assert not any(pod.get(key) for key in ("hostNetwork", "hostPID", "hostIPC"))


def test_values_reach_the_operator(render: Render) -> None:
    deployment = one(
        render(
            "images.operator.repository=registry.example:5000/a/operator",
            "images.operator.tag=v2",
            "images.monitor.tag=dev",
            "images.pullPolicy=Always",
            "images.pullSecrets[0].name=registry",
            "operator.logLevel=debug",
            "operator.env[0].name=EXTRA",
            "operator.env[0].value=x",
            "operator.podLabels.team=robots",
            "operator.podAnnotations.note=hi",
            "operator.nodeSelector.disk=ssd",
            "operator.tolerations[0].operator=Exists",
            "operator.priorityClassName=high",
            "operator.resources.limits.cpu=1",
        ),
        "Deployment",
    )
    template = deployment["spec"]["template"]
    pod, (container,) = template["spec"], template["spec"]["containers"]
    assert container["image"] == "registry.example:5000/a/operator:v2"
    assert container["imagePullPolicy"] == "Always"
    values = {entry["name"]: entry.get("value") for entry in container["env"]}
    assert values["UNDERSTUDY_MONITOR_IMAGE"] == "understudy/monitor:dev"
    assert (values["UNDERSTUDY_IMAGE_PULL_POLICY"], values["UNDERSTUDY_LOG_LEVEL"], values["EXTRA"]) == (
        "Always",
        "debug",
        "x",
    )
    assert container["resources"]["limits"] == {"cpu": 1, "memory": "512Mi"}
    assert template["metadata"]["labels"]["team"] == "robots"
    assert template["metadata"]["annotations"] == {"note": "hi"}
    assert pod["imagePullSecrets"] == [{"name": "registry"}]
    assert (pod["nodeSelector"], pod["priorityClassName"]) == ({"disk": "ssd"}, "high")
    assert pod["tolerations"] == [{"operator": "Exists"}]


def test_the_operator_is_told_the_priority_of_monitors(render: Render) -> None:
    deployment = one(render("monitors.priorityClassName=robots"), "Deployment")
    (container,) = deployment["spec"]["template"]["spec"]["containers"]
    assert {"name": "UNDERSTUDY_PRIORITY_CLASS", "value": "robots"} in container["env"]


def test_its_pods_are_spread_as_one_says(render: Render) -> None:
    constraint = "operator.topologySpreadConstraints[0]"
    zones = (
        f"{constraint}.maxSkew=1",
        f"{constraint}.topologyKey=zone",
        f"{constraint}.whenUnsatisfiable=DoNotSchedule",
    )

    def spread(*settings: str) -> list[Object]:
        found: list[Object] = one(render(*zones, *settings), "Deployment")["spec"]["template"]["spec"][
            "topologySpreadConstraints"
        ]
        return found

    [found] = spread()
    assert (found["topologyKey"], found["whenUnsatisfiable"]) == ("zone", "DoNotSchedule")
    assert found["labelSelector"]["matchLabels"]["app.kubernetes.io/component"] == "operator"
    [given] = spread(f"{constraint}.labelSelector.matchLabels.team=robots")
    assert given["labelSelector"] == {"matchLabels": {"team": "robots"}}
    none = one(render("operator.topologySpreadConstraints=null"), "Deployment")
    assert "topologySpreadConstraints" not in none["spec"]["template"]["spec"]


def test_in_named_namespaces_only_the_operator_has_its_rights_there_only(render: Render) -> None:
    everywhere = one(render(), "ClusterRole", "understudy-operator")["rules"]
    items = render("watchNamespaces={fleet-a,fleet-b}", "metrics.podMonitors.enabled=true")
    of_cluster = one(items, "ClusterRole", "understudy-operator")["rules"]
    assert {(resource, verb) for rule in of_cluster for resource in rule["resources"] for verb in rule["verbs"]} == {
        *(("nodes", verb) for verb in ("get", "list", "watch")),
        *(("customresourcedefinitions", verb) for verb in ("list", "watch")),
    }
    roles = [i for i in items if i["kind"] == "Role" and i["metadata"]["name"] == "understudy-operator-workloads"]
    assert [role["metadata"]["namespace"] for role in roles] == ["fleet-a", "fleet-b"]
    assert all([*role["rules"], *of_cluster] == everywhere for role in roles)
    bindings = [
        i for i in items if i["kind"] == "RoleBinding" and i["roleRef"]["name"] == "understudy-operator-workloads"
    ]
    assert [binding["metadata"]["namespace"] for binding in bindings] == ["fleet-a", "fleet-b"]
    account = {"kind": "ServiceAccount", "name": "understudy-operator", "namespace": "system"}
    assert all(binding["subjects"] == [account] for binding in bindings)
    (container,) = one(items, "Deployment")["spec"]["template"]["spec"]["containers"]
    assert {"name": "UNDERSTUDY_WATCH_NAMESPACES", "value": "fleet-a,fleet-b"} in container["env"]
    scraped = one(items, "PodMonitor", "understudy-monitors")["spec"]["namespaceSelector"]
    assert scraped == {"matchNames": ["fleet-a", "fleet-b"]}


def test_helm_test_runs_as_an_account_that_the_admission_policy_means(render: Render) -> None:
    items = render(tests=True)
    pod = one(items, "Pod")
    assert pod["spec"]["serviceAccountName"].endswith(names.MONITOR_ACCOUNT_ENDING)
    selected = one(items, "Deployment")["spec"]["selector"]["matchLabels"]
    assert not selected.items() <= pod["metadata"]["labels"].items(), "it isn't taken for a replica of the operator"
    (container,) = pod["spec"]["containers"]
    assert container["args"] == ["verify", "--operator=understudy-operator"]
    without = one(render("admission.enabled=false", tests=True), "Pod")["spec"]["containers"][0]
    assert without["args"][-1] == "--no-admission"


def test_a_drain_takes_one_replica_at_a_time(render: Render) -> None:
    budget = one(render(), "PodDisruptionBudget")
    assert budget["spec"]["maxUnavailable"] == 1
    labels = one(render(), "Deployment")["spec"]["template"]["metadata"]["labels"]
    assert budget["spec"]["selector"]["matchLabels"].items() <= labels.items()
    for setting in ("operator.replicas=1", "operator.disruptionBudget.enabled=false"):
        assert not [item for item in render(setting) if item["kind"] == "PodDisruptionBudget"]


def test_parts_can_be_left_to_others(render: Render) -> None:
    def kinds(setting: str) -> set[str]:
        items = render(setting, "rbac.aggregate=false")
        return {item["kind"] for item in items if not item["metadata"]["name"].startswith("understudy-test")}

    assert not {"ClusterRole", "ClusterRoleBinding", "Role", "RoleBinding"} & kinds("rbac.create=false")
    assert "ServiceAccount" not in kinds("serviceAccount.create=false")
    assert not {"ValidatingAdmissionPolicy", "ValidatingAdmissionPolicyBinding"} & kinds("admission.enabled=false")
    named = render("serviceAccount.create=false", "serviceAccount.name=mine")
    assert one(named, "Deployment")["spec"]["template"]["spec"]["serviceAccountName"] == "mine"
    assert one(named, "ClusterRoleBinding", "understudy-operator")["subjects"] == [
        {"kind": "ServiceAccount", "name": "mine", "namespace": "system"}
    ]


def test_the_release_names_its_objects(render: Render) -> None:
    items = render(release="r" * 53, tests=True)
    for item in items:
        if item["kind"] != "CustomResourceDefinition":
            assert len(item["metadata"]["name"]) <= 63
            assert item["metadata"]["name"].startswith("r" * 29 + "-understudy")
    assert (
        one(items, "ValidatingAdmissionPolicyBinding")["spec"]["policyName"]
        == (one(items, "ValidatingAdmissionPolicy")["metadata"]["name"])
    )


def test_the_admission_policy_means_the_names_that_the_code_means(render: Render) -> None:
    text = yaml.safe_dump(one(render(), "ValidatingAdmissionPolicy"), width=10_000)
    assert f"endsWith('{names.MONITOR_ACCOUNT_ENDING}')" in text.replace("''", "'")
    for label in (names.WORKLOAD, names.INSTANCE, names.HELD):
        assert f"labels[?'{label}']" in text.replace("''", "'")


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("replicas=3", "additional properties 'replicas' not allowed"),
        ("operator.replica=3", "at '/operator': additional properties 'replica' not allowed"),
        ("images.operator.image=x", "at '/images/operator': additional properties 'image' not allowed"),
        ("operator.replicas=two", "at '/operator/replicas': got string, want integer"),
        ("operator.replicas=-1", "at '/operator/replicas': minimum: got -1, want 0"),
        (
            "images.pullPolicy=Sometimes",
            "at '/images/pullPolicy': value must be one of 'Always', 'IfNotPresent', 'Never'",
        ),
        ("images.operator.repository=a:B", "at '/images/operator/repository': 'a:B' does not match pattern"),
        ("images.monitor.tag=a b", "at '/images/monitor/tag': 'a b' does not match pattern"),
        ("images.pullSecrets={registry}", "at '/images/pullSecrets/0': got string, want object"),
        ("operator.env[0].value=x", "at '/operator/env/0': missing property 'name'"),
        ("operator.logLevel=loud", "at '/operator/logLevel': value must be one of"),
        ("watchNamespaces=fleet", "at '/watchNamespaces': got string, want array"),
        ("watchNamespaces={Fleet}", "at '/watchNamespaces/0': 'Fleet' does not match pattern"),
        ("monitors.priority=x", "at '/monitors': additional properties 'priority' not allowed"),
        (
            "operator.topologySpreadConstraints[0].maxSkew=1",
            "at '/operator/topologySpreadConstraints/0': missing properties 'topologyKey', 'whenUnsatisfiable'",
        ),
        ("crds.install=maybe", "at '/crds/install': got string, want boolean"),
        ("admission.enabled=1", "at '/admission/enabled': got number, want boolean"),
        ("operator.podLabels.a=1", "at '/operator/podLabels/a': got number, want string"),
    ],
)
def test_bad_values_are_refused_by_name(run: Run, setting: str, message: str) -> None:
    done = run(setting)
    assert done.returncode != 0
    assert message in done.stderr


def test_an_old_kubernetes_is_refused(helm: str) -> None:
    command = [helm, "template", "understudy", str(CHART), "--kube-version", "1.29"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode != 0
    assert "requires kubeVersion: >=1.30" in done.stderr


def test_every_value_in_the_schema_is_in_the_values() -> None:
    schema = json.loads((CHART / "values.schema.json").read_text())
    values = yaml.safe_load((CHART / "values.yaml").read_text())

    def compare(properties: Object, found: Object, path: str) -> None:
        assert properties.keys() - {"global"} == found.keys(), path
        for name, child in properties.items():
            child = schema["definitions"][child["$ref"].rpartition("/")[2]] if "$ref" in child else child
            if "properties" in child and name not in ("resources",):
                compare(child["properties"], found[name], f"{path}.{name}")

    compare(schema["properties"], values, "")

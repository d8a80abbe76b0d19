"""Health trees in ConfigMaps: only those that are lent are read, and the last good one stays in force."""

from __future__ import annotations

from typing import Any

import pytest

from tests.unit.controller.world import NAMESPACE, TREE, policy, workload
from understudy.api import names
from understudy.api.kinds.failure_policy import FailurePolicySpec, in_force
from understudy.controller.observed import policy_reader
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.object_store import ObservedChange, Store
from understudy.controller.runtime import resync
from understudy.controller.status import policy_status
from understudy.kube.client import CONFIG_MAPS, POLICIES, WORKLOADS, Object

GOOD = "topic: {name: /cmd_vel, type: geometry_msgs/msg/Twist, gap: 500ms}"
BAD = "topic: {name: /cmd_vel, gap: 500 parsecs}"
XML = '<root BTCPP_format="4"><BehaviorTree ID="A"><Topic topic="/scan" gap="1s"/></BehaviorTree></root>'
OSC = 'import osc.understudy\nscenario healthy:\n    do topic("/scan", gap: 1s)\n'


def trees(*, name: str = "trees", label: str | None = "true", **data: str) -> dict[str, Object]:
    labels = {names.HEALTH_TREE: label} if label is not None else {}
    metadata = {"name": name, "namespace": NAMESPACE, "uid": f"uid-{name}", "labels": labels}
    keys = {key.replace("_", "."): text for key, text in data.items()}
    return {name: {"apiVersion": "v1", "kind": "ConfigMap", "metadata": metadata, "data": keys}}


def referring(key: str = "health.yaml", **more: Any) -> Object:
    found = policy("Restart")
    found["spec"]["monitoring"] = {"configMapKeyRef": {"name": "trees", "key": key}}
    return found | more


def status(found: Object, maps: dict[str, Object]) -> Object:
    return policy_status.status(found, pools={}, config_maps=maps, users=[])


def untimed(status: Object) -> list[Object]:
    """A status's conditions without the second in which they were made."""
    return [{**one, "lastTransitionTime": ""} for one in status["conditions"]]


def test_a_valid_tree_is_in_force() -> None:
    reported = status(referring(), trees(health_yaml=GOOD))
    assert reported["conditions"][0]["status"] == "True"
    assert reported["tree"] == {"name": "trees", "key": "health.yaml", "yaml": TREE}
    reported = status(referring("health.xml"), trees(health_xml=XML))
    assert reported["tree"] == {"name": "trees", "key": "health.xml", "xml": XML}
    reported = status(referring("health.osc"), trees(health_osc=OSC))
    assert reported["tree"] == {"name": "trees", "key": "health.osc", "osc": OSC}


@pytest.mark.parametrize(
    ("maps", "reason", "words"),
    [
        ({}, "TreeNotFound", 'no ConfigMap "trees" with the label understudy.dev/health-tree=true'),
        (trees(label=None, health_yaml=GOOD), "TreeNotFound", "kubectl label configmap -n fleet trees understudy.dev/health-tree=true"),
        (trees(label="yes", health_yaml=GOOD), "TreeNotFound", "no ConfigMap"),
        (trees(name="tree", health_yaml=GOOD), "TreeNotFound", 'did you mean "tree"?'),
        (trees(), "TreeNotFound", 'ConfigMap trees has no "health.yaml" in its data (it has none)'),
        (trees(healthy_yaml=GOOD), "TreeNotFound", 'did you mean "healthy.yaml"?'),
        (trees(health_yaml=BAD), "TreeInvalid", "ConfigMap trees, health.yaml, line 1, column 25: topic.gap: '500 parsecs'"),
    ],
)  # fmt: skip
def test_the_last_valid_tree_stays_in_force_if_the_present_one_is_missing_or_invalid(
    maps: dict[str, Object], reason: str, words: str
) -> None:
    fresh = status(referring(), maps)
    assert "tree" not in fresh
    _, accepted = fresh["conditions"]
    assert (accepted["status"], accepted["reason"]) == ("False", reason)
    assert words in accepted["message"]
    before = status(referring(), trees(health_yaml=GOOD))
    after = status(referring(status=before), maps)
    assert after["tree"] == before["tree"]
    assert untimed(after) == untimed(fresh)


def test_a_problem_with_the_tree_of_a_policy_is_reported_for_its_workloads() -> None:
    found = policy_reader.problem(referring(), {})
    assert found is not None
    assert found.reason == "TreeNotFound"
    assert policy_reader.problem(referring(), trees(health_yaml=GOOD)) is None


def test_a_tree_inside_the_policy_is_not_copied_to_the_status() -> None:
    before = status(referring(), trees(health_yaml=GOOD))
    assert "tree" not in status(policy("Restart") | {"status": before}, {})


def test_monitors_use_the_tree_in_force() -> None:
    found = referring()
    spec = FailurePolicySpec.model_validate(found["spec"])
    assert in_force(spec, None) is None
    assert in_force(spec, {"tree": {"name": "trees", "key": "health.yaml"}}) is None
    for key, form, maps, tree in (
        ("health.yaml", "yaml", trees(health_yaml=GOOD), TREE),
        ("health.xml", "xml", trees(health_xml=XML), XML),
    ):
        resolved = in_force(spec, status(referring(key), maps))
        assert resolved is not None
        assert (resolved.monitoring.form, resolved.monitoring.tree) == (form, tree)
        assert resolved.monitoring.startup_grace == spec.monitoring.startup_grace
    inline = FailurePolicySpec.model_validate(policy("Restart")["spec"])
    assert in_force(inline, None) is inline


def test_a_change_of_a_config_map_reconciles_its_policies_and_their_workloads() -> None:
    store = Store()
    store.put(POLICIES, referring())
    store.put(POLICIES, policy("Restart", name="other"))
    store.put(WORKLOADS, workload())
    (config_map,) = trees(health_yaml=GOOD).values()
    found = change_index.of(ObservedChange(CONFIG_MAPS, None, config_map), store).keys
    assert found == {Key(POLICIES.plural, NAMESPACE, "policy"), Key(WORKLOADS.plural, NAMESPACE, "w")}
    assert not change_index.of(
        ObservedChange(CONFIG_MAPS, None, {"metadata": {**config_map["metadata"], "name": "x"}}), store
    ).keys


def test_only_labelled_config_maps_are_stored() -> None:
    for label, kept in (("true", True), ("false", False), (None, False)):
        (config_map,) = trees(label=label).values()
        assert resync.kept(CONFIG_MAPS, config_map) is kept


@pytest.mark.parametrize(
    "text",
    ["parallel: 0x" + "f" * 5000, r'topic: {name: "\UFFFFFFFF"}', "%YAML 1." + "9" * 5000 + "\n--- {}"],
    ids=lambda text: text[:20],
)
def test_a_tree_with_a_hostile_value_is_reported_on_the_policy(text: str) -> None:
    """The reconcile of such a policy raised an error and was repeated for ever."""
    _, accepted = status(referring(), trees(health_yaml=text))["conditions"]
    assert (accepted["status"], accepted["reason"]) == ("False", "TreeInvalid")
    assert accepted["message"].startswith("ConfigMap trees, health.yaml, line 1, column ")

"""What the monitor goes by while somebody gives it what can't be followed."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest

from understudy.api import names
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups

GOOD = {"yaml": {"set_lifecycle": {"node": "/nav", "state": "active"}}}
BROKEN = {"yaml": {"set_lifecycle": {"node": "/nav", "state": "on"}}}


@pytest.fixture
def view() -> ClusterView:
    found = ClusterView(None, "n", "w", Wakeups())  # type: ignore[arg-type]
    found.workloads = SimpleNamespace(revision=0, items={})  # type: ignore[assignment]
    found.policies = SimpleNamespace(items={})  # type: ignore[assignment]
    return found


def give_workload(view: ClusterView, **more: Any) -> None:
    outputs = [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}]
    spec = {"template": {"spec": {}}, "outputs": outputs, "failurePolicyRef": {"name": "p"}, **more}
    view.workloads.items["w"] = {"metadata": {"name": "w"}, "spec": spec}  # type: ignore[index]
    view.workloads.revision += 1  # type: ignore[misc]


def give_policy(view: ClusterView, version: str, **strategy: Any) -> None:
    tree = {"topic": {"name": "/cmd_vel", "gap": "500ms"}}
    spec = {"monitoring": {"yaml": tree}, "strategies": [{"type": "Restart", **strategy}]}
    view.policies.items["p"] = {"metadata": {"name": "p", "uid": "u", "resourceVersion": version}, "spec": spec}  # type: ignore[index]


@pytest.mark.parametrize("broken", [{"bringUp": BROKEN}, {"outputs": "none"}])
def test_a_spec_that_can_not_be_followed_leaves_the_last_one_in_force(
    view: ClusterView, broken: dict[str, Any]
) -> None:
    give_workload(view, bringUp=GOOD)
    before = view.spec
    assert before is not None
    give_workload(view, **broken)
    assert view.spec == before
    give_workload(view)
    assert view.spec is not None
    assert view.spec.bring_up is None, "corrected"
    view.workloads.items.clear()  # type: ignore[attr-defined]
    view.workloads.revision += 1  # type: ignore[misc]
    assert view.spec is None


def test_a_pause_counts_also_where_the_rest_of_a_spec_can_not_be_followed(view: ClusterView) -> None:
    give_workload(view, bringUp=GOOD)
    assert view.spec is not None
    give_workload(view, bringUp=BROKEN, pause={"reason": "a new gripper", "owner": "ann"})
    assert view.spec.pause is not None
    assert view.spec.bring_up is not None
    assert view.spec.bring_up.yaml == GOOD["yaml"]


def test_settings_that_somebody_deletes_stay_in_force_until_the_operator_gives_them_again(view: ClusterView) -> None:
    settings = WorkloadSettings(workload="w", namespace="n", uid="u", source_kind="ReplicaSet", source_name="w")
    item = {"data": {"settings.json": settings.model_dump_json(by_alias=True)}}
    view.settings_maps = SimpleNamespace(revision=0, items={})  # type: ignore[assignment]
    assert view.settings is None
    view.settings_maps.items["w-settings"] = item  # type: ignore[index]
    view.settings_maps.revision = 1  # type: ignore[misc]
    assert view.settings == settings
    view.settings_maps.items.clear()  # type: ignore[attr-defined]
    view.settings_maps.revision = 2  # type: ignore[misc]
    assert view.settings == settings, "without them nothing can be recovered"


def test_a_recovery_that_does_not_load_leaves_the_last_policy_in_force(view: ClusterView) -> None:
    give_workload(view)
    give_policy(view, "1", recovery=GOOD)
    before = view.policy
    give_policy(view, "2", recovery=BROKEN)
    assert view.policy == before
    give_policy(view, "3")
    assert view.policy is not None
    assert view.policy.strategies[0].recovery is None, "corrected"


def test_a_new_monitor_watches_by_a_policy_with_a_recovery_that_does_not_load(view: ClusterView) -> None:
    give_workload(view)
    give_policy(view, "1", recovery=BROKEN)
    assert view.policy is not None


def test_a_tree_in_a_config_map_is_followed_as_the_operator_read_it(view: ClusterView) -> None:
    give_workload(view)
    give_policy(view, "1")
    before = view.policy
    give_policy(view, "2")
    item = view.policies.items["p"]
    item["spec"]["monitoring"] = {"configMapKeyRef": {"name": "trees", "key": "health.yaml"}}
    assert view.policy == before, "nothing was read yet"
    tree = {"topic": {"name": "/scan", "gap": "1s"}}
    item["metadata"]["resourceVersion"] = "3"
    item["status"] = {"tree": {"name": "trees", "key": "health.yaml", "yaml": tree}}
    assert view.policy is not None
    assert view.policy.monitoring.tree == tree


def test_a_bring_up_in_another_language_is_loaded_as_well(view: ClusterView) -> None:
    text = 'import osc.understudy\nscenario up:\n    do set_lifecycle("/nav", lifecycle_state!active)\n'
    give_workload(view, bringUp={"osc": text})
    before = view.spec
    assert before is not None
    give_workload(view, bringUp={"osc": text.replace("set_", "get_")})
    assert view.spec == before


AUTO = {"strategies": [{"type": "Auto"}], "requirements": {"availability": "High"}}


def give_auto(view: ClusterView, version: str) -> None:
    give_policy(view, version)
    view.policies.items["p"]["spec"] |= AUTO


def give_settings(view: ClusterView, *pools: str) -> None:
    """What the operator chose: a fallback from each of these pools, and a restart."""
    chosen = [*({"type": "Fallback", "poolRef": {"name": pool}} for pool in pools), {"type": "Restart"}]
    said = {"workload": "w", "namespace": "n", "uid": "u", "sourceKind": "ReplicaSet", "sourceName": "w"}
    text = json.dumps(said | {"strategies": chosen})
    revision = getattr(view.settings_maps, "revision", 0) + 1
    item = {"data": {"settings.json": text}}
    view.settings_maps = SimpleNamespace(revision=revision, items={names.settings("w"): item})  # type: ignore[assignment]


def pools(view: ClusterView) -> list[str]:
    assert view.policy is not None
    return [one.pool_ref.name for one in view.policy.strategies if one.pool_ref is not None]


def test_strategies_that_are_left_to_be_chosen_are_those_that_the_operator_chose(view: ClusterView) -> None:
    give_workload(view)
    give_auto(view, "1")
    assert view.policy is None, "nothing was chosen yet, and nothing was in force before"
    give_settings(view, "hot", "spare")
    assert pools(view) == ["hot", "spare"]
    assert view.policy is not None
    assert [one.type for one in view.policy.strategies] == ["Fallback", "Fallback", "Restart"]
    before = view.policy
    give_settings(view, "hot", "spare")
    assert view.policy is before, "told again"
    give_settings(view, "spare")
    assert pools(view) == ["spare"]


def test_until_others_are_chosen_the_last_strategies_are_in_force(view: ClusterView) -> None:
    give_workload(view)
    give_policy(view, "1", verifyWithin="9s")
    before = view.policy
    assert before is not None
    give_auto(view, "2")
    assert view.policy == before
    give_settings(view, "hot")
    assert pools(view) == ["hot"]
    give_policy(view, "3")
    assert pools(view) == [], "and written out again"

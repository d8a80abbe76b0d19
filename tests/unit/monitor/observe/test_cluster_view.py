"""What the monitor goes by while somebody gives it what can't be followed."""

from __future__ import annotations

from typing import Any

import pytest

from tests.unit.kube.memory import MemoryClient
from tests.unit.monitor.cluster_objects import settings_of, workload_spec
from understudy.api import names
from understudy.kube.client import CONFIG_MAPS, POLICIES, WORKLOADS, Object
from understudy.kube.watched_collection import Reflector
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups

GOOD = {"yaml": {"set_lifecycle": {"node": "/nav", "state": "active"}}}
BROKEN = {"yaml": {"set_lifecycle": {"node": "/nav", "state": "on"}}}


class GivenObjects:
    """The objects that people and the operator give, and what a monitor reads in them."""

    def __init__(self) -> None:
        self._client = MemoryClient()
        self.view = ClusterView(self._client, "n", "w", Wakeups())

    def workload(self, **more: Any) -> None:
        """Give a workload with these fields in its spec."""
        item: Object = {"metadata": {"name": "w"}, "spec": workload_spec(**more)}
        self.view.workloads.put(self._client.store(WORKLOADS, "n", item))

    def policy(self, spec: Object | None = None, *, tree: Object | None = None, **strategy: Any) -> None:
        """Give a policy with this spec, or with one restart; ``tree`` is the one that the operator read in a ConfigMap."""
        health = {"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}}
        spec = {"monitoring": health, "strategies": [{"type": "Restart", **strategy}]} | (spec or {})
        item: Object = {"metadata": {"name": "policy"}, "spec": spec, "status": {"tree": tree} if tree else {}}
        self.view.policies.put(self._client.store(POLICIES, "n", item))

    def settings(self, *pools: str) -> None:
        """Give what the operator chose: a fallback from each of these pools, and a restart."""
        chosen = [*({"type": "Fallback", "poolRef": {"name": pool}} for pool in pools), {"type": "Restart"}]
        text = settings_of(strategies=chosen).model_dump_json(by_alias=True)
        item: Object = {"metadata": {"name": names.settings("w")}, "data": {"settings.json": text}}
        self.view.settings_maps.put(self._client.store(CONFIG_MAPS, "n", item))

    def taken_away(self, reflector: Reflector) -> None:
        """Take away what was given, as a watch reports it."""
        for item in list(reflector.items.values()):
            reflector.apply_event("DELETED", item)

    @property
    def pools(self) -> list[str]:
        """The pools of the strategies in force."""
        assert self.view.policy is not None
        return [one.pool_ref.name for one in self.view.policy.strategies if one.pool_ref is not None]


@pytest.fixture
def objects() -> GivenObjects:
    return GivenObjects()


@pytest.fixture
def view(objects: GivenObjects) -> ClusterView:
    return objects.view


@pytest.mark.parametrize("broken", [{"bringUp": BROKEN}, {"outputs": "none"}])
def test_an_invalid_spec_leaves_the_last_one_in_force(
    objects: GivenObjects, view: ClusterView, broken: dict[str, Any]
) -> None:
    objects.workload(bringUp=GOOD)
    before = view.spec
    assert before is not None
    objects.workload(**broken)
    assert view.spec == before
    objects.workload()
    assert view.spec is not None
    assert view.spec.bring_up is None, "corrected"
    objects.taken_away(view.workloads)
    assert view.spec is None


def test_a_pause_applies_even_if_the_rest_of_the_spec_is_invalid(objects: GivenObjects, view: ClusterView) -> None:
    objects.workload(bringUp=GOOD)
    assert view.spec is not None
    objects.workload(bringUp=BROKEN, pause={"reason": "a new gripper", "owner": "ann"})
    assert view.spec.pause is not None
    assert view.spec.bring_up is not None
    assert view.spec.bring_up.yaml == GOOD["yaml"]


def test_deleted_settings_stay_in_force(objects: GivenObjects, view: ClusterView) -> None:
    assert view.settings is None
    objects.settings("hot")
    settings = view.settings
    assert settings is not None
    objects.taken_away(view.settings_maps)
    assert view.settings == settings, "without them nothing can be recovered"


def test_an_invalid_recovery_procedure_leaves_the_last_policy_in_force(
    objects: GivenObjects, view: ClusterView
) -> None:
    objects.workload()
    objects.policy(recovery=GOOD)
    before = view.policy
    objects.policy(recovery=BROKEN)
    assert view.policy == before
    objects.policy()
    assert view.policy is not None
    assert view.policy.strategies[0].recovery is None, "corrected"


def test_a_new_monitor_uses_the_health_tree_of_a_policy_with_an_invalid_recovery_procedure(
    objects: GivenObjects, view: ClusterView
) -> None:
    objects.workload()
    objects.policy(recovery=BROKEN)
    assert view.policy is not None


def test_a_tree_in_a_config_map_is_used_as_the_operator_read_it(objects: GivenObjects, view: ClusterView) -> None:
    objects.workload()
    objects.policy()
    before = view.policy
    in_config_map = {"monitoring": {"configMapKeyRef": {"name": "trees", "key": "health.yaml"}}}
    objects.policy(in_config_map)
    assert view.policy == before, "nothing was read yet"
    tree = {"topic": {"name": "/scan", "gap": "1s"}}
    objects.policy(in_config_map, tree={"name": "trees", "key": "health.yaml", "yaml": tree})
    assert view.policy is not None
    assert view.policy.monitoring.tree == tree


def test_a_bring_up_in_another_language_is_loaded(objects: GivenObjects, view: ClusterView) -> None:
    text = 'import osc.understudy\nscenario up:\n    do set_lifecycle("/nav", lifecycle_state!active)\n'
    objects.workload(bringUp={"osc": text})
    before = view.spec
    assert before is not None
    objects.workload(bringUp={"osc": text.replace("set_", "get_")})
    assert view.spec == before


AUTO = {"strategies": [{"type": "Auto"}], "requirements": {"availability": "High"}}


def test_automatic_strategies_are_those_that_the_operator_chose(objects: GivenObjects, view: ClusterView) -> None:
    objects.workload()
    objects.policy(AUTO)
    assert view.policy is None, "nothing was chosen yet, and nothing was in force before"
    objects.settings("hot", "spare")
    assert objects.pools == ["hot", "spare"]
    assert view.policy is not None
    assert [one.type for one in view.policy.strategies] == ["Fallback", "Fallback", "Restart"]
    before = view.policy
    objects.settings("hot", "spare")
    assert view.policy is before, "told again"
    objects.settings("spare")
    assert objects.pools == ["spare"]


def test_the_last_strategies_stay_in_force_until_others_are_chosen(objects: GivenObjects, view: ClusterView) -> None:
    objects.workload()
    objects.policy(verifyWithin="9s")
    before = view.policy
    assert before is not None
    objects.policy(AUTO)
    assert view.policy == before
    objects.settings("hot")
    assert objects.pools == ["hot"]
    objects.policy()
    assert objects.pools == [], "and written out again"

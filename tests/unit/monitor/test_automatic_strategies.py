"""From a policy that says what it requires to the instance that takes over: the operator chooses, the monitor goes by it."""

from __future__ import annotations

from tests.unit.controller import world as cluster
from tests.unit.controller.strategy_policies import auto, warm
from tests.unit.failover.world import Store, World
from tests.unit.kube.memory import MemoryClient
from understudy.api import names
from understudy.failover.interfaces import GateState
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.protocol import recover
from understudy.failover.strategies.base import Choice
from understudy.failover.strategies.registry import choices
from understudy.kube.client import Object
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups


def followed(policy: Object) -> list[Choice]:
    """What a monitor would try, told by an operator what was chosen."""
    made = cluster.World(cluster.workload(), policy, cluster.hot(), warm(), cluster.spare())
    made.own(cluster.gate(made.workload))
    made.held_policies = {"spare": {"metadata": {"annotations": {names.TEMPLATE_HASH: "h"}}}}
    settings = cluster.applied(made.plan(), "configmaps")[names.settings("w")]
    view = ClusterView(MemoryClient(), cluster.NAMESPACE, "w", Wakeups())
    view.workloads.put(made.workload)
    view.policies.put(policy)
    view.settings_maps.put(settings)
    assert view.policy is not None
    assert view.settings is not None
    return choices(view.policy, view.settings, view.spec)


def test_the_monitor_uses_the_chosen_strategies_in_their_order_and_time() -> None:
    found = followed(auto(verify_within="7s"))
    assert [(one.strategy.name, one.verify_within) for one in found] == [
        ("Fallback/Initialized", 7.0),
        ("Fallback/Uninitialized", 7.0),
        ("Restart", 7.0),
    ]
    assert [one.strategy.name for one in followed(auto(availability="Low", resourceUsage="Low"))] == [
        "Fallback/Uninitialized",
        "Restart",
    ]


async def test_a_failure_is_recovered_with_the_chosen_strategies_in_their_order() -> None:
    store = Store()
    store.add("w-1")
    store.add("w-2", pool="hot")
    store.add("s-1", pool="spare", held=True)
    store.gate = GateState(epoch=1, active="w-1", active_uid="uid-w-1")
    store.broken |= {"w-1", "w-2"}
    world = World(store)
    now = world.clock()
    failure = Progress.begin(
        "gone", last_healthy=now - 0.5, detected=now, failed=[PodIdentity(name="w-1", uid="uid-w-1")]
    )
    done = await recover(failure, followed(auto(verify_within="300ms", taskCriticality="High")), world.context())
    assert [(one.strategy, one.result) for one in done.attempts] == [
        ("Fallback/Executing", "NotVerified"),
        ("Fallback/Initialized", "NotAvailable"),
        ("Fallback/Uninitialized", "Verified"),
    ]

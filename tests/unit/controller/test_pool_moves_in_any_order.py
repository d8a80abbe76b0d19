"""A shared pool over a cluster that it sees late, whose nodes come and go: never too many pods, and in the end just enough."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from random import Random

import pytest

from tests.unit.controller.pools import observe, present
from tests.unit.controller.world import IMAGES, Names, created, deleted, held_pod, spare
from understudy.controller.observed import kube_objects
from understudy.controller.plan import Plan
from understudy.controller.pods import pool_pods
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.expectations import Expectations
from understudy.kube.client import Object

NODES = ("a", "b", "c")
KEY = Key("fallbackpools", "fleet", "spare")
WANT = 3


class Cluster:
    """Pods on nodes, and an operator that sees of them what was so a while ago."""

    def __init__(self, seed: int) -> None:
        self.draw, self.pool, self._names = Random(seed), spare(replicas=WANT), Names()
        self._hash = present(self.pool)
        self.pods: dict[str, Object] = {}
        self.leaving: set[str] = set()
        self._observed: deque[list[Object]] = deque([[]], maxlen=4)
        self.now = 0.0
        self._expectations = Expectations(clock=lambda: self.now)
        self._known: set[str] = set()
        """Pods that were seen at any time."""

    def operate(self) -> None:
        """One look at some earlier state, with the nodes as they are; what was asked for and not seen counts."""
        view = self.draw.choice(self._observed)
        self._known |= {kube_objects.name(pod) for pod in view}
        # A store doesn't go back: what it knows to be gone, or to be there, stays so.
        view = [pod for pod in view if kube_objects.name(pod) in self.pods]
        expected = self._expectations.count(KEY, "spare", observed=self._known.__contains__)
        unseen = [
            self.pods[name] for name in self._known if name in self.pods and name not in map(kube_objects.name, view)
        ]
        observed = replace(observe(self.pool, [*view, *unseen], expected=expected), leaving=frozenset(self.leaving))
        plan: Plan = pool_pods.plan(observed, pool_pods.evaluate(observed, IMAGES), self._names.fresh())
        for body in created(plan, "pods"):
            name = kube_objects.name(body)
            staying = [node for node in NODES if node not in self.leaving] or [""]
            pod = held_pod(name, of=self.pool, template_hash=self._hash, ready=False)
            self.pods[name] = pod | {"spec": {"nodeName": self.draw.choice(staying)}}
            self._expectations.expect(KEY, "spare", name)
        for name in deleted(plan):
            self.pods.pop(name, None)
        self._observed.append(list(self.pods.values()))

    def happen(self) -> None:
        """Something goes on in the cluster."""
        match self.draw.randrange(5):
            case 0 if len(self.leaving) < 2:
                self.leaving.add(self.draw.choice(NODES))
            case 1 if self.leaving:
                self.leaving.discard(self.draw.choice(sorted(self.leaving)))
            case 2 if self.pods:  # it is evicted, or claimed
                self.pods.pop(self.draw.choice(sorted(self.pods)))
            case _:
                self.become_ready()
        self._observed.append(list(self.pods.values()))

    def become_ready(self) -> None:
        for name, pod in self.pods.items():
            if self.draw.random() < 0.5:
                made = held_pod(name, of=self.pool, template_hash=self._hash, age=100.0)
                self.pods[name] = made | {"spec": pod["spec"]}


@pytest.mark.parametrize("seed", range(60))
def test_a_pool_never_has_too_many_pods_and_finally_the_right_number_on_healthy_nodes(seed: int) -> None:
    cluster = Cluster(seed)
    for _ in range(60):
        cluster.operate()
        assert len(cluster.pods) <= 2 * WANT, "no more than one in place of each"
        cluster.happen()
        cluster.now += 2
    for _ in range(30):
        cluster.become_ready()
        cluster.operate()
        cluster.now += 5  # pods that went before they were seen aren't expected for ever
    assert len(cluster.pods) == WANT
    assert not [pod for pod in cluster.pods.values() if pod["spec"]["nodeName"] in cluster.leaving]

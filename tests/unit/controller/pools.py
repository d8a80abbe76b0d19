"""Shared pools as the operator sees and plans them, for tests."""

from __future__ import annotations

from collections.abc import Sequence

from tests.unit.controller.world import (
    IMAGES,
    NOW,
    Names,
)
from understudy.controller.observed import kube_objects
from understudy.controller.plan import Plan
from understudy.controller.pods import instance_pod, pool_pods
from understudy.controller.status import pool_status
from understudy.failover.pool_queue import Waiter
from understudy.kube.client import Object


def observe(
    pool: Object,
    pods: Sequence[Object] = (),
    *,
    workloads: Sequence[Object] = (),
    expected: int = 0,
    now: float = NOW,
    active: frozenset[str] = frozenset(),
    owned: dict[tuple[str, str], Object] | None = None,
    source: Object | None = None,
    source_selector: Object | None = None,
    waiting: Sequence[Waiter] = (),
) -> pool_pods.Observed:
    return pool_pods.Observed(
        pool=pool,
        workloads={kube_objects.name(item): item for item in workloads},
        pods=pods,
        owned=owned or {},
        now=now,
        expected=expected,
        active=active,
        source=source,
        source_selector=source_selector,
        waiting=waiting,
    )


def plan(observed: pool_pods.Observed) -> Plan:
    return pool_pods.plan(observed, pool_pods.evaluate(observed, IMAGES), Names().fresh())


def present(pool: Object) -> str:
    built = pool_pods.evaluate(observe(pool), IMAGES).built
    assert built is not None
    return instance_pod.template_hash(built)


def status(observed: pool_pods.Observed) -> Object:
    return pool_status.status(observed, pool_pods.evaluate(observed, IMAGES), [])


def condition(observed: pool_pods.Observed, type_: str) -> Object:
    found: Object = next(c for c in status(observed)["conditions"] if c["type"] == type_)
    return found

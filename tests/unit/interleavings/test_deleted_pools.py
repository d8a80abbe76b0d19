"""A shared pool is deleted, permanently or to be created again, while pods are claimed from it and other failures happen.

Also just after an upgrade. Whoever drives a robot can be commanded by the next monitor: the token of its agent is there, and may be read.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from tests.unit.interleavings import simulation
from tests.unit.interleavings.actors import NAMESPACE
from tests.unit.interleavings.invariants import Invariants, _claimed, _labels, _living
from tests.unit.interleavings.scenes import SCENES, Outcome, Scene
from tests.unit.interleavings.simulation import Simulation
from tests.unit.interleavings.troubles import TROUBLES
from understudy.api import names
from understudy.controller.desired import monitor_deployment
from understudy.controller.observed import kube_objects, ownership
from understudy.controller.plan import Create
from understudy.controller.pods import claim_tokens
from understudy.kube import claims
from understudy.kube.apply import controller_of
from understudy.kube.client import Object

FIRST, RUNS = 600_000, 24

POOL = (NAMESPACE, "spare")
SECRET = (NAMESPACE, names.pool_secret("spare"))
COLLECTED = ("secrets", "networkpolicies", "poddisruptionbudgets", "pods")
SHARED, SCARCE = SCENES[:2]
CAUSES = {cause: often for cause, often in TROUBLES.items() if cause != "pool_is_resized"}  # there may be none


class Unbounded(Invariants):
    """Free pods of a deleted pool exist beside those of the pool that was created again, until they are collected."""

    def _created(self, pod: Object, by: str) -> None:
        return


class Deleting(Simulation):
    """A run in which somebody deletes the pool, and may create it again."""

    causes = CAUSES

    def __init__(self, *arguments: Any, **more: Any) -> None:
        self.counts: Counter[str] = Counter()
        """How often a pool was deleted, with how many claimed pods, and how often its Secret changed."""
        self._number = 0
        super().__init__(*arguments, **more)

    def _make_invariants(self) -> Invariants:
        return Unbounded(self.server, self.robots, broken=self._broken, leads=self._leads)

    def _take_up(self) -> None:
        """Every other run begins with what 0.1.0 has made: a Secret that is its pool's."""
        pool, secret = self.server.get("fallbackpools", POOL), self.server.get("secrets", SECRET)
        if self._calm or self.outcome.seed % 4 < 2 or pool is None or secret is None:
            return
        bare = {**secret, "metadata": {key: secret["metadata"][key] for key in ("name", "uid", "resourceVersion")}}
        owned = ownership.ours(bare, kube_objects.owner("FallbackPool", pool), pool)
        self.server.write("secrets", SECRET, owned, "an operator of 0.1.0")

    def _plan_trouble(self) -> float:
        lasts = super()._plan_trouble()
        # When everybody reaches for a pod is when it matters most.
        at = 1 + self.choices.random() * lasts
        for moment in (at - self.choices.random(), at + 3):
            self.later(moment, self._all_fail)
        self.later(at, self._pool_is_deleted)
        return lasts + 4

    def _pool_is_deleted(self) -> None:
        item = self.server.get("fallbackpools", POOL)
        if item is None:
            return
        self.note("the pool is deleted by somebody")
        self.counts["deleted"] += 1
        self.counts["claimed"] += len(self._commanded())
        self.server.write("fallbackpools", POOL, None, "somebody")
        for plural in COLLECTED:
            for place, found in sorted(self.server.items[plural].items()):
                self._collect(plural, place, found)
        if self.choices.random() < 0.5:
            self.later(self.choices.random() * 6, self._pool_is_made, item)

    def _pool_is_made(self, item: Object) -> None:
        self._number += 1
        metadata = {**item["metadata"], "uid": f"uid-spare-{self._number}", "generation": 1}
        self.note("the pool is made anew by somebody")
        self.server.write("fallbackpools", POOL, {**item, "metadata": metadata, "status": {}}, "somebody")

    def _collect(self, plural: str, place: tuple[str, str], item: Object) -> None:
        """Have the garbage collector look at an object, in a while."""
        owner = controller_of(item)
        if owner is not None and owner["kind"] == "FallbackPool" and not self._is_there(owner):
            self.later(self.choices.random() * 4, self._collected, plural, place, owner["uid"])

    def _is_there(self, owner: Object) -> bool:
        pool = self.server.get("fallbackpools", POOL)
        return pool is not None and bool(pool["metadata"]["uid"] == owner["uid"])

    def _collected(self, plural: str, place: tuple[str, str], uid: str) -> None:
        """It deletes what is still owned by what is gone, and nothing else."""
        item = self.server.get(plural, place)
        owner = controller_of(item) if item is not None else None
        if item is None or owner is None or owner["uid"] != uid or self._is_there(owner):
            return
        if plural == "pods":
            self.robots.delete(item, by="the garbage collector")
        else:
            self.server.write(plural, place, None, "the garbage collector")

    def _written(self, plural: str, old: Object | None, new: Object | None, by: str) -> None:
        super()._written(plural, old, new, by)
        if new is not None and plural in COLLECTED:
            place = (NAMESPACE, new["metadata"]["name"])
            self._collect(plural, place, new)
        if plural == "secrets" and (item := new or old) is not None and item["metadata"]["name"] == SECRET[1]:
            self.counts["made" if old is None else "gone" if new is None else "changed"] += 1
            if old is not None and new is None:
                for pod in self._commanded():
                    self._broken(f"{by} deletes the token of {pod['metadata']['name']}, which is claimed")
        if plural == "roles" and old is not None and new is not None:
            for pod in self._commanded():
                if new["metadata"]["name"] == names.monitor(claims.workload_of(_labels(pod))) and "spare" not in (
                    monitor_deployment.commanded(new)
                ):
                    self._broken(f"{by} takes away the right to command {pod['metadata']['name']}")

    def _commanded(self) -> list[Object]:
        """The pods that were claimed from the pool and may be in control."""
        found = [pod for _, pod in sorted(self.server.items["pods"].items())]
        return [pod for pod in found if _claimed(pod) and _labels(pod).get(names.POOL) == POOL[1] and _living(pod)]

    def _mistaken(self) -> Iterator[str]:
        yield from super()._mistaken()
        secret, claimed = self.server.get("secrets", SECRET), self._commanded()
        there = self.server.get("fallbackpools", POOL) is not None
        if (secret is not None) is not (there or bool(claimed)):
            yield f"the Secret is {'there' if secret else 'gone'}, the pool {'too' if there else 'is not'}, {len(claimed)} pods are claimed"
        if secret is not None and secret["metadata"].get("ownerReferences"):
            yield "the Secret is somebody's"
        for pod in claimed:
            workload = claims.workload_of(_labels(pod))
            if "spare" not in monitor_deployment.commanded(
                self.server.get("roles", (NAMESPACE, names.monitor(workload)))
            ):
                yield f"the monitor of {workload} may not command {pod['metadata']['name']}"


def run(seed: int, *, tracing: bool = False, scene: Scene | None = None) -> tuple[Outcome, Counter[str]]:
    """Returns the run of a seed, and the result of its pool's deletion."""
    scene = scene or (SHARED, SCARCE)[seed % 2]
    base = simulation.prepared(scene, Deleting)
    with tempfile.TemporaryDirectory() as folder:
        made = Deleting(scene, seed, base, Path(folder), tracing=tracing)
        try:
            return made.run(), made.counts
        finally:
            made.dispose()


def test_the_active_instance_can_be_commanded_after_its_pool_was_deleted() -> None:
    counts: Counter[str] = Counter()
    for seed in range(FIRST, FIRST + RUNS):
        outcome, found = run(seed)
        assert not outcome.faults, str(run(seed, tracing=True)[0])
        counts += found
    assert counts["deleted"] == RUNS, "it isn't about nothing"
    assert counts["claimed"]
    assert counts["gone"], "nobody needed it any more"


# -- the simulation finds faults ------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _prepared() -> None:
    """What runs begin from is made by code without faults."""
    for scene in (SHARED, SCARCE):
        simulation.prepared(scene, Deleting)


def found(words: str, within: int = 100, first: int = 0) -> None:
    """There is a run in which nothing but failures and the network get in the way, and something of these words doesn't hold.

    ``first`` is a seed that found it when it was written, so that the test takes no longer than it has to.
    """
    scene = replace(SHARED, troubles=("all_fail",), weather=(3.0,))
    for seed in range(first, first + within):
        if any(words in fault for fault in run(seed, scene=scene)[0].faults):
            return
    pytest.fail(f"no {words!r} in {within} runs")


@pytest.mark.parametrize(("words", "first"), [("deletes the token", 26), ("takes away the right", 20)])
def test_the_simulation_detects_an_operator_that_ignores_unobserved_claims(words: str, first: int) -> None:
    with mock.patch.object(claim_tokens, "claimable", return_value=False):
        found(words, first=first)


def test_the_simulation_detects_a_secret_that_its_pool_owns() -> None:
    def owned(body: Object, namespace: str) -> Object:
        owner = {"apiVersion": "understudy.dev/v1alpha1", "kind": "FallbackPool", "name": "spare", "uid": "uid-spare"}
        return ownership.ours(body, {**owner, "controller": True}, {"metadata": {"namespace": namespace}})

    def keep(pool: str, namespace: str, live: Object | None, token: Any, *, keyed: bool) -> list[Any]:
        if live is not None and controller_of(live) is None:  # as the cluster has it from the start
            return [claim_tokens.Patch(claim_tokens.SECRETS, live, {"metadata": owned(live, namespace)["metadata"]})]
        made = ownership.agent_secret(names.pool_secret(pool), token, keyed=keyed)
        return [] if live is not None else [Create(claim_tokens.SECRETS, owned(made, namespace))]

    with mock.patch.object(claim_tokens, "keep", keep):
        found("deletes the token")

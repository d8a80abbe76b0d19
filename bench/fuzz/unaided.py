"""Gives generated objects to the functions of the operator and of a monitor, in this process.

It needs no cluster, and finds most faults at the lowest cost. What the API server would refuse is decoded and checked by its
schema, and goes no further.
"""

from __future__ import annotations

import json
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError

from bench.fuzz.samples import Sample
from tests.unit.controller import world
from understudy.api import moments, names
from understudy.api.kinds import switchover_spec
from understudy.api.kinds.failure_policy import FailurePolicySpec, in_force
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.schema.definitions import root
from understudy.api.schema.printed_kinds import KINDS
from understudy.cli.manifests import object_check
from understudy.cli.manifests.check_findings import Place
from understudy.cli.manifests.manifest_reader import Manifest
from understudy.cli.manifests.schema_validation import UnknownField, validate
from understudy.controller.observed import committed_recovery, policy_reader, tree_verdicts
from understudy.controller.pods import pool_pods
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.object_store import ObservedChange, Store
from understudy.controller.status import policy_status, pool_status
from understudy.failover import pinned
from understudy.kube.client import CONFIG_MAPS, POLICIES, POOLS, WORKLOADS, Object, Resource
from understudy.kube.decoding import bounded, decode
from understudy.kube.gates.base import GateRecord
from understudy.monitor.observe.objects import long_trees
from understudy.monitor.observe.objects.cluster_view import unloadable
from understudy.trees.core.health_tree import HealthTree
from understudy.trees.core.observations import RecordedObservations
from understudy.trees.core.snapshots import snapshot
from understudy.trees.languages.notations import load_inline, load_monitoring
from understudy.trees.languages.tree_check import TreeText, Verdict, check
from understudy.trees.source.problems import TreeError

MOST_SECONDS = 0.1
"""Processor time that one function may keep an event loop busy."""

MOST_FOR_A_TREE = 3.0
"""Processor time that the operator gives the process that checks a tree."""

MOST_FOR_A_COMMAND = 20.0
"""Processor time of a command of the user, who can end it."""

RESOURCES: dict[str, Resource] = {
    "RobotWorkload": WORKLOADS, "FailurePolicy": POLICIES, "FallbackPool": POOLS, "ConfigMap": CONFIG_MAPS,
}  # fmt: skip

EXPECTED = (TreeError, ValidationError)
"""Errors with which functions refuse a content. Their callers catch them."""


@dataclass
class Trial:
    """The result of one object in this process."""

    sample: Sample
    refused: bool = False
    """Whether the API server would refuse it by its schema."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Processor time of each step."""
    faults: list[str] = field(default_factory=list)

    def step(self, name: str, work: Callable[[], Any], *, most: float = MOST_SECONDS) -> Any:
        """Do one step, and note an error that nobody would catch, and too much time."""
        found, spent = self._measured(name, work)
        if spent > most:  # not if it was a collection of this process' garbage
            spent = min(spent, self._measured(name, work)[1])
        self.seconds[name] = max(spent, self.seconds.get(name, 0.0))
        if spent > most:
            self.faults.append(f"{name}: {spent:.2f} s of processor time")
        return found

    def _measured(self, name: str, work: Callable[[], Any]) -> tuple[Any, float]:
        begun = time.thread_time()
        try:
            return work(), time.thread_time() - begun
        except EXPECTED:
            return None, time.thread_time() - begun
        except Exception as error:
            frame = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{frame.filename.rpartition('/operator/')[2]}:{frame.lineno}"
            self.faults.append(f"{name}: {type(error).__name__} at {place}: {error!s:.200}")
            return None, time.thread_time() - begun


def tried(sample: Sample) -> Trial:
    """Return the result of an object."""
    trial = Trial(sample)
    trial.step("line of a watch", lambda: bounded(sample.text))
    item = trial.step("decode", lambda: decode(sample.text.encode()))
    if not isinstance(item, dict) or not isinstance(item.get("metadata"), dict):
        trial.refused = True
        return trial
    stored = {"namespace": world.NAMESPACE, "uid": "uid-fuzz", "generation": 2, "resourceVersion": "9"}
    item["metadata"] = {**item["metadata"], **stored, "name": sample.name}
    trial.refused = not _has_texts(item["metadata"].get("labels")) or not _has_texts(
        item["metadata"].get("annotations")
    )
    if sample.kind == "ConfigMap":
        trial.refused |= not _has_texts(item.get("data"))
        if not trial.refused:
            _config_map(trial, item)
        return trial
    manifest = Manifest("fuzz.yaml", item, {"": Place(1, 1)})
    trial.step("understudy check", lambda: object_check.check(manifest), most=MOST_FOR_A_COMMAND)
    schema = root(_KINDS[sample.kind])["properties"]["spec"]
    problems = trial.step("schema", lambda: validate(item.get("spec"), schema, "spec"), most=MOST_FOR_A_COMMAND)
    trial.refused |= problems is None or any(not isinstance(problem, UnknownField) for problem in problems)
    if not trial.refused:
        _annotations(trial, item)
        {"RobotWorkload": _workload, "FailurePolicy": _policy, "FallbackPool": _pool}[sample.kind](trial, item)
    return trial


_KINDS = {kind.name: kind for kind in KINDS}


def _has_texts(value: Any) -> bool:
    return value is None or (isinstance(value, dict) and all(isinstance(one, str) for one in value.values()))


class _Verdicts:
    """Checks the trees that functions ask for, and counts the time apart: the operator has another process do that."""

    def __init__(self, trial: Trial) -> None:
        self._trial = trial
        self._known: dict[bytes, Verdict] = {}
        self._missing: TreeText | None = None

    def of(self, name: str, work: Callable[[], Any]) -> Any:
        """Do a step again until each of its trees was checked."""
        while True:
            self._missing = None
            found = self._trial.step(name, lambda: self._once(work))
            if self._missing is None:
                return found
            tree = self._missing
            verdict = self._trial.step("check of a tree", lambda: check(tree), most=MOST_FOR_A_TREE)  # noqa: B023
            if verdict is None:
                return None
            self._known[tree.digest] = verdict

    def _once(self, work: Callable[[], Any]) -> Any:
        try:
            with tree_verdicts.looked_up(lambda tree: self._known.get(tree.digest)):
                return work()
        except tree_verdicts.Unjudged as missing:
            self._missing = missing.tree
            return None


def _stored(trial: Trial, item: Object) -> Store:
    """Put an object into the operator's store, and find what is affected."""
    resource, store = RESOURCES[item["kind"]], Store()
    trial.step("store", lambda: store.put(resource, item))
    found = store.get(resource, world.NAMESPACE, item["metadata"]["name"])
    trial.step("affected objects", lambda: change_index.of(ObservedChange(resource, None, found), store))
    return store


def _annotations(trial: Trial, item: Object) -> None:
    """Read the annotations of an object where the operator and monitors read those of Understudy's own."""
    found = item["metadata"].get("annotations") or {}
    for text in found.values():
        trial.step("request", lambda text=text: _parsed(text))
        trial.step("moment", lambda text=text: moments.unix(text))
        trial.step("pods that were let through", lambda text=text: pinned.read(text))
        gate = {
            "metadata": {
                "annotations": dict.fromkeys((names.RECOVERY, names.EPOCH, names.FENCED), text),
                "resourceVersion": "1",
            }
        }
        trial.step("recovery at a gate", lambda gate=gate: committed_recovery.beside(gate))
        trial.step("record of a gate", lambda gate=gate: GateRecord.of(gate))


def _parsed(text: str) -> None:
    try:
        switchover_spec.parse(text)
    except ValueError:  # which the monitor reports
        return


def _workload(trial: Trial, item: Object) -> None:
    _stored(trial, item)
    name = item["spec"]["failurePolicyRef"]["name"]
    around = world.World(item, world.policy("hot", "Restart", name=name), world.hot(), pods=[world.source_pod("w-1")])
    gate = world.gate(item)
    gate["metadata"]["annotations"] |= item["metadata"].get("annotations") or {}
    around.own(gate)
    verdicts = _Verdicts(trial)
    for _ in range(2):
        verdicts.of("plan of a workload", around.build)
        status = verdicts.of("status of a workload", around.status)
        trial.step("status as JSON", lambda status=status: json.dumps(status))
        item["status"] = status or {}
    if long_trees.unaccepted(item):
        return  # a monitor does not read it
    spec = trial.step("spec in the monitor", lambda: RobotWorkloadSpec.model_validate(item["spec"]))
    if spec is not None:
        procedures = long_trees.procedures_of(spec)
        _read_ahead(trial, procedures)
        trial.step("procedures in the monitor", lambda: unloadable(procedures))


def _read_ahead(trial: Trial, trees: long_trees.Trees) -> None:
    """Do what a monitor does in another thread."""
    trial.step("trees ahead", lambda: long_trees.read(trees), most=tree_verdicts.MOST_SECONDS)


def _policy(trial: Trial, item: Object, config_maps: Mapping[str, Object] | None = None) -> None:
    _stored(trial, item)
    verdicts, maps = _Verdicts(trial), config_maps or {}
    status = verdicts.of(
        "status of a policy",
        lambda: policy_status.status(item, pools={"hot": world.hot()}, config_maps=maps, users=["w"]),
    )
    trial.step("status as JSON", lambda: json.dumps(status))
    item["status"] = status or {}
    around = world.World(world.workload(failurePolicyRef={"name": trial.sample.name}), item, world.hot(), world.spare())
    around.pods = [world.source_pod("w-1")]
    for _ in range(2):
        verdicts.of("plan of a workload", around.build)
        around.workload["status"] = verdicts.of("status of a workload", around.status) or {}
    if long_trees.unaccepted(item):
        return  # a monitor does not read it
    trial.step(
        "policy in the monitor", lambda: in_force(FailurePolicySpec.model_validate(item["spec"]), item.get("status"))
    )
    spec = trial.step("policy in the monitor", lambda: in_force(policy_reader.spec(item), item.get("status")))
    if spec is None:
        return
    _read_ahead(trial, long_trees.of_policy(spec))
    trial.step("procedures in the monitor", lambda: unloadable(spec.recoveries))
    trees = [trial.step("health tree in the monitor", lambda: load_monitoring(spec.monitoring))]
    inline = [one.when for one in spec.situations if one.when.languages]
    trees += [
        trial.step("situation in the monitor", lambda one=one: load_inline(one, path="when", grace=0.0))
        for one in inline
    ]
    if spec.degraded is not None:
        monitoring = spec.degraded.monitoring
        trees.append(
            trial.step("degraded tree in the monitor", lambda: load_inline(monitoring, path="degraded", grace=1.0))
        )
    for tree in trees:
        if tree is not None:
            trial.step("evaluation", lambda tree=tree: _evaluated(tree))


def _evaluated(tree: HealthTree) -> None:
    tree.begin(0.0)
    for now in (0.0, 0.1, 5.0, 1e9):
        tree.evaluate(RecordedObservations({}), now=now, since=0.0)
        tree.deadline(RecordedObservations({}), now=now, since=0.0)
    snapshot(tree, RecordedObservations({}), 0.0)


def _pool(trial: Trial, item: Object) -> None:
    _stored(trial, item)
    verdicts, item_workload = _Verdicts(trial), world.workload()
    source = (item["spec"].get("templateFrom") or {}).get("workload", "w")
    observed = pool_pods.Observed(
        pool=item, workloads=dict.fromkeys(("w", source), item_workload), pods=[], owned={}, now=world.NOW,
        source=item_workload["spec"]["template"],
    )  # fmt: skip

    def planned() -> Object:
        plan = pool_pods.evaluate(observed, world.IMAGES)
        pool_pods.plan(observed, plan, world.Names().fresh())
        return pool_status.status(observed, plan, [])

    status = verdicts.of("plan and status of a pool", planned)
    trial.step("status as JSON", lambda: json.dumps(status))
    around = world.World(item_workload, world.policy(trial.sample.name), item, pods=[world.source_pod("w-1")])
    verdicts.of("plan of a workload", around.build)
    verdicts.of("status of a workload", around.status)


def _config_map(trial: Trial, item: Object) -> None:
    store = _stored(trial, item)
    known = store.in_namespace(CONFIG_MAPS, world.NAMESPACE) or {trial.sample.name: item}
    for key in ("a.yaml", "b.xml", "c.osc"):
        policy = world.policy("hot")
        policy["spec"]["monitoring"] = {"configMapKeyRef": {"name": trial.sample.name, "key": key}}
        _policy(trial, policy, known)

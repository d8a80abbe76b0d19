"""The workloads that must not notice anything, and the one whose monitor is given generated content."""

from __future__ import annotations

import copy
import json
import threading
import time
from dataclasses import dataclass, field
from typing import Any

from bench.fuzz.samples import Sample
from bench.fuzz.sending import MERGE, PATCH, Api, Sender, verdict
from bench.fuzz.values import LIVE
from tests.e2e.kubectl import Failed, Kubectl, Object
from tests.e2e.scenario import Late, Robot, manifest, patient
from understudy.api import names
from understudy.kube.client import NETWORK_POLICIES, PODS
from understudy.kube.decoding import decode

BETWEEN = 12.0
"""Seconds between two failures of the robots."""

RESTORED_WITHIN = 90.0
"""Seconds within which the workload with generated content must be healthy and protected after its own objects are back."""

GAP = "1s"
"""Silence that the robots' policies treat as a failure."""

KEPT = ("template", "workloadRef", "failurePolicyRef", "outputs", "ros", "gate", "monitor")
"""Fields of that workload that stay, since another value of them replaces its pods or its monitor."""


@dataclass
class Failures:
    """Measured recoveries of one robot."""

    recovery: list[float] = field(default_factory=list)
    gap: list[float] = field(default_factory=list)
    unprotected: list[float] = field(default_factory=list)
    """Times at which the workload was not protected, although it had not failed."""
    problems: list[str] = field(default_factory=list)


def fail(robot: Robot, found: Failures) -> None:
    """Let an application fail, and add its recovery and the gap that the robot saw, in seconds."""
    try:
        pod = robot.wait_protected(within=60)
        earlier = robot.status().get("recoveryCount", 0)
        robot.fail(pod, "killed")
        recovery = robot.wait_unobserved(earlier + 1, within=60)
        time.sleep(1.0)
        handover = robot.log(tail=2000).handover(recovery.old, recovery.new, switch=recovery.moments["decided"])
    except (Failed, Late, AssertionError, KeyError) as error:
        found.problems.append(f"{robot.workload}: {str(error)[:300]}")
        return
    if recovery.seconds is not None and handover.gap is not None:
        found.recovery.append(recovery.seconds)
        found.gap.append(handover.gap)


def protection() -> list[Object]:
    """Return the policy and pool of the robots. An application that pauses on a busy machine is not taken for a failed one."""
    return patient(manifest("strategies/executing.yaml"), GAP)


def renamed(objects: list[Object], old: str, new: str) -> list[Object]:
    """Return objects with another name for a policy and its pool."""
    found: list[Object] = json.loads(json.dumps(objects).replace(old, new))
    return found


class Victims(threading.Thread):
    """Lets robots fail in turn until it is stopped."""

    def __init__(self, robots: dict[str, Robot]) -> None:
        super().__init__(daemon=True)
        self.found = {name: Failures() for name in robots}
        self._robots, self._ended = robots, threading.Event()
        self._failed_at = dict.fromkeys(robots, 0.0)
        self._restored = set(robots)
        """The robots that were protected since their last failure. Until then, the next standby is starting."""

    def run(self) -> None:
        """Let them fail in turn."""
        turn = 0
        while not self._ended.is_set():
            name = list(self._robots)[turn % len(self._robots)]
            turn += 1
            self._restored.discard(name)
            fail(self._robots[name], self.found[name])
            self._failed_at[name] = time.time()
            rested = time.time() + BETWEEN
            while time.time() < rested and not self._ended.wait(1.0):
                self._look()

    def _look(self) -> None:
        for name, robot in self._robots.items():
            try:
                protected = robot.condition("Protected").get("status") == "True"
            except Failed:
                continue
            if time.time() - self._failed_at[name] <= BETWEEN:
                continue
            if protected:
                self._restored.add(name)
            elif name in self._restored:
                self.found[name].unprotected.append(time.time())

    def stop(self) -> None:
        """End after the failure in progress."""
        self._ended.set()
        self.join(timeout=120)


def protected_in(kubectl: Kubectl, name: str) -> float:
    """Return the seconds from the objects of a small workload to its protection; it is removed afterwards."""
    robot = Robot(kubectl, name)
    objects = robot.objects(policy="fresh-restart", labels={"app": "fresh"})
    kubectl.apply(renamed(manifest("strategies/restart.yaml"), "quickstart-restart", "fresh-restart"))
    begun = time.monotonic()
    kubectl.apply(objects)
    try:
        robot.wait_protected(within=180)
        return time.monotonic() - begun
    finally:
        kubectl("delete", "robotworkload", robot.workload, "--wait=false")
        for item in objects:
            kubectl("delete", item["kind"], item["metadata"]["name"], "--wait=false", "--ignore-not-found")


class Live:
    """A running workload whose policy, pool, ConfigMap, spec and annotations are replaced by generated ones."""

    POLICY = "live-executing"
    TREES = "live-trees"

    def __init__(self, api: Api, sender: Sender, kubectl: Kubectl) -> None:
        self._api, self._sender, self._kubectl = api, sender, kubectl
        self.robot = Robot(kubectl, LIVE.removesuffix("-drive"))
        self._good: dict[tuple[str, str], str] = {}
        self.restored: list[float] = []
        self.changes = 0

    def set_up(self) -> None:
        """Create the workload, and wait until it is protected."""
        tree: Any = None
        for item in renamed(protection(), "quickstart-executing", self.POLICY):
            if item["kind"] == "FallbackPool":
                item["spec"]["workloadSelector"] = {"matchLabels": {"app": "live"}}
            else:
                tree = item["spec"]["monitoring"]["yaml"]
            self._kubectl.apply([item])
        data = {key: json.dumps(tree) for key in ("a.yaml", "b.xml", "c.osc")}
        labels = {names.HEALTH_TREE: "true"}
        self._kubectl.apply(
            [
                {
                    "apiVersion": "v1",
                    "kind": "ConfigMap",
                    "metadata": {"name": self.TREES, "labels": labels},
                    "data": data,
                }
            ]
        )
        self._kubectl.apply(self.robot.objects(policy=self.POLICY, labels={"app": "live"}))
        self.robot.wait_protected(within=240)
        for kind, name in (("FailurePolicy", self.POLICY), ("FallbackPool", self.POLICY), ("RobotWorkload", LIVE)):
            self._good[kind, name] = json.dumps(self._kubectl.get(kind.lower(), name)["spec"])

    def change(self, sample: Sample) -> int:
        """Give the content of a sample to the workload's objects, and return the API server's answer."""
        self.changes += 1
        if sample.kind == "ConfigMap":
            key = ("a.yaml", "b.xml", "c.osc")[sample.seed % 3]
            status = self._replace("ConfigMap", self.TREES, "data", sample.part("data"))
            reference = json.dumps({"configMapKeyRef": {"name": self.TREES, "key": key}})
            self._replace("FailurePolicy", self.POLICY, "spec/monitoring", reference)
            return status
        self._annotate(sample)
        if sample.kind != "RobotWorkload":
            return self._replace(sample.kind, self.POLICY, "spec", sample.part("spec"))
        spec = json.loads(self._good["RobotWorkload", LIVE])
        drawn = (decode(sample.text) or {}).get("spec")
        fresh = {key: value for key, value in drawn.items() if key not in KEPT} if isinstance(drawn, dict) else {}
        return self._replace("RobotWorkload", LIVE, "spec", json.dumps({**spec, **fresh}))

    def _replace(self, kind: str, name: str, field: str, text: str) -> int:
        patch = f'[{{"op":"replace","path":"/{field}","value":{text or "{}"}}}]'
        return self._api.send("PATCH", self._sender.path(kind, name), patch, PATCH)[0]

    def _annotate(self, sample: Sample) -> None:
        """Write the annotations of a sample to the workload, its gate and its pods; admission policies refuse most of that."""
        metadata = (decode(sample.text) or {}).get("metadata")
        found = metadata.get("annotations") if isinstance(metadata, dict) else None
        if not found:
            return
        body, namespace = json.dumps({"metadata": {"annotations": found}}), self._kubectl.namespace
        pods = [pod["metadata"]["name"] for pod in self.robot.pods()[:2]]
        paths = [self._sender.path("RobotWorkload", LIVE), NETWORK_POLICIES.path(namespace, names.gate(LIVE))]
        for path in [*paths, *(PODS.path(namespace, pod) for pod in pods)]:
            self._api.send("PATCH", path, body, MERGE)

    def restore(self) -> str:
        """Put the workload's own objects back, and wait until it is protected. Returns the problem if it is not; or empty."""
        begun = time.monotonic()
        for (kind, name), spec in self._good.items():
            self._replace(kind, name, "spec", spec)
        resumed = {
            "metadata": {
                "annotations": {
                    names.RESUMED: time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
                    names.SWITCHOVER: None,
                }
            }
        }
        self._api.send("PATCH", self._sender.path("RobotWorkload", LIVE), json.dumps(resumed), MERGE)
        try:
            self._wait(begun)
        except (Failed, Late) as error:
            return str(error)[:600]
        self.restored.append(time.monotonic() - begun)
        return ""

    def _wait(self, begun: float) -> None:
        while True:
            item = self.robot.get()
            status = item.get("status") or {}
            protected = any(c["type"] == "Protected" and c["status"] == "True" for c in status.get("conditions") or [])
            # A generated pool may serve it too, whose pods the bench refuses. Then it is protected and not accepted.
            if verdict(item) and status.get("health") == "Healthy" and protected:
                return
            if time.monotonic() - begun > RESTORED_WITHIN:
                raise Late(
                    f"{LIVE} is not protected {RESTORED_WITHIN:g} s after its objects are back: {json.dumps(status)[:500]}"
                )
            time.sleep(0.5)


def originals() -> dict[str, dict[str, Any]]:
    """Return valid objects of each kind, for those that exist all the time."""
    policy = next(item for item in manifest("strategies/restart.yaml") if item["kind"] == "FailurePolicy")
    pool = next(item for item in manifest("strategies/executing.yaml") if item["kind"] == "FallbackPool")
    [workload] = manifest("robotworkload.yaml")
    found = {"FailurePolicy": policy, "FallbackPool": pool, "RobotWorkload": workload}
    found = {kind: copy.deepcopy(item) for kind, item in found.items()}
    for item in found.values():
        item["metadata"] = {"labels": {"fuzz": "fuzz"}}
    found["FallbackPool"]["spec"]["workloadSelector"] = {"matchLabels": {"fuzz": "fuzz"}}
    found["RobotWorkload"]["spec"]["failurePolicyRef"] = {"name": "fz-failurepolicy-0"}
    labels = {names.HEALTH_TREE: "true"}
    return {
        **found,
        "ConfigMap": {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"labels": labels}, "data": {"a.yaml": ""}},
    }

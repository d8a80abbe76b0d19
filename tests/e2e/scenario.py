"""A robot that is driven by a protected application, in a namespace of its own, and what can go wrong with it.

Everything is applied with kubectl from the quickstart's manifests, and what happened is read from the robot's own log.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml
from understudy_demo import robotview
from understudy_demo.recovery import Recovered
from understudy_demo.robotview import RobotLog

from tests.e2e.kubectl import Failed, Kubectl, Object, is_ready
from understudy.api import names

MANIFESTS = Path(__file__).parents[2] / "examples" / "quickstart" / "manifests"
APPLICATION = "understudy_quickstart.application"
CONTAINER = "drive"

SIGNAL = """
for process in /proc/[0-9]*; do
  tr "\\0" " " <"$process/cmdline" 2>/dev/null | grep -q "^[^ ]*python3 .*$2" || continue
  kill "-$1" "${process#/proc/}" && found=1
done
[ "$found" = 1 ] || { echo "no process of $2 here" >&2; exit 1; }
"""
"""Sends a signal to the application's process: a pod of the quickstart shares its process namespace."""

UNREADY = "/tmp/unready"
"""A file in the application's container. With the readiness probe, a pod that has it is not ready, and its application goes on."""

READINESS_PROBE: Object = {
    "exec": {"command": ["sh", "-c", f"! test -e {UNREADY}"]},
    "periodSeconds": 1,
    "timeoutSeconds": 5,
    "failureThreshold": 1,
}
"""The readiness probe of the application's container, for the failure ``unready``."""


def manifest(name: str) -> list[Object]:
    """The objects of one of the quickstart's files."""
    return [item for item in yaml.safe_load_all((MANIFESTS / name).read_text()) if item]


def patient(objects: list[Object], gap: str = "2s") -> list[Object]:
    """The objects with policies that take no output for missing that is only late: on a machine that is busy with other things
    an application may pause for a second, and where one failure is looked at, there should be no other.
    """
    for item in objects:
        if item["kind"] == "FailurePolicy":
            for leaf in item["spec"]["monitoring"]["yaml"]["parallel"]:
                leaf["topic"]["gap"] = gap
    return objects


def only_mux(workload: str) -> Object:
    """The Deployment of the quickstart's robot with nothing but the mux of a workload."""
    text = yaml.safe_dump(manifest("mux/robot.yaml")[0]).replace("robot-1-drive", workload)
    item: Object = yaml.safe_load(text.replace("robot-1", f"{workload}-robot"))
    pod = item["spec"]["template"]["spec"]
    pod["containers"] = [one for one in pod["containers"] if one["name"] == "mux"]
    return item


class Late(AssertionError):
    """Something didn't come in time."""


class Never(AssertionError):
    """What may never be, however busy the machine is. Any other test that fails is run once more; one that ends so isn't."""


def never(found: object, what: str) -> None:
    """Such as a command of a pod that isn't in control: fails with what was found, where there is anything."""
    if found:
        raise Never(f"{what}: {found!r}"[:2000])


def eventually(
    check: Callable[[], Any], *, within: float, what: str, every: float = 0.25, note: Callable[[], str] = str
) -> Any:
    """The first truthy answer of a check; an assertion with the last state where none comes in time (seconds)."""
    end = time.monotonic() + within
    problem = ""
    while True:
        try:
            if answer := check():
                return answer
            problem = ""
        except (Failed, KeyError, IndexError) as error:
            problem = f": {error!r}"
        if time.monotonic() >= end:
            raise Late(f"not within {within:g} s: {what}{problem}. {note()}")
        time.sleep(every)


class Robot:
    """One robot, its application and their protection."""

    def __init__(self, kubectl: Kubectl, name: str = "robot-1", gate_kind: str = "NetworkPolicy") -> None:
        self.kubectl, self.name, self.gate_kind = kubectl, name, gate_kind
        self.workload = f"{name}-drive"
        self._begun, self._recovered_before = 0.0, 0

    # -- setting up -------------------------------------------------------------------------------------------------

    def objects(
        self,
        *,
        policy: str,
        labels: dict[str, str] | None = None,
        edit: Callable[[Object], None] | None = None,
        workload: str = "robotworkload.yaml",
        folder: str = "",
    ) -> list[Object]:
        """The robot's and its workload's manifests under this robot's name; ``folder`` is that of both, if it is another one."""
        robot = "mux/robot.yaml" if self.gate_kind == "Mux" else f"{folder}robot.yaml"
        found = copy.deepcopy(manifest(robot) + manifest(f"{folder}{workload}"))
        text = yaml.safe_dump_all(found).replace("robot-1", self.name)
        found = list(yaml.safe_load_all(text))
        item = next(item for item in found if item["kind"] == "RobotWorkload")
        item["metadata"]["labels"] = labels or {"app": "quickstart"}
        item["spec"]["failurePolicyRef"] = {"name": policy}
        if edit:
            edit(item)
        if self.gate_kind == "Mux":
            item["spec"].setdefault("gate", {})["kind"] = "Mux"
        return found

    def wait_driven(self, within: float = 120.0) -> str:
        """Wait until an instance is in control, healthy, and the robot receives its commands; the pod's name."""

        def driven() -> str | None:
            status = self.status()
            if status.get("health") != "Healthy" or not status.get("active"):
                return None
            active: str = status["active"]
            return active if any(c.received > time.time() - 2 for c in self.log(tail=60).of(active)) else None

        pod: str = eventually(driven, within=within, what=f"{self.name} is driven", every=0.5, note=self.describe)
        return pod

    def wait_protected(self, within: float = 120.0) -> str:
        """Wait until it's driven and its first strategy's resources are available. Returns the active pod."""
        pod = self.wait_driven(within)
        eventually(
            lambda: self.condition("Protected").get("status") == "True",
            within=within,
            what=f"{self.name} is protected",
            note=self.describe,
        )
        return pod

    def wait_standby(self, within: float = 90.0) -> None:
        """Wait until a standby is ready and the monitor counts on it."""

        def standing_by() -> bool:
            status = self.status()
            ready = [
                pod["metadata"]["name"]
                for pod in self.pods()
                if not pod["metadata"].get("deletionTimestamp")
                and any(c["type"] == "Ready" and c["status"] == "True" for c in pod["status"].get("conditions") or [])
            ]
            others = [name for name in ready if name != status.get("active")]
            return bool(others) and status.get("strategy") == "Executing"

        eventually(standing_by, within=within, what=f"{self.name} has an understudy", note=self.describe)
        time.sleep(2.5)  # the monitor updates what is not urgent once a second

    def begin(self) -> None:
        """Forget what happened so far: the log begins now, and the next recovery is number 1 of this test.

        For tests that share a robot.
        """
        self._begun = time.time()
        self._recovered_before = self.status().get("recoveryCount", 0)

    # -- looking ----------------------------------------------------------------------------------------------------

    def get(self) -> Object:
        """The RobotWorkload."""
        return self.kubectl.get("robotworkload", self.workload)

    def status(self) -> Object:
        """Its status."""
        status: Object = self.get().get("status") or {}
        return status

    def condition(self, type_: str) -> Object:
        """One of its conditions; empty where it isn't there."""
        conditions: list[Object] = self.status().get("conditions") or []
        return next((c for c in conditions if c["type"] == type_), {})

    def recoveries(self) -> list[Recovered]:
        """Its recoveries, oldest first."""
        found = [Recovered.read(entry) for entry in reversed(self.status().get("recoveries") or [])]
        before = self._recovered_before
        return [replace(one, number=one.number - before) for one in found if one.number > before]

    def record(self, number: int) -> Object:
        """Its n-th recovery as it stands in the status."""
        number += self._recovered_before
        found: Object = next(entry for entry in self.status()["recoveries"] if entry["number"] == number)
        return found

    def wait_unobserved(self, number: int, within: float, *, first: float = 1.0) -> Recovered:
        """Wait for its n-th recovery, and ask nothing for the first seconds and then only once.

        For measurements: each kubectl takes a processor for a tenth of a second, and the nodes may share it.
        """
        time.sleep(first)
        awaited = f"--for=jsonpath={{.status.recoveryCount}}={self._recovered_before + number}"
        with suppress(Failed):  # the state after it counts
            self.kubectl(
                "wait", f"robotworkload/{self.workload}", awaited, f"--timeout={within:g}s", timeout=2 * within
            )
        return self.wait_recovered(number, within)

    def wait_recovered(self, number: int, within: float = 90.0) -> Recovered:
        """Wait for its n-th recovery."""

        def found() -> Recovered | None:
            return next((r for r in self.recoveries() if r.number == number and r.result == "Recovered"), None)

        recovery: Recovered = eventually(
            found, within=within, what=f"recovery {number} of {self.name}", note=self.describe
        )
        return recovery

    def pods(self) -> list[Object]:
        """Its instances."""
        own = self.kubectl.list("pods", f"{names.WORKLOAD}={self.workload}")
        return own + self.kubectl.list("pods", f"{names.CLAIMED_BY}={self.workload}")

    def has_pod(self, name: str) -> bool:
        """Whether a pod's object is there."""
        return self.kubectl.find("pod", name) is not None

    def monitor_pods(self) -> list[Object]:
        """The pods of the monitor: one, and for a moment also the one it replaces."""
        selector = f"understudy.dev/monitored={self.workload},understudy.dev/component=monitor"
        return self.kubectl.list("pods", selector)

    def monitor_restarts(self) -> int:
        """How often the container of the monitor was restarted in its pod."""
        return sum(s["restartCount"] for p in self.monitor_pods() for s in p["status"].get("containerStatuses") or [])

    def replace_monitor(self) -> None:
        """Delete the monitor's pod and wait for the next one."""
        before = {p["metadata"]["uid"] for p in self.monitor_pods()}
        self.kubectl("delete", "pod", "--wait=true", *(p["metadata"]["name"] for p in self.monitor_pods()))

        def ready() -> bool:
            return any(
                p["metadata"]["uid"] not in before
                and all(s["ready"] for s in p["status"].get("containerStatuses") or [{"ready": False}])
                for p in self.monitor_pods()
            )

        eventually(ready, within=60, what="the next monitor is ready", note=self.describe)

    def robot_pod(self) -> str:
        """The pod of the robot itself."""
        name: str = self.kubectl.list("pods", f"app={self.name}")[0]["metadata"]["name"]
        return name

    def log(self, tail: int = 0) -> RobotLog:
        """What the robot wrote down of every command."""
        script = f"tail -n {tail} /var/log/robot/robot.jsonl" if tail else "cat /var/log/robot/robot.jsonl"
        return robotview.parse(self.kubectl.shell(self.robot_pod(), "robot", script)).between(self._begun, math.inf)

    def describe(self) -> str:
        """What a person would look at next, for failure messages."""
        lines, unready = [], []
        with suppress(Failed):
            unready = [pod["metadata"]["name"] for pod in self.pods() if not is_ready(pod)]
        for arguments in (
            ("get", "pods", "-o", "wide"),
            ("get", "robotworkload", self.workload, "-o", "yaml"),
            ("get", "events", "--sort-by=.lastTimestamp"),
            ("logs", f"deployment/{self.workload}-monitor", "--tail=40"),
            *(("logs", pod, "--all-containers", "--prefix", "--tail=60") for pod in unready),
        ):
            try:
                lines.append(self.kubectl(*arguments))
            except Failed as error:
                lines.append(str(error))
        return "\n".join(lines)

    # -- failing ----------------------------------------------------------------------------------------------------

    def signal(self, pod: str, number: str) -> None:
        """Send a signal (STOP, CONT, KILL) to the application's process in a pod."""
        self.kubectl.kill(pod, "sh", "-c", SIGNAL, "sh", number, APPLICATION, container=CONTAINER)

    def delete(self, pod: str, *, force: bool = False) -> None:
        """Delete a pod, by force as the paper's experiment does."""
        options: Sequence[str] = ("--grace-period=0", "--force") if force else ()
        self.kubectl("delete", "pod", pod, "--wait=false", *options)

    def fail(self, pod: str, how: str) -> None:
        """Make the instance in a pod fail: killed, frozen, deleted, deleted-by-force, or unready (with READINESS_PROBE)."""
        match how:
            case "killed":
                self.signal(pod, "KILL")
            case "frozen":
                self.signal(pod, "STOP")
            case "deleted":
                self.delete(pod)
            case "deleted-by-force":
                self.delete(pod, force=True)
            case "unready":
                self.kubectl.shell(pod, CONTAINER, f"touch {UNREADY}")
            case _:
                raise ValueError(how)


def shared_claim(kubectl: Kubectl, claim: str, folder: Path) -> list[Object]:
    """Return a PersistentVolumeClaim and its volume NAMESPACE-CLAIM in a new folder, which all nodes of the local provider can mount."""
    folder.mkdir()
    nodes = [node["metadata"]["name"] for node in kubectl.list("nodes")]
    on = {"matchExpressions": [{"key": "kubernetes.io/hostname", "operator": "In", "values": nodes}]}
    common = {"accessModes": ["ReadWriteMany"], "storageClassName": "", "volumeMode": "Filesystem"}
    name = f"{kubectl.namespace}-{claim}"
    volume = common | {
        "capacity": {"storage": "100Mi"},
        "persistentVolumeReclaimPolicy": "Retain",
        "claimRef": {"namespace": kubectl.namespace, "name": claim},
        "local": {"path": str(folder)},
        "nodeAffinity": {"required": {"nodeSelectorTerms": [on]}},
    }
    wanted = common | {"resources": {"requests": {"storage": "100Mi"}}, "volumeName": name}
    return [
        {"apiVersion": "v1", "kind": "PersistentVolume", "metadata": {"name": name}, "spec": volume},
        {"apiVersion": "v1", "kind": "PersistentVolumeClaim", "metadata": {"name": claim}, "spec": wanted},
    ]

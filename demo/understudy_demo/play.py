"""The play: a robot that is driven, its application killed, and what was seen of the recovery."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from understudy_demo.kubectl import CommandFailed, Kubectl
from understudy_demo.recovery import Recovered
from understudy_demo.robotview import Handover, RobotLog, parse
from understudy_demo.stage import BUILT, REPOSITORY, Say

MANIFESTS = REPOSITORY / "examples" / "quickstart" / "manifests"
NAMESPACE = "understudy-demo"
WORKLOAD = "robot-1-drive"
ROBOT = "deploy/robot-1"
LOG = "/var/log/robot/robot.jsonl"

STRATEGIES = {
    "executing": "Fallback/Executing",
    "uninitialized": "Fallback/Uninitialized",
    "restart": "Restart",
}
"""The strategies by the name of their manifest, and as a recovery names them."""

FAILURES = ("deleted", "frozen", "killed")
"""How the application can be made to fail: its pod deleted by force (as in the paper), or its process stopped or
killed, which at first only the robot notices."""

_SIGNAL = """
for process in /proc/[0-9]*; do
    tr "\\0" " " <$process/cmdline | grep -q "^[^ ]*python3 -m understudy_quickstart.application" || continue
    kill -$1 ${process#/proc/} && exit 0
done
echo "no process of the application here" >&2
exit 1
"""
"""Sends a signal from inside the pod, whose containers share their processes."""

_BEFORE = 4.0  # seconds of driving before each failure, so that the picture has a before
_AFTER = 3.0  # and after
_KILLED = 128 + 9  # what a command exits with that was ended by SIGKILL


class NotSo(Exception):
    """Something that was waited for did not come about; the message says what was found."""


@dataclass
class Failure:
    """One failure of the play."""

    strategy: str
    how: str
    """One of FAILURES."""
    pod: str
    killed: float
    """When the failure was brought about, unix seconds by this machine's clock."""
    entry: dict[str, Any]
    recovered: Recovered
    handover: Handover
    problems: list[str] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """For the report."""
        return {
            "strategy": self.strategy,
            "how": self.how,
            "pod": self.pod,
            "killed": self.killed,
            "recovery": self.entry,
            "robot": self.handover.to_json(),
            "problems": self.problems,
        }


class Play:
    """The quickstart in the demo's namespace."""

    def __init__(self, kubectl: Kubectl, say: Say, *, images: str = BUILT) -> None:
        self._kubectl = kubectl
        self._say = say
        self._images = images

    def clear(self) -> None:
        """Remove the namespace, of this demo or of an earlier one."""
        if self._kubectl.get("namespace", NAMESPACE):
            self._say(f"removing namespace {NAMESPACE}")
            self._kubectl("delete", "namespace", NAMESPACE, "--timeout=120s", timeout=150)

    def begin(self, strategy: str) -> None:
        """The robot, its application and the strategy's policy; until the robot is driven."""
        self._kubectl("create", "namespace", NAMESPACE)
        self.apply(f"strategies/{strategy}.yaml")
        self.apply("robotworkload.yaml", edit=lambda text: _with_policy(text, strategy))
        # The robot's pod would wait for its ConfigMaps too, but the kubelet looks for them less and less often.
        self.until("the workload is built", self._built, within=60)
        self.apply("robot.yaml")
        self.until("the robot is driven", self._driven, within=180)

    def prepare(self, strategy: str) -> None:
        """Let this strategy protect the workload, and only what it needs be there."""
        self.apply(f"strategies/{strategy}.yaml")
        patch = f'{{"spec":{{"failurePolicyRef":{{"name":"quickstart-{strategy}"}}}}}}'
        self._kubectl("patch", "robotworkload", WORKLOAD, "--type=merge", "-p", patch)
        for other in STRATEGIES:
            if other != strategy:
                self._kubectl("delete", "fallbackpool", f"quickstart-{other}", "--ignore-not-found")
        self.until(f"{strategy} stands ready", lambda: self._ready(strategy), within=180)
        self.until("the robot is driven", self._driven, within=60)
        time.sleep(_BEFORE)

    def fail(self, strategy: str, how: str = "deleted") -> Failure:
        """Let the pod that drives the robot fail in one of FAILURES' ways, and wait for the recovery."""
        before = self._workload().get("status", {})
        pod = before["active"]
        number = max((int(r.get("number", 0)) for r in before.get("recoveries") or []), default=0)
        if how == "deleted":
            command = ["delete", "pod", pod, "--grace-period=0", "--force", "--wait=false"]
            self._say(f"{strategy}: kubectl delete pod {pod} --grace-period=0 --force")
        else:
            signal = "STOP" if how == "frozen" else "KILL"
            command = ["exec", pod, "-c", "drive", "--", "sh", "-c", _SIGNAL, "sh", signal]
            self._say(f"{strategy}: SIG{signal} to the application in {pod}")
        killed = time.time()
        try:
            self._kubectl(*command)
        except CommandFailed as error:
            if error.status != _KILLED:  # with the application its container ends, and what runs in it
                raise
        entry = self._recovery_after(number)
        time.sleep(_AFTER)
        recovered = Recovered.read(entry)
        handover = recovered.handover(self.log())
        problems = recovered.problems(handover, strategy=STRATEGIES[strategy])
        return Failure(strategy, how, pod, killed, entry, recovered, handover, problems)

    def log(self) -> RobotLog:
        """What the robot has written down."""
        return parse(self.raw_log())

    def raw_log(self) -> str:
        """The robot's log as text, with the part that was rotated out."""
        return self._kubectl("exec", ROBOT, "--", "sh", "-c", f"cat {LOG}.1 {LOG} 2>/dev/null || cat {LOG}")

    def apply(self, file: str, *, edit: Callable[[str], str] = str) -> None:
        """Apply a manifest of the quickstart, with this play's images."""
        text = edit((MANIFESTS / file).read_text())
        self._kubectl("apply", "-f", "-", stdin=text.replace(f" {BUILT}/understudy-", f" {self._images}/understudy-"))

    def _workload(self) -> dict[str, Any]:
        return self._kubectl.get("robotworkload", WORKLOAD)

    def _recovery_after(self, number: int) -> dict[str, Any]:
        latest: dict[str, Any] = {}

        def recorded() -> tuple[bool, str]:
            status = self._workload().get("status", {})
            newer = [r for r in status.get("recoveries") or [] if int(r.get("number", 0)) > number]
            if not newer:
                return False, f"health {status.get('health')}, no recovery yet"
            latest.clear()
            latest.update(newer[0])
            return latest["result"] != "Running", f"{latest['result']}: {latest.get('reason')}"

        # The first look comes late on purpose: a kubectl costs as much CPU as what is being timed.
        time.sleep(1.5)
        self.until("the recovery is recorded", recorded, within=120)
        return latest

    def _driven(self) -> tuple[bool, str]:
        """Whether the robot has had steady commands over the last second."""
        pods = self._kubectl.get("pods", "-l", "app=robot-1").get("items", [])
        if not any(pod.get("status", {}).get("phase") == "Running" for pod in pods):
            return False, f"robot's pod: {_why(pods)}"
        try:
            commands = self.log().commands
        except CommandFailed as error:
            return False, str(error)
        now = time.time()
        recent = [c for c in commands if c.received > now - 1.0]
        return len(recent) >= 12, f"{len(recent)} commands at the robot in the last second; {_state(self._workload())}"

    def _built(self) -> tuple[bool, str]:
        """Whether the operator has made everything that belongs to the workload."""
        workload = self._workload()
        conditions = (workload.get("status") or {}).get("conditions") or []
        done = any(c["type"] == "Reconciled" and c["status"] == "True" for c in conditions)
        return done, _state(workload) if conditions else "no status yet: does the operator run?"

    def _ready(self, strategy: str) -> tuple[bool, str]:
        """Whether the workload is healthy and the strategy is the one that would be used now."""
        workload = self._workload()
        status = workload.get("status") or {}
        state = _state(workload)
        if status.get("health") != "Healthy" or status.get("strategy") != STRATEGIES[strategy].rpartition("/")[2]:
            return False, state
        if strategy == "restart":
            return True, state
        counts = re.search(r"\((\d+)/(\d+)\)", status.get("standby") or "")
        return counts is not None and int(counts[1]) >= max(1, int(counts[2])), state

    def until(self, what: str, condition: Callable[[], tuple[bool, str]], *, within: float) -> None:
        """Wait until a condition holds, which also says what was seen. Raises NotSo after ``within`` seconds."""
        self._say(f"waiting until {what}")
        end = time.monotonic() + within
        shown = time.monotonic()
        while True:
            done, state = condition()
            if done:
                return
            now = time.monotonic()
            if now > end:
                raise NotSo(f"not within {within:.0f} s: {what}. Last seen: {state}")
            if now - shown > 15:
                self._say(f"  still waiting: {state}")
                shown = now
            time.sleep(1.0)

    def scene(self) -> str:
        """The state of everything in the namespace, for someone who has to find out what went wrong."""
        parts = []
        for title, arguments in (
            ("pods", ("get", "pods", "-o", "wide")),
            ("workload", ("describe", "robotworkload", WORKLOAD)),
            ("events", ("get", "events", "--sort-by=.lastTimestamp")),
        ):
            try:
                text = self._kubectl(*arguments)
            except CommandFailed as error:
                text = str(error)
            parts.append(f"--- {title}\n" + "\n".join(text.splitlines()[-45:]))
        return "\n".join(parts)


def _with_policy(workload: str, strategy: str) -> str:
    """The workload's manifest with another policy."""
    changed, count = re.subn(
        r"failurePolicyRef: \{name: [^}]*\}", f"failurePolicyRef: {{name: quickstart-{strategy}}}", workload
    )
    if count != 1:
        raise ValueError(f"robotworkload.yaml: expected one failurePolicyRef: {{name: ...}}, found {count}")
    return changed


def _state(workload: dict[str, Any]) -> str:
    """What a workload's status says, in one line: its columns, and every condition that is not as it should be."""
    status = workload.get("status") or {}
    said = [f"{column} {status.get(column)}" for column in ("health", "strategy", "standby")]
    said += [
        f"{condition['type']}: {condition['message']}"
        for condition in status.get("conditions") or []
        if condition["status"] == "False" and condition["type"] != "Recovering"
    ]
    return ", ".join(said)


def _why(pods: list[dict[str, Any]]) -> str:
    """Why pods are not running, in one line."""
    if not pods:
        return "not there"
    for pod in pods:
        for container in pod.get("status", {}).get("containerStatuses") or []:
            waiting = container.get("state", {}).get("waiting")
            if waiting:
                return f"{waiting.get('reason')} {waiting.get('message', '')}".strip()
    return ", ".join(str(pod.get("status", {}).get("phase")) for pod in pods)

"""The leaf ``pod``: what Kubernetes reports about the pod of the active instance.

Only the workload's monitor can evaluate it, because it watches the cluster. For a waiting instance the leaf holds: such
an instance is judged by its own agent, and its pod's status depends on the agent's judgement, so the evaluation would
be circular.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import ge, gt, le, lt

from understudy.api.quantities import QUANTITY, amount
from understudy.trees.core.evidence import EvidenceLeaf, EvidenceTrack, Finding
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import IntervalLeaf, Leaf, LeafPlace, State, duration
from understudy.trees.core.observations import PodState
from understudy.trees.core.task_activity import task_timing
from understudy.trees.leaves.leaf_plan import Key, LeafKind, LeafPlan, LeafValues, time_key
from understudy.trees.source.value_reader import found_text, whole_number_of

POD = "pod"
"""Stands for the pod among the watched topics. No topic has this name, because names of topics begin with a slash."""

STATUSES = ("True", "False", "Unknown")

MOST_RESTARTS = 1000

LONGEST = 64
"""Most characters of a bound."""

_UNRECORDED = "it needs the cluster's API, which a bag does not contain"

_CONDITION = re.compile(r"([a-z0-9.-]{1,253}/)?[A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?")


@dataclass(frozen=True)
class Bound:
    """A bound on a resource figure."""

    sign: str
    text: str
    """The quantity as the tree writes it."""

    def holds(self, value: float) -> bool:
        """Return whether a figure is within the bound."""
        return _SIGNS[self.sign](value, float(amount(self.text)))

    def __str__(self) -> str:
        return f"{self.sign} {self.text}"


_SIGNS: Mapping[str, Callable[[float, float], bool]] = {"<": lt, "<=": le, ">": gt, ">=": ge}

_BOUND = re.compile(rf"(<=|>=|<|>) ?({QUANTITY})")

RESOURCES: Mapping[str, Callable[[float], str]] = {
    "cpu": lambda cores: f"{cores:.3g}",
    "memory": lambda size: f"{size / 2**20:.4g}Mi",
}
"""The resources whose usage can be judged, and how a figure of each is formatted."""


class _LookLeaf(EvidenceLeaf[PodState]):
    """Holds while the observations of the pod meet its condition."""

    uses_messages = False
    of_cluster = True
    unrecorded = _UNRECORDED

    def newest(self) -> PodState | None:
        """Return the last observation of the pod."""
        return self._evaluation.observations.pod()

    def _limits(self, track: EvidenceTrack[PodState]) -> tuple[float, float]:
        return super()._limits(track) if self._evaluation.observations.in_control else (math.inf, math.inf)

    def awaited(self) -> str:
        """Return what must arrive first."""
        return "observation of the pod"


class ConditionLeaf(_LookLeaf):
    """Holds while a condition of the pod has a status."""

    def __init__(self, place: LeafPlace, hold_off: float, condition: str, status: str) -> None:
        """Make a leaf over a condition by its type; ``hold_off`` in seconds."""
        super().__init__(place, POD, hold_off)
        self._condition, self._status = condition, status

    def evaluate(self, content: PodState, failed: bool) -> Finding:
        """Evaluate the observation. A condition that the pod does not have is Unknown (Kubernetes' API conventions)."""
        found = next((one for one in content.conditions if one.type == self._condition), None)
        if (found.status if found is not None else "Unknown") == self._status:
            return Finding(True, "")
        if found is None:
            return Finding(False, f"the pod has no condition {self._condition}")
        reason = f" ({found.reason})" if found.reason else ""
        return Finding(False, f"condition {self._condition} of the pod is {found.status}{reason}")

    def condition(self) -> str:
        """Return the condition in words."""
        return f"status {self._status} of the pod's condition {self._condition}"

    def requirement(self) -> str:
        """Return what the condition requires."""
        return f"{self._status} is required"


class UsageLeaf(_LookLeaf):
    """Holds while the pod's usage of a resource is within its bound, and also while the usage cannot be determined."""

    def __init__(self, place: LeafPlace, hold_off: float, what: str, bound: Bound) -> None:
        """Make a leaf over one of RESOURCES; ``hold_off`` in seconds."""
        super().__init__(place, POD, hold_off)
        self._what, self._bound = what, bound

    def evaluate(self, content: PodState, failed: bool) -> Finding:
        """Evaluate the last figures."""
        if content.usage is None:
            return Finding(True, "")  # being unable to judge is not a failure
        taken = getattr(content.usage, self._what)
        if self._bound.holds(taken):
            return Finding(True, "")
        return Finding(False, f"{self._what} of the pod was {RESOURCES[self._what](taken)}")

    def condition(self) -> str:
        """Return the condition in words."""
        return f"{self._what} {self._bound} of the pod"

    def requirement(self) -> str:
        """Return what the condition requires."""
        return f"{self._what} {self._bound} is required"


@dataclass
class _Counted:
    """The restarts of one instance. Times are Unix seconds."""

    since: float
    """When the instance took control, which identifies it."""
    times: deque[float] = field(default_factory=deque)
    """When the last restarts were seen: one more than are allowed."""
    total: int | None = None
    """The total number at the last observation."""
    last_evaluated: PodState | None = None
    received: float = 0.0
    """When that number was observed, by the clock at that time."""

    def shift(self) -> None:
        """Follow a step of the clock, which moved the time of the last observation."""
        if self.last_evaluated is None or self.last_evaluated.received == self.received:
            return
        step, self.received = self.last_evaluated.received - self.received, self.last_evaluated.received
        self.times = deque((time + step for time in self.times), self.times.maxlen)


class RestartsLeaf(IntervalLeaf):
    """Holds while the containers of the pod are not restarted too often within a window.

    It fails with the first restart that is too many, and is well again when enough restarts are older than the window.
    """

    uses_messages = False
    of_cluster = True
    unrecorded = _UNRECORDED

    def __init__(self, place: LeafPlace, most: int, window: float) -> None:
        """Make a leaf that allows ``most`` restarts in ``window`` seconds."""
        super().__init__(place, POD)
        self._most, self._window = most, window
        self._counted = _Counted(math.nan)

    def _followed(self) -> _Counted:
        """Return the restarts up to the time of the evaluation."""
        evaluation, counted = self._evaluation, self._counted
        if counted.since != evaluation.since:
            counted = self._counted = _Counted(evaluation.since, deque(maxlen=self._most + 1))
        counted.shift()
        pod = evaluation.observations.pod()
        if pod is None or pod is counted.last_evaluated or pod.received < evaluation.since:
            return counted
        # Restarts before the instance took control, or before the first observation, do not count.
        new = pod.restarts - counted.total if counted.total is not None else 0
        counted.times.extend([pod.received] * min(max(new, 0), self._most + 1))
        counted.total, counted.last_evaluated, counted.received = pod.restarts, pod, pod.received
        return counted

    def _failing(self) -> tuple[float, float] | None:
        """Return the interval in which the leaf fails if there is no further restart; None if it does not fail."""
        counted = self._followed()
        if len(counted.times) <= self._most or not self._evaluation.observations.in_control:
            return None
        begin, end = -math.inf, counted.times[0] + self._window
        if self.tasks:
            found = task_timing(self.tasks, self._evaluation)
            if found is None or counted.times[0] < found.active:
                return None
            begin = found.settled
        return (begin, end) if begin < end else None

    def last(self) -> float | None:
        """Return the last good time: when the last restart was seen."""
        counted = self._counted
        return self._last_with_task(counted.times[-1] if counted.times else None)

    def _plain_reason(self, state: State) -> str:
        count, within = self._most + 1, duration(self._window)
        if state == "Failed":
            times = "once" if count == 1 else f"{count} times"
            return f"containers of the pod were restarted {times} within {within}"
        return f"containers of the pod are restarted fewer than {count} times within {within}"


# -- how it is written ------------------------------------------------------------------------------------------------

_WITH: Mapping[str, tuple[str, ...]] = {
    "condition": ("status", "for"),
    "restarts": ("window",),
    **dict.fromkeys(RESOURCES, ("for",)),
}
"""What the leaf can evaluate, and the keys that may be given with it."""


def _check(values: LeafValues) -> None:
    kinds = [kind for kind in _WITH if kind in values]
    if len(kinds) != 1:
        found = _listed(kinds, "and") if kinds else f"none of {_listed(list(_WITH), 'and')}"
        values.problem("", f"found {found}; give one of them, such as condition: Ready")
        return
    (what,) = kinds
    for key in dict.fromkeys(key for keys in _WITH.values() for key in keys):
        if key in values and key not in _WITH[what]:
            belongs = _listed([other for other, keys in _WITH.items() if key in keys], "or")
            values.problem(key, f"{key} is only for {belongs}; remove it")
    if what == "restarts" and "window" not in values:
        values.problem("window", "missing; give the time within which there may be so many restarts, such as 10m")


def _plan(values: LeafValues) -> LeafPlan:
    (what,) = (kind for kind in _WITH if kind in values)
    name = values["condition"].replace("/", ".") if what == "condition" else what
    watched = WatchedTopic(POD, None, 0.0, None, subscribed=False, pod=True, usage=what in RESOURCES)
    return LeafPlan(f"{POD}.{name}", watched, _make(what, values))


def _make(what: str, values: LeafValues) -> Callable[[LeafPlace], Leaf]:
    found, hold_off = values[what], values.hold_off
    if what == "condition":
        status = values["status"] or STATUSES[0]
        return lambda place: ConditionLeaf(place, hold_off, found, status)
    if what == "restarts":
        window = values["window"]
        return lambda place: RestartsLeaf(place, found, window)
    return lambda place: UsageLeaf(place, hold_off, what, found)


def _listed(words: Sequence[str], between: str) -> str:
    return f" {between} ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def _type(found: object) -> str:
    if not isinstance(found, str) or not _CONDITION.fullmatch(found):
        raise ValueError(f"found {found_text(found)}; give the type of a condition, such as Ready or ContainersReady")
    return found


def _bound(what: str) -> Callable[[object], Bound]:
    example = "'< 1.5', in cores" if what == "cpu" else "'< 200Mi'"

    def read(found: object) -> Bound:
        match = _BOUND.fullmatch(found) if isinstance(found, str) and len(found) <= LONGEST else None
        if match is None:
            raise ValueError(f"found {found_text(found)}; write <, <=, > or >= and a quantity, such as {example}")
        return Bound(match[1], match[2])

    return read


def _status(found: object) -> str:
    # Without quotes, YAML reads True and False as booleans.
    status = str(found).capitalize() if isinstance(found, bool | str) else ""
    if status not in STATUSES:
        raise ValueError(f"found {found_text(found)}; known are {', '.join(STATUSES)}")
    return status


POD_LEAF = LeafKind(
    POD,
    "while the pod of the instance has a condition, is not restarted too often, or uses no more CPU or memory than allowed",
    (
        Key("condition", "the type of a condition of the pod, such as Ready", read=_type),
        Key(
            "status",
            "the status that the condition must have: True, False or Unknown; True if it is not given",
            read=_status,
        ),
        Key(
            "restarts",
            "how often its containers may be restarted within the window, such as 2",
            "int",
            read=whole_number_of(MOST_RESTARTS, least=0),
        ),
        time_key("window", "the time within which restarts are counted, such as 10m"),
        Key("cpu", "the cores that its containers may use, such as < 1.5", read=_bound("cpu")),
        Key("memory", "the memory that its containers may use, such as < 200Mi", read=_bound("memory")),
        time_key("for", "how long it may be false before that is a failure, such as 10s; not with restarts"),
    ),
    "{condition: Ready, for: 10s}",
    _plan,
    _check,
    active_only=True,
)

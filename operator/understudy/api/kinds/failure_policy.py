"""FailurePolicy: what healthy means, and what to do if a workload is not healthy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, Self, get_args

from pydantic import Field, model_validator

from understudy.api import names
from understudy.api.base import (
    Duration,
    LocalReference,
    Model,
    ObjectName,
    RosName,
    UnknownContent,
    length,
    matching,
    seconds,
    unique,
    with_rules,
)
from understudy.api.conditions import Conditions
from understudy.api.kinds.degraded_spec import Degraded
from understudy.api.kinds.procedure_spec import Procedure
from understudy.api.kinds.recording_spec import BlackBox
from understudy.api.kinds.requirements_spec import Requirements
from understudy.api.kinds.situation_spec import When
from understudy.api.kinds.state_spec import State
from understudy.api.kinds.tree_spec import Form, ShortForm, Text, Written

_KEY_PATTERN = r"^[-._a-zA-Z0-9]+\.(yaml|yml|xml|osc)$"
_KEY_MESSAGE = "the suffix of the key must be .yaml (short form), .xml (BehaviorTree.CPP 4) or .osc (OpenSCENARIO 2)"

_ENDINGS: dict[str, Form] = {"yaml": "yaml", "yml": "yaml", "xml": "xml", "osc": "osc"}


class TreeReference(Model):
    """A health tree in a ConfigMap."""

    name: ObjectName = Field(
        description=f"Name of the ConfigMap, in the policy's namespace. The ConfigMap must have the label {names.HEALTH_TREE}=true."
    )
    key: str = matching(_KEY_PATTERN, _KEY_MESSAGE, max_length=253)
    """Key in the ConfigMap. Its suffix selects the language of the tree: .yaml, .xml or .osc."""

    @property
    def form(self) -> Form:
        """The language of the tree, as the field of ``spec.monitoring`` that would hold it."""
        return _ENDINGS[self.key.rpartition(".")[2]]


@with_rules(
    (
        "has(self.yaml) || has(self.xml) || has(self.osc) || has(self.configMapKeyRef)",
        "a health tree is required: give exactly one of yaml (short form), xml (BehaviorTree.CPP 4), "
        "osc (OpenSCENARIO 2) and configMapKeyRef",
        ".yaml",
    ),
    (
        "!has(self.yaml) || !has(self.xml)",
        "the health tree is already given as yaml: give exactly one of yaml, xml, osc and configMapKeyRef",
        ".xml",
    ),
    (
        "!has(self.osc) || !has(self.yaml) && !has(self.xml)",
        "the health tree is already given as yaml or xml: give exactly one of yaml, xml, osc and configMapKeyRef",
        ".osc",
    ),
    (
        "!has(self.configMapKeyRef) || !has(self.yaml) && !has(self.xml) && !has(self.osc)",
        "configMapKeyRef is set in addition to yaml, xml or osc: give exactly one of yaml, xml, osc and "
        "configMapKeyRef",
        ".configMapKeyRef",
    ),
)
class Monitoring(Written):
    """What healthy means, as a behaviour tree, and how long it must fail to count as a failure."""

    yaml: ShortForm | None = None
    """The health tree in the short form, which is Understudy's YAML notation. The value is the root node, such as
    parallel, sequence, selector (Fallback in BehaviorTree.CPP) or topic. See docs/trees.md."""
    xml: Text | None = None
    """The health tree as a BehaviorTree.CPP 4 XML document, as Groot 2 writes it. See docs/trees.md."""
    osc: Text | None = None
    """The health tree as OpenSCENARIO 2 text that imports osc.understudy. See docs/trees-osc.md."""
    config_map_key_ref: TreeReference | None = None
    """The health tree in a ConfigMap, which several policies can share."""
    debounce: Duration = "0s"
    """The workload counts as failed when the tree has failed without interruption for this long. This time is part of
    the detection time."""
    startup_grace: Duration = "30s"
    """How long a new instance may take to become healthy for the first time. After this time, it counts as failed."""

    @model_validator(mode="after")
    def _one_tree(self) -> Self:
        if self.languages + (self.config_map_key_ref is not None) != 1:
            raise ValueError("give exactly one of yaml, xml, osc and configMapKeyRef")
        return self

    @property
    def form(self) -> Form:
        """The language of the health tree: the field that holds it, or for a tree in a ConfigMap the field that would.

        A tree from a ConfigMap must be inserted (:func:`in_force`) before :attr:`tree` can be read.
        """
        return self.config_map_key_ref.form if self.config_map_key_ref is not None else super().form


@with_rules(
    ("self.type != 'Fallback' || has(self.poolRef)", "poolRef is required for a strategy of type Fallback", ".poolRef"),
    (
        "self.type == 'Fallback' || !has(self.poolRef)",
        "poolRef is allowed only for a strategy of type Fallback",
        ".poolRef",
    ),
    (
        "self.type != 'Auto' || !has(self.recovery)",
        "recovery is not allowed for type Auto: set spec.bringUp of the RobotWorkload, or list the strategies yourself",
        ".recovery",
    ),
    length("verifyWithin", "100ms"),
    (
        "self.type == 'Fallback' || !has(self.waitFor)",
        "waitFor is allowed only for a strategy of type Fallback: it is the time to wait for a pod of its pool",
        ".waitFor",
    ),
    (
        "self.type == 'Fallback' || !has(self.handover)",
        "handover is allowed only for a strategy of type Fallback: in a Restart, the gate is closed first in any case",
        ".handover",
    ),
)
class Strategy(Model):
    """One way to recover the workload."""

    type: Literal["Fallback", "Restart", "Auto"]
    """Fallback: an instance from a pool takes over. Restart: Understudy deletes the pod, and a new one starts. Auto:
    Understudy chooses from Restart and the FallbackPools whose workloadSelector matches the workload, in the order that
    best meets spec.requirements. Auto must be the only strategy, and is not allowed in situations. See
    docs/choosing.md."""
    pool_ref: LocalReference | None = None
    """The FallbackPool that provides the new instance."""
    recovery: Procedure | None = None
    """Procedure (a behaviour tree) that runs on the instance that takes over, instead of spec.bringUp of the
    RobotWorkload. The gate is closed for this instance meanwhile. Kept state (spec.state) is restored before the
    procedure, or by its restore_state steps if it has any."""
    wait_for: Duration | None = None
    """Only for pools with readiness Uninitialized: how long to wait, with the gate closed (no instance reaches the
    robot), if the pool has no ready pod. After this time the next strategy is tried. A free pod goes first to the
    RobotWorkload with the highest spec.poolPriority. Absent: the next strategy is tried immediately. See
    docs/waiting.md."""
    handover: Literal["Switch", "BreakBeforeMake"] | None = None
    """Only for pools with readiness Executing. Switch: one write to the gate takes the robot from one instance and gives
    it to another, so for some milliseconds, both or none may reach the robot, because each node applies it for itself.
    BreakBeforeMake: the gate is closed, and opened for the other instance once no packet of the former one has arrived
    for 60 ms. Absent: Switch. Only recoveries use it: a planned switchover switches the gate by one write in any case. A
    gate of kind Mux switches at once in any case. See docs/how-to/network-policies.md."""
    verify_within: Duration = "30s"
    """Maximum time from the start of the strategy until the robot receives outputs from the new instance. After this
    time the next strategy is tried. Time spent waiting for a pod (waitFor) does not count."""


_SITUATION_PATTERN = r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?$"
_SITUATION_MESSAGE = (
    "the name of a situation must consist of lower-case letters, digits and dashes, and must begin and end with "
    "a letter or digit"
)


@with_rules(
    (
        "has(self.strategies) != has(self.requirements)",
        "a situation must have either strategies or, if spec.strategies is Auto, requirements",
    ),
    (
        "!has(self.strategies) || self.strategies.all(s, s.type != 'Auto')",
        "a situation cannot have a strategy of type Auto: set Auto in spec.strategies, and give the "
        "situation requirements",
        ".strategies",
    ),
)
class Situation(Model):
    """A situation of the robot in which other strategies apply."""

    name: str = matching(_SITUATION_PATTERN, _SITUATION_MESSAGE, max_length=63)
    """Name of the situation in statuses and Events, such as carrying."""
    when: When
    """Condition that detects the situation. If several situations apply, the first in the list is used."""
    after: Duration = "0s"
    """How long the condition must be true without interruption before the situation takes effect."""
    clear_after: Duration = "10s"
    """How long the condition must be false without interruption before the situation ends."""
    strategies: list[Strategy] | None = Field(default=None, min_length=1, max_length=8)
    """Strategies to try in order, instead of spec.strategies, while the situation is in effect. Understudy then keeps
    standbys only in the pools of these strategies."""
    requirements: Requirements | None = None
    """Requirements for choosing the strategies, instead of spec.requirements."""


MOST_COUNTED = 20
"""Maximum of recoveries in a budget. The workload's status keeps the start time of each."""


@with_rules(length("within", "1s"))
class Budget(Model):
    """Maximum number of automatic recoveries in a sliding time window."""

    recoveries: int = Field(ge=1, le=MOST_COUNTED)
    """How many recoveries may begin within the window."""
    within: Duration
    """Length of the window, such as 1h."""

    @property
    def length(self) -> float:
        """The length of the window in seconds."""
        return seconds(self.within)

    @property
    def words(self) -> str:
        """The budget as text for users."""
        return f"{self.recoveries} {'recovery' if self.recoveries == 1 else 'recoveries'} within {self.within}"


@with_rules(length("within", "1s"))
class StormGuard(Model):
    """Detects that many workloads fail at once, which suggests that the network or the cluster failed and not the workloads."""

    percent: int = Field(default=50, ge=1, le=99)
    """A storm begins if more than this percentage of the policy's workloads fail."""
    workloads: int = Field(default=3, ge=2)
    """A storm also requires that at least this number of workloads fail."""
    within: Duration = "10s"
    """A workload counts as failing if it failed within this time, even if it has recovered since."""
    hold_for: Duration = "2m"
    """Maximum time for which a storm defers recoveries. After it, monitors recover even if the operator has not
    reported the end of the storm."""


class Limits(Model):
    """Limits of automatic actions."""

    cooldown: Duration = "0s"
    """Minimum time between the end of one recovery and the start of the next."""
    healthy_delay: Duration = "2s"
    """How long the instance that took over must be healthy before the workload counts as recovered. If it fails
    earlier, the recovery continues with the next strategy."""
    budget: Budget | None = None
    """Maximum number of automatic recoveries in a time window. When it is reached, the monitor fences a failed instance
    (denies it access to the robot) and does nothing else, until fewer recoveries lie within the window or a user runs
    `understudy resume`. Absent: no maximum. See docs/limits.md."""
    storm_guard: StormGuard | None = None
    """Response to a storm: many of the policy's workloads fail at once, so the cause is probably not in them. Monitors
    then claim (take) no pod of a shared pool and restart no pod. Ready standbys still take over. Absent: no guard. See
    docs/limits.md."""


@with_rules(length("every", "10ms"))
class SafeCommand(Model):
    """A message to the robot while no instance controls it."""

    topic: RosName
    """Topic to publish on. It must be one of the workload's outputs."""
    message: UnknownContent = Field(default_factory=dict)
    """Fields of the message. Fields that are absent keep their default value, so an empty Twist means: stand still. In
    a field of type builtin_interfaces/msg/Time, the string "now" stands for the current time."""
    every: Duration = "100ms"
    """How often the message is sent."""


@with_rules(unique("commands", "topic", "commands contains the same topic twice", required=True))
class Safety(Model):
    """What is done for the robot's safety while no instance is verified to be in control."""

    commands: list[SafeCommand] = Field(min_length=1, max_length=8)
    """Messages to publish while no instance controls the robot."""
    after: Duration = "100ms"
    """The messages are sent when no instance has controlled the robot for this long. Set it longer than a takeover by a
    standby of an Executing pool, so that the robot does not brake for that."""


@with_rules(
    (
        "!has(self.degraded) || !has(self.degraded.actions) || self.degraded.actions.all(a, !has(a.prewarm) || "
        "self.strategies.exists(s, has(s.poolRef) && s.poolRef.name == a.prewarm.poolRef.name))",
        "prewarm names a pool that no strategy uses: name the pool of a Fallback strategy",
        ".degraded.actions",
    ),
    (
        "self.strategies.all(s, s.type != 'Auto') || size(self.strategies) == 1",
        "Auto chooses the complete order of strategies: use it as the only strategy, or list all strategies yourself",
        ".strategies",
    ),
    (
        "self.strategies.all(s, s.type != 'Auto') || has(self.requirements)",
        "requirements is required for a strategy of type Auto, which uses them to choose",
        ".requirements",
    ),
    unique("situations", "name", "situations contains the same name twice"),
    (
        "!has(self.situations) || self.strategies.exists(s, s.type == 'Auto') || self.situations.all(a, has(a.strategies))",
        "the policy lists its strategies, so each situation must list its own: set strategies",
        ".situations",
    ),
    (
        "!has(self.situations) || self.strategies.all(s, s.type != 'Auto') || self.situations.all(a, has(a.requirements))",
        "spec.strategies is Auto, so each situation must set requirements",
        ".situations",
    ),
    (
        "self.priority != 'Safety' || !has(self.limits.budget)",
        "priority Safety does not allow limits.budget, which can delay a recovery: remove the budget or the priority",
        ".limits.budget",
    ),
    (
        "self.priority != 'Safety' || !has(self.limits.stormGuard)",
        "priority Safety does not allow limits.stormGuard, which can delay a recovery: remove the storm guard or "
        "the priority",
        ".limits.stormGuard",
    ),
)
class FailurePolicySpec(Model):
    """What healthy means, and what to do if a workload is not healthy."""

    monitoring: Monitoring
    """What healthy means, as a behaviour tree (the health tree). The monitor, a pod for each workload, evaluates it and
    recovers the workload."""
    strategies: list[Strategy] = Field(min_length=1, max_length=8)
    """Strategies to try in order. If a strategy is not available, or is not verified within its verifyWithin, the next
    one is tried. After the last one, the monitor waits for the retry delay (see priority), and then tries the first one
    again."""
    requirements: Requirements | None = None
    """Requirements from which Understudy chooses the order for type Auto. If spec.strategies lists the strategies, the
    requirements have no effect except in `understudy recommend`."""
    situations: list[Situation] = Field(default_factory=list, max_length=4)
    """Situations of the robot, such as carrying a load, in which other strategies apply. Standbys are then kept in the
    pools of those strategies. Empty: the strategies never change. See docs/situations.md."""
    degraded: Degraded | None = None
    """When a healthy workload counts as degraded, and what to do then. Absent: workloads are never degraded. See
    docs/degraded.md."""
    state: State = Field(default_factory=State)
    """Kept state: what the monitor stores while the instance is healthy, and restores in the instance that takes
    over."""
    limits: Limits = Field(default_factory=Limits)
    """Limits of automatic actions."""
    priority: Literal["Normal", "Safety"] = "Normal"
    """Whether recoveries or limits take precedence. Normal: limits can delay a recovery. If no strategy was verified,
    all of them are tried again after a retry delay, which doubles each time from 2 s to 1 min. Safety: limits never
    delay a recovery (cooldown has no effect), and the retry delay is always 2 s."""
    on_leak: Literal["Close", "Continue"] = "Close"
    """What to do while an instance that was in control before still reaches the robot past the gate. Its pod is deleted
    in any case. Close: the gate is closed for the active instance too, until the other one is silent, so that only that
    one drives. Continue: the active instance continues to drive. See docs/safety.md."""
    safety: Safety | None = None
    """Safe commands: messages that the monitor sends to the robot while no instance controls it. None are sent while the
    monitor does not run. See docs/safety.md."""
    black_box: BlackBox | None = None
    """Record the messages that the monitor received before and during each failure in an MCAP file. The command
    `understudy blackbox` downloads it. Absent: nothing is recorded. See docs/blackbox.md."""

    @property
    def auto(self) -> bool:
        """Whether Understudy chooses the strategies."""
        return any(strategy.type == "Auto" for strategy in self.strategies)

    @property
    def varies(self) -> bool:
        """Whether the strategies in effect depend on the workload or on its situation. The operator then determines them."""
        return self.auto or bool(self.situations)

    @property
    def everywhere(self) -> list[tuple[str, Strategy]]:
        """All strategies, including those of situations, each with its path in the spec."""
        found = [(f"strategies[{i}]", one) for i, one in enumerate(self.strategies)]
        for i, situation in enumerate(self.situations):
            found += [(f"situations[{i}].strategies[{j}]", one) for j, one in enumerate(situation.strategies or ())]
        return found

    @property
    def recoveries(self) -> list[tuple[str, Procedure]]:
        """The procedures of all strategies, each with its path in the spec."""
        return [(f"{path}.recovery", one.recovery) for path, one in self.everywhere if one.recovery is not None]

    @property
    def inline_trees(self) -> list[tuple[str, Written]]:
        """The trees of situations and of ``degraded``, each with its path in the spec."""
        found: list[tuple[str, Written]] = [
            (f"situations[{i}].when", one.when) for i, one in enumerate(self.situations) if one.when.languages
        ]
        if self.degraded is not None:
            found.append(("degraded.monitoring", self.degraded.monitoring))
            for i, action in enumerate(self.degraded.actions):
                if action.reschedule is not None and action.reschedule.idle is not None:
                    found.append((f"degraded.actions[{i}].reschedule.idle", action.reschedule.idle))
        return found


class TreeInForce(Model):
    """The last valid health tree from the ConfigMap. Monitors use it even if the ConfigMap is changed to an invalid tree or deleted."""

    name: str
    """Name of the ConfigMap from which the tree was read."""
    key: str
    """Key in the ConfigMap."""
    yaml: UnknownContent | None = None
    """The tree, if it is in the short form."""
    xml: str | None = None
    """The tree, if it is BehaviorTree.CPP 4 XML."""
    osc: str | None = None
    """The tree, if it is OpenSCENARIO 2."""


class FailurePolicyStatus(Model):
    """Observed state."""

    observed_generation: int | None = None
    """Generation of the spec that was last checked."""
    workloads: int | None = None
    """Number of RobotWorkloads that use this policy."""
    strategies: str | None = None
    """Summary of the strategies, in order."""
    tree: TreeInForce | None = None
    """The health tree in effect, if spec.monitoring refers to a ConfigMap."""
    conditions: Conditions | None = None
    """Ready and Accepted: the tree and the strategies are valid. Storm (if limits.stormGuard is set): so many of the policy's
    workloads fail at once that their monitors claim no pod of a shared pool and restart no pod."""


def in_force(spec: FailurePolicySpec, status: Mapping[str, Any] | None) -> FailurePolicySpec | None:
    """Return the policy with its health tree. A tree from a ConfigMap is read from the policy's status, where the operator puts it.

    Returns None if the status has no tree yet.
    """
    if spec.monitoring.config_map_key_ref is None:
        return spec
    tree = (status or {}).get("tree") or {}
    found = {form: tree[form] for form in get_args(Form) if tree.get(form)}
    if len(found) != 1:
        return None
    monitoring = spec.monitoring.model_copy(update={"config_map_key_ref": None, **found})
    return spec.model_copy(update={"monitoring": monitoring})


def following(spec: FailurePolicySpec, chosen: Sequence[Strategy] | None) -> FailurePolicySpec | None:
    """Return the policy with the strategies in effect: ``chosen`` if the policy has Auto or situations, otherwise its own.

    Returns None for a policy with Auto if no strategies were chosen yet.
    """
    if not spec.varies:
        return spec
    if chosen:
        return spec.model_copy(update={"strategies": list(chosen)})
    return None if spec.auto else spec

"""FailurePolicy: what healthy means, and what is done when it isn't."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, Self, get_args

from pydantic import Field, model_validator

from understudy.api import names
from understudy.api.base import (
    DURATION_PATTERN,
    Duration,
    LocalReference,
    Model,
    ObjectName,
    RosName,
    matching,
    rules,
    seconds,
)
from understudy.api.conditions import Condition
from understudy.api.kinds.degraded_spec import Degraded
from understudy.api.kinds.procedure_spec import Procedure
from understudy.api.kinds.recording_spec import BlackBox
from understudy.api.kinds.requirements_spec import Requirements
from understudy.api.kinds.situation_spec import When
from understudy.api.kinds.state_spec import State
from understudy.api.kinds.tree_spec import Form, Written, short_form, text

_KEY_PATTERN = r"^[-._a-zA-Z0-9]+\.(yaml|yml|xml|osc)$"
_KEY_MESSAGE = (
    "give a key that says by its ending what the tree is written in: .yaml (the short form), .xml (BehaviorTree.CPP 4) or .osc "
    "(OpenSCENARIO 2)"
)

_ENDINGS: dict[str, Form] = {"yaml": "yaml", "yml": "yaml", "xml": "xml", "osc": "osc"}


class TreeReference(Model):
    """A health tree that is a key of a ConfigMap."""

    name: ObjectName = Field(
        description=f"Name of the ConfigMap, in the policy's namespace, with the label {names.HEALTH_TREE}=true."
    )
    key: str = Field(
        pattern=_KEY_PATTERN,
        max_length=253,
        description="The key, which says by its ending what the tree is written in: .yaml, .xml or .osc.",
        json_schema_extra=matching(_KEY_PATTERN, _KEY_MESSAGE),
    )

    @property
    def form(self) -> Form:
        """What the tree is written in: the field of ``spec.monitoring`` that it could stand in."""
        return _ENDINGS[self.key.rpartition(".")[2]]


class Monitoring(Written):
    """What healthy means, as a behaviour tree, and when its verdict counts."""

    model_config = Written.model_config | {
        "json_schema_extra": rules(
            (
                "has(self.yaml) || has(self.xml) || has(self.osc) || has(self.configMapKeyRef)",
                "a health tree is required: give exactly one of yaml (the short form), xml (BehaviorTree.CPP 4), osc (OpenSCENARIO 2) "
                "and configMapKeyRef",
                ".yaml",
            ),
            (
                "!has(self.yaml) || !has(self.xml)",
                "the health tree is given as yaml already: give exactly one of yaml, xml, osc and configMapKeyRef",
                ".xml",
            ),
            (
                "!has(self.osc) || !has(self.yaml) && !has(self.xml)",
                "the health tree is given as yaml or xml already: give exactly one of yaml, xml, osc and configMapKeyRef",
                ".osc",
            ),
            (
                "!has(self.configMapKeyRef) || !has(self.yaml) && !has(self.xml) && !has(self.osc)",
                "the health tree is given in the policy already: give exactly one of yaml, xml, osc and configMapKeyRef",
                ".configMapKeyRef",
            ),
        )
    }

    yaml: dict[str, Any] | None = short_form(
        "The health tree in the short form: one node, such as parallel, sequence, selector or topic. See docs/trees.md."
    )
    xml: str | None = text(
        "The health tree instead as the text of a BehaviorTree.CPP 4 file, as Groot 2 writes it. See docs/trees.md."
    )
    osc: str | None = text(
        "The health tree instead as the text of an OpenSCENARIO 2 file that imports osc.understudy. See docs/trees-osc.md."
    )
    config_map_key_ref: TreeReference | None = Field(
        default=None, description="The health tree instead in a ConfigMap, where several policies may share it."
    )
    debounce: Duration = Field(
        default="0s",
        description="The tree must fail for this long before it counts as a failure. Adds to the detection time.",
    )
    startup_grace: Duration = Field(
        default="30s", description="A newly started instance has this long to become healthy for the first time."
    )

    @model_validator(mode="after")
    def _one_tree(self) -> Self:
        if self.given + (self.config_map_key_ref is not None) != 1:
            raise ValueError("give exactly one of yaml, xml, osc and configMapKeyRef")
        return self

    @property
    def form(self) -> Form:
        """What the health tree is written in: the field that it stands in, or would, of one in a ConfigMap.

        That one's text has to be put in (:func:`in_force`) before there is a :attr:`tree`.
        """
        return self.config_map_key_ref.form if self.config_map_key_ref is not None else super().form


class Strategy(Model):
    """One way to bring the workload back."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "self.type != 'Fallback' || has(self.poolRef)",
                "poolRef is required for a strategy of type Fallback",
                ".poolRef",
            ),
            (
                "self.type == 'Fallback' || !has(self.poolRef)",
                "poolRef is only for a strategy of type Fallback",
                ".poolRef",
            ),
            (
                "self.type != 'Auto' || !has(self.recovery)",
                "recovery is not for Auto, which may come to any strategy: give the workload a bringUp, or write the strategies out",
                ".recovery",
            ),
            (
                f"!self.verifyWithin.matches(r'{DURATION_PATTERN}') || duration(self.verifyWithin) >= duration('100ms')",
                "verifyWithin is at least 100ms",
                ".verifyWithin",
            ),
            (
                "self.type == 'Fallback' || !has(self.waitFor)",
                "waitFor is only for a strategy of type Fallback: it says how long to wait for a pod of its pool",
                ".waitFor",
            ),
        )
    }

    type: Literal["Fallback", "Restart", "Auto"] = Field(
        description="Fallback: an understudy from a pool takes over. Restart: the pod is deleted and a new one starts. Auto, alone: "
        "Fallbacks from the pools that serve the workload, and Restart, in an order that spec.requirements ask for. See docs/choosing.md."
    )
    pool_ref: LocalReference | None = Field(
        default=None, description="The FallbackPool that the understudy comes from."
    )
    recovery: Procedure | None = Field(
        default=None,
        description="What is done to the instance that takes over, behind the closed gate, instead of the workload's bringUp. Kept "
        "state is restored first, unless the tree says where (restore_state).",
    )
    wait_for: Duration | None = Field(
        default=None,
        description="How long to wait, with the gate closed, for a pod of a shared pool (Uninitialized) that has none that is ready; then "
        "the next strategy is tried. Who has the higher spec.poolPriority is served first. Absent: the next strategy at once. See "
        "docs/waiting.md.",
    )
    verify_within: Duration = Field(
        default="30s",
        description="How long it may take until outputs are seen from the new instance and from no other; then the next strategy is tried. "
        "What it waited for a pod (waitFor) doesn't count.",
    )


_SITUATION_PATTERN = r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?$"
_SITUATION_MESSAGE = (
    "names of situations have lower-case letters, digits and dashes only, and begin and end with a letter or digit"
)


class Situation(Model):
    """A situation of the robot in which other strategies are in force."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "has(self.strategies) != has(self.requirements)",
                "say what is in force then: give strategies, or requirements where spec.strategies are Auto",
            ),
            (
                "!has(self.strategies) || self.strategies.all(s, s.type != 'Auto')",
                "a situation has no Auto of its own: leave spec.strategies to Auto, and give the situation requirements",
                ".strategies",
            ),
        )
    }

    name: str = Field(
        pattern=_SITUATION_PATTERN,
        max_length=63,
        description="What it is called in statuses and Events, such as carrying.",
        json_schema_extra=matching(_SITUATION_PATTERN, _SITUATION_MESSAGE),
    )
    when: When = Field(description="When the robot is in it. Where several are so, the first of the list is in force.")
    after: Duration = Field(default="0s", description="It must be so for this long, without a break, to be in force.")
    clear_after: Duration = Field(
        default="10s", description="It must not be so for this long, without a break, to be in force no longer."
    )
    strategies: list[Strategy] | None = Field(
        default=None,
        min_length=1,
        max_length=8,
        description="Tried in order instead of spec.strategies. Standbys are kept of the pools that are named by what is in force.",
    )
    requirements: Requirements | None = Field(
        default=None, description="What the strategies are chosen by instead of spec.requirements."
    )


MOST_COUNTED = 20
"""Recoveries that a budget may have: when each began is kept in the workload's status."""


class Budget(Model):
    """How many recoveries are made by themselves in a window of time that moves on."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                f"!self.within.matches(r'{DURATION_PATTERN}') || duration(self.within) >= duration('1s')",
                "within is at least 1s",
                ".within",
            ),
        )
    }

    recoveries: int = Field(ge=1, le=MOST_COUNTED, description="How many may begin in any such time.")
    within: Duration = Field(description="The length of the window, such as 1h.")

    @property
    def length(self) -> float:
        """The length of the window in seconds."""
        return seconds(self.within)

    @property
    def words(self) -> str:
        """It as people are told it."""
        return f"{self.recoveries} {'recovery' if self.recoveries == 1 else 'recoveries'} within {self.within}"


class StormGuard(Model):
    """When so many workloads fail at once that it looks like the network or the cluster, and not like any of them."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                f"!self.within.matches(r'{DURATION_PATTERN}') || duration(self.within) >= duration('1s')",
                "within is at least 1s",
                ".within",
            ),
        )
    }

    percent: int = Field(
        default=50, ge=1, le=99, description="More than so many percent of the policy's workloads must fail."
    )
    workloads: int = Field(default=3, ge=2, description="And at least so many of them.")
    within: Duration = Field(
        default="10s", description="Those that have failed in this time count too, whatever became of it."
    )
    hold_for: Duration = Field(
        default="2m", description="How long recoveries are held for it at most, also where nobody says that it is over."
    )


class Limits(Model):
    """Bounds on what is done automatically."""

    cooldown: Duration = Field(
        default="0s", description="Least time between the end of one recovery and the start of the next."
    )
    healthy_delay: Duration = Field(
        default="2s",
        description="How long an instance that took over must be healthy to count as recovered. One that fails sooner is the same failure, "
        "which goes on with the next strategy.",
    )
    budget: Budget | None = Field(
        default=None,
        description="How many recoveries are made by themselves in a window of time. Once it is spent, an instance that fails is fenced "
        "and nothing else is done, until the window has moved on or understudy resume says so. Absent: any number. See docs/limits.md.",
    )
    storm_guard: StormGuard | None = Field(
        default=None,
        description="While so many of the policy's workloads fail at once, no pod of a shared pool is taken and nothing is restarted. "
        "Standbys that are ready take over as ever. Absent: no guard. See docs/limits.md.",
    )


class SafeCommand(Model):
    """What a robot is told while nobody drives it."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                f"!self.every.matches(r'{DURATION_PATTERN}') || duration(self.every) >= duration('10ms')",
                "every is at least 10ms",
                ".every",
            ),
        )
    }

    topic: RosName = Field(description="The topic, one of the workload's outputs.")
    message: dict[str, Any] = Field(
        default_factory=dict,
        description="Fields of the message; the others keep their defaults. Without any, a Twist says to stand still. now is the "
        "present time where a field is a time.",
        json_schema_extra={"x-kubernetes-preserve-unknown-fields": True},
    )
    every: Duration = Field(default="100ms", description="How often it is sent.")


class Safety(Model):
    """What is done for the robot's safety while no instance is verified to be in control."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "self.commands.all(a, self.commands.exists_one(b, b.topic == a.topic))",
                "commands has the same topic twice",
                ".commands",
            ),
        )
    }

    commands: list[SafeCommand] = Field(
        min_length=1,
        max_length=8,
        description="What the robot is told meanwhile.",
    )
    after: Duration = Field(
        default="100ms",
        description="How long nobody has to be in control before it is told. An executing standby is faster, so that the robot "
        "doesn't brake for it.",
    )


class FailurePolicySpec(Model):
    """What healthy means, and what is done when it isn't."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "!has(self.degraded) || !has(self.degraded.actions) || self.degraded.actions.all(a, !has(a.prewarm) || "
                "self.strategies.exists(s, has(s.poolRef) && s.poolRef.name == a.prewarm.poolRef.name))",
                "prewarm names a pool that no strategy takes an instance from: name one that a Fallback strategy names",
                ".degraded.actions",
            ),
            (
                "self.strategies.all(s, s.type != 'Auto') || size(self.strategies) == 1",
                "Auto comes to a whole order: let it stand alone, or write all strategies out",
                ".strategies",
            ),
            (
                "self.strategies.all(s, s.type != 'Auto') || has(self.requirements)",
                "required for a strategy of type Auto, which goes by them",
                ".requirements",
            ),
            (
                "!has(self.situations) || self.situations.all(a, self.situations.exists_one(b, b.name == a.name))",
                "situations has the same name twice",
                ".situations",
            ),
            (
                "!has(self.situations) || self.strategies.exists(s, s.type == 'Auto') || self.situations.all(a, has(a.strategies))",
                "the policy's strategies are written out, so write out those of each situation too, in its strategies",
                ".situations",
            ),
            (
                "!has(self.situations) || self.strategies.all(s, s.type != 'Auto') || self.situations.all(a, has(a.requirements))",
                "the policy's strategies are left to be chosen (Auto), so say in each situation by which requirements",
                ".situations",
            ),
            (
                "self.priority != 'Safety' || !has(self.limits.budget)",
                "priority Safety says that limits don't delay a recovery, and a budget that is spent would: leave one of the two out",
                ".limits.budget",
            ),
            (
                "self.priority != 'Safety' || !has(self.limits.stormGuard)",
                "priority Safety says that limits don't delay a recovery, and a storm guard would: leave one of the two out",
                ".limits.stormGuard",
            ),
        )
    }

    monitoring: Monitoring = Field(description="What healthy means.")
    strategies: list[Strategy] = Field(
        min_length=1,
        max_length=8,
        description="Tried in order; the next one when one isn't available or doesn't verify in its time.",
    )
    requirements: Requirements | None = Field(
        default=None,
        description="What the order of strategies is chosen by where they are Auto. Where they are written out, only understudy recommend "
        "goes by it.",
    )
    situations: list[Situation] = Field(
        default_factory=list,
        max_length=4,
        description="Situations of the robot in which other strategies are in force, and so other standbys are kept. None: always the "
        "same. See docs/situations.md.",
    )
    degraded: Degraded | None = Field(
        default=None,
        description="What well means beyond healthy, and what is done while it isn't so. Absent: nothing is. See docs/degraded.md.",
    )
    state: State = Field(
        default_factory=State, description="State of a healthy instance that is kept for the one that takes over."
    )
    limits: Limits = Field(default_factory=Limits, description="Bounds on what is done automatically.")
    priority: Literal["Normal", "Safety"] = Field(
        default="Normal",
        description="Safety: limits don't delay a recovery. After none of the strategies verified, they are tried again in 2 s, however "
        "often that was so.",
    )
    safety: Safety | None = Field(
        default=None, description="What the robot is told while no instance is verified to be in control."
    )
    black_box: BlackBox | None = Field(
        default=None,
        description="Keep what the monitor received around each failure, as an MCAP file that understudy blackbox fetches. Absent: nothing "
        "is kept. See docs/blackbox.md.",
    )

    @property
    def auto(self) -> bool:
        """Whether its strategies are left to be chosen."""
        return any(strategy.type == "Auto" for strategy in self.strategies)

    @property
    def varies(self) -> bool:
        """Whether which strategies are in force depends on the workload, or on its situation: then the operator says."""
        return self.auto or bool(self.situations)

    @property
    def everywhere(self) -> list[tuple[str, Strategy]]:
        """All its strategies, those of its situations too, each with its path in the spec."""
        found = [(f"strategies[{i}]", one) for i, one in enumerate(self.strategies)]
        for i, situation in enumerate(self.situations):
            found += [(f"situations[{i}].strategies[{j}]", one) for j, one in enumerate(situation.strategies or ())]
        return found

    @property
    def recoveries(self) -> list[tuple[str, Procedure | None]]:
        """The procedures of all its strategies, each with its path in the spec."""
        return [(f"{path}.recovery", one.recovery) for path, one in self.everywhere]


class TreeInForce(Model):
    """The last health tree of the ConfigMap that loaded: monitors go by it, whatever becomes of the ConfigMap."""

    name: str = Field(description="Name of the ConfigMap that it was read from.")
    key: str = Field(description="The key that it was read from.")
    yaml: dict[str, Any] | None = Field(
        default=None,
        description="The tree, where it is written in the short form.",
        json_schema_extra={"x-kubernetes-preserve-unknown-fields": True},
    )
    xml: str | None = Field(default=None, description="The tree, where it is written as BehaviorTree.CPP 4 XML.")
    osc: str | None = Field(default=None, description="The tree, where it is written in OpenSCENARIO 2.")


class FailurePolicyStatus(Model):
    """What is so."""

    observed_generation: int | None = Field(default=None, description="Generation of the spec that was checked last.")
    workloads: int | None = Field(default=None, description="How many RobotWorkloads use it.")
    strategies: str | None = Field(default=None, description="The strategies in short, in order.")
    tree: TreeInForce | None = Field(
        default=None, description="The health tree in force, where spec.monitoring refers to a ConfigMap."
    )
    conditions: list[Condition] | None = Field(
        default=None,
        description="Accepted: the tree and the strategies can be followed. Storm, where limits.stormGuard is given: so many of its "
        "workloads fail at once that their monitors hold what can't help.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["type"]},
    )


def in_force(spec: FailurePolicySpec, status: Mapping[str, Any] | None) -> FailurePolicySpec | None:
    """The policy with its health tree: that of a ConfigMap as the operator has last put it into the policy's status.

    None where there is none yet.
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
    """The policy with the strategies in force: those ``chosen`` for a workload where it leaves that, or has situations.

    None where there are none that can be carried out before they are chosen.
    """
    if not spec.varies:
        return spec
    if chosen:
        return spec.model_copy(update={"strategies": list(chosen)})
    return None if spec.auto else spec

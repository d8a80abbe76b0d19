"""FailurePolicy: what healthy means, and what is done when it isn't."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from understudy.api.base import DURATION_PATTERN, LONGEST_TEXT, Duration, LocalReference, Model, rules
from understudy.api.conditions import Condition
from understudy.api.procedures import Procedure
from understudy.api.states import State


class Monitoring(Model):
    """What healthy means, as a behaviour tree, and when its verdict counts."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "has(self.yaml) || has(self.xml)",
                "a health tree is required: give exactly one of yaml (the short form) and xml (BehaviorTree.CPP 4)",
                ".yaml",
            ),
            (
                "!has(self.yaml) || !has(self.xml)",
                "the health tree is given as yaml already: give exactly one of yaml and xml",
                ".xml",
            ),
        )
    }

    yaml: dict[str, Any] | None = Field(
        default=None,
        min_length=1,
        description="The health tree in the short form: one node, such as parallel, sequence, selector or topic. See docs/trees.md.",
        json_schema_extra={"x-kubernetes-preserve-unknown-fields": True},
    )
    xml: str | None = Field(
        default=None,
        min_length=1,
        max_length=LONGEST_TEXT,
        description="The health tree instead as the text of a BehaviorTree.CPP 4 file, as Groot 2 writes it. See docs/trees.md.",
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
        if (self.yaml is None) == (self.xml is None):
            raise ValueError("give exactly one of yaml and xml")
        return self

    @property
    def form(self) -> Literal["yaml", "xml"]:
        """What the health tree is written in: the field that it stands in."""
        return "yaml" if self.yaml is not None else "xml"

    @property
    def tree(self) -> dict[str, Any] | str:
        """The health tree as it was written."""
        tree = self.yaml if self.yaml is not None else self.xml
        assert tree is not None, "one of them is given"
        return tree


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
                f"!self.verifyWithin.matches(r'{DURATION_PATTERN}') || duration(self.verifyWithin) >= duration('100ms')",
                "verifyWithin is at least 100ms",
                ".verifyWithin",
            ),
        )
    }

    type: Literal["Fallback", "Restart"] = Field(
        description="Fallback: an understudy from a pool takes over. Restart: the pod is deleted and a new one starts."
    )
    pool_ref: LocalReference | None = Field(
        default=None, description="The FallbackPool that the understudy comes from."
    )
    recovery: Procedure | None = Field(
        default=None,
        description="What is done to the instance that takes over, behind the closed gate, instead of the workload's bringUp. Kept "
        "state is restored first, unless the tree says where (restore_state).",
    )
    verify_within: Duration = Field(
        default="30s",
        description="How long it may take until outputs are seen from the new instance and from no other; then the next strategy is tried.",
    )


class Limits(Model):
    """Bounds on what is done automatically."""

    cooldown: Duration = Field(
        default="0s", description="Least time between the end of one recovery and the start of the next."
    )


class FailurePolicySpec(Model):
    """What healthy means, and what is done when it isn't."""

    monitoring: Monitoring = Field(description="What healthy means.")
    strategies: list[Strategy] = Field(
        min_length=1,
        max_length=8,
        description="Tried in order; the next one when one isn't available or doesn't verify in its time.",
    )
    state: State = Field(
        default_factory=State, description="State of a healthy instance that is kept for the one that takes over."
    )
    limits: Limits = Field(default_factory=Limits, description="Bounds on what is done automatically.")


class FailurePolicyStatus(Model):
    """What is so."""

    observed_generation: int | None = Field(default=None, description="Generation of the spec that was checked last.")
    workloads: int | None = Field(default=None, description="How many RobotWorkloads use it.")
    strategies: str | None = Field(default=None, description="The strategies in short, in order.")
    conditions: list[Condition] | None = Field(
        default=None,
        description="Accepted: the tree and the strategies can be followed.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["type"]},
    )

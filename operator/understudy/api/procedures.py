"""A procedure: a behaviour tree that is run once on an instance, from inside its pod, to bring it somewhere."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from understudy.api.base import Duration, Model


class Procedure(Model):
    """What is done to one instance, and the time that it has. It can be repeated: what is so already is left alone."""

    yaml: dict[str, Any] = Field(
        min_length=1,
        description="The tree in the short form: one node, such as sequence, set_lifecycle or call_service. See docs/trees.md.",
        json_schema_extra={"x-kubernetes-preserve-unknown-fields": True},
    )
    within: Duration = Field(default="60s", description="It fails when it isn't done in this time.")


class Check(Model):
    """What must hold of one instance, looked at again and again from inside its pod."""

    yaml: dict[str, Any] = Field(
        min_length=1,
        description="The tree in the short form, of conditions only, such as lifecycle_is or topic. See docs/trees.md.",
        json_schema_extra={"x-kubernetes-preserve-unknown-fields": True},
    )
    period: Duration = Field(default="1s", description="Time between two looks.")

"""Shared parts of the API models: camelCase on the wire, durations, and CEL rules."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic.alias_generators import to_camel
from pydantic_core import PydanticCustomError

from understudy.api.durations import DURATION_MESSAGE as DURATION_MESSAGE
from understudy.api.durations import DURATION_PATTERN as DURATION_PATTERN
from understudy.api.durations import LONGEST_TEXT as LONGEST_TEXT
from understudy.api.durations import seconds as seconds
from understudy.api.names import GROUP as GROUP
from understudy.api.nesting import DEEPEST, MOST_VALUES, has_too_many, is_too_deep
from understudy.api.plain_text import one_line
from understudy.api.ros_names import LONGEST_ROS_NAME, ROS_NAME_MESSAGE, ROS_NAME_PATTERN

VERSION = "v1alpha1"
API_VERSION = f"{GROUP}/{VERSION}"


def rules(*entries: tuple[str, str] | tuple[str, str, str]) -> dict[str, Any]:
    """Return ``json_schema_extra`` with CEL validation rules (KEP-2876).

    Each entry is a rule, a message and, if the rule is about one field of the object, the path of that field, such as ``.poolRef``. The API
    server reports the error under that path.
    """
    return {
        "x-kubernetes-validations": [
            {"rule": rule, "message": message} | ({"fieldPath": path[0]} if path else {})
            for rule, message, *path in entries
        ]
    }


ModelType = TypeVar("ModelType", bound="type[Model]")


def with_rules(*entries: tuple[str, str] | tuple[str, str, str]) -> Callable[[ModelType], ModelType]:
    """Give a model CEL validation rules, as :func:`rules` takes them."""

    def decorate(model: ModelType) -> ModelType:
        model.model_config = model.model_config | {"json_schema_extra": rules(*entries)}
        return model

    return decorate


def length(field: str, least: str, most: str = "", *, required: bool = True) -> tuple[str, str, str]:
    """Return the rule for the bounds of a duration; ``required`` is whether the duration is always present."""
    bounds = f"duration(self.{field}) >= duration('{least}')"
    if most:
        bounds = f"({bounds} && duration(self.{field}) <= duration('{most}'))"
    words = f"from {least} to {most}" if most else f"at least {least}"
    absent = "" if required else f"!has(self.{field}) || "
    return f"{absent}!self.{field}.matches(r'{DURATION_PATTERN}') || {bounds}", f"{field} must be {words}", f".{field}"


def unique(field: str, key: str, message: str, *, required: bool = False) -> tuple[str, str, str]:
    """Return the rule for a list whose items differ in a key; ``required`` is whether the list is always present."""
    rule = f"self.{field}.all(a, self.{field}.exists_one(b, b.{key} == a.{key}))"
    return rule if required else f"!has(self.{field}) || {rule}", message, f".{field}"


def matching(pattern: str, message: str, **more: Any) -> Any:
    """Return the field of a text with a pattern; ``more`` are further arguments of ``Field``."""
    return Field(pattern=pattern, json_schema_extra=pattern_rule(pattern, message), **more)


def pattern_rule(pattern: str, message: str) -> dict[str, Any]:
    """Return the rule for a text with a pattern. The error shows the value and the expected form.

    The error for a schema's own ``pattern`` shows only the expression, so CRD generation replaces it by this rule.
    """
    assert not set("'\\") & set(message), "the message is embedded in a CEL text"
    rule = {
        "rule": f"self.matches(r'{pattern}')",
        "message": message,
        "messageExpression": f"""'"' + self + '": {message}'""",
    }
    return {"x-kubernetes-validations": [rule]}


Duration = Annotated[str, matching(DURATION_PATTERN, DURATION_MESSAGE, max_length=32)]
"""A length of time such as ``500ms``, ``1.5s`` or ``1m30s``."""


PERCENTAGE_PATTERN = r"^([1-9][0-9]?([.][0-9]{1,6})?|0[.][0-9]{0,5}[1-9][0-9]{0,5})%$"

Percentage = Annotated[
    str, matching(PERCENTAGE_PATTERN, "write a percentage above 0% and below 100%, such as 1% or 0.5%", max_length=16)
]
"""A percentage such as ``1%``, neither 0% nor 100%."""


def fraction(percentage: str) -> float:
    """Return a percentage such as ``0.5%`` as a number from 0 to 1."""
    return float(percentage.removesuffix("%")) / 100


def _bounded(value: dict[str, Any]) -> dict[str, Any]:
    if has_too_many(value):
        raise PydanticCustomError(
            "size", "has more than {most} values in its mappings and lists; use fewer", {"most": MOST_VALUES}
        )
    if is_too_deep(value):
        raise PydanticCustomError(
            "nesting",
            "has mappings and lists nested more than {deepest} levels deep; nest them less deeply",
            {"deepest": DEEPEST},
        )
    return value


BOUNDED = AfterValidator(_bounded)
"""The bounds on the depth and the number of values of a field that keeps unknown content."""

UnknownContent = Annotated[dict[str, Any], BOUNDED]
"""A field that keeps unknown content."""


REPORTED_MOST = 4096
"""Most characters of a text in a status, except the messages of conditions."""


def reported(text: Any) -> Any:
    """Return a text as a status contains it: in one line, with control characters escaped, and cut at its end."""
    return one_line(text, REPORTED_MOST) if isinstance(text, str) else text


ReportedText = Annotated[str, BeforeValidator(reported)]
"""A text in a status. It may quote others, such as the log of a robot's node."""


class Model(BaseModel):
    """Base of every object in the API. Field names are camelCase on the wire. In a CRD, the docstrings of models and fields are
    their descriptions.

    The API server's schema refuses unknown fields. They are ignored here, so that an older operator can read what a newer one
    stored.
    """

    model_config = ConfigDict(alias_generator=to_camel, populate_by_name=True, extra="ignore")

    def to_wire(self) -> dict[str, Any]:
        """Return the object as the API server stores it."""
        return self.model_dump(by_alias=True, exclude_none=True, mode="json")


OBJECT_NAME_PATTERN = r"^[a-z0-9]([-a-z0-9.]*[a-z0-9])?$"
OBJECT_NAME_MESSAGE = (
    "the name of an object must consist of lower-case letters, digits, dashes and dots, and must begin and end "
    "with a letter or digit"
)

ObjectName = Annotated[str, matching(OBJECT_NAME_PATTERN, OBJECT_NAME_MESSAGE, min_length=1, max_length=253)]
"""The name of a Kubernetes object (a DNS subdomain)."""

RosName = Annotated[str, matching(ROS_NAME_PATTERN, ROS_NAME_MESSAGE, max_length=LONGEST_ROS_NAME)]
"""A fully qualified name of a topic, service, action or node."""


class LocalReference(Model):
    """The name of another object in the same namespace."""

    name: ObjectName
    """Name of the object, in the same namespace."""

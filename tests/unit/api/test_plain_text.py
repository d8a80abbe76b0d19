"""Texts of robots, pods and users get into conditions, Events and recoveries without control characters, and not without end."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, get_args

import pytest
from pydantic import BaseModel, TypeAdapter

from understudy.api.base import REPORTED_MOST
from understudy.api.conditions import MESSAGE_MOST, Condition, condition
from understudy.api.kinds.failure_policy import FailurePolicyStatus
from understudy.api.kinds.fallback_pool import FallbackPoolStatus
from understudy.api.kinds.recording_spec import Recording
from understudy.api.kinds.robot_workload import RobotWorkloadStatus
from understudy.api.plain_text import one_line, plain
from understudy.failover.progress import Progress

HOSTILE = "lost\x1b[2J\x1b]0;owned\x07\n  robot-18: \x9b31m\u202ehealthy\r\n\ud800"
ESCAPED = r"lost\x1b[2J\x1b]0;owned\x07 robot-18: \x9b31m\u202ehealthy \ud800"
REPORTS = (Condition, RobotWorkloadStatus, FailurePolicyStatus, FallbackPoolStatus, Recording, Progress)


def test_control_characters_are_escaped_and_lines_are_joined() -> None:
    assert one_line(HOSTILE, 500) == ESCAPED
    assert one_line(ESCAPED, 500) == ESCAPED, "once"
    assert one_line("tab\tand\u2028line", 500) == "tab and line"
    assert one_line("two  blanks, ü and 日本", 500) == "two  blanks, ü and 日本"
    assert one_line("x" * 100, 10) == "x" * 9 + "…"
    assert plain("a\nb") == r"a\nb"


def test_a_condition_has_no_control_characters_and_is_bounded() -> None:
    assert condition("Healthy", False, "Failed", HOSTILE).message == ESCAPED
    assert len(condition("Healthy", False, "Failed", "\x1b" * MESSAGE_MOST).message) == MESSAGE_MOST


def test_a_recovery_has_no_control_characters_and_is_bounded() -> None:
    progress = Progress.begin(HOSTILE, last_healthy=1.0, detected=2.0)
    assert progress.reason == ESCAPED, "Events and conditions quote it"
    assert progress.to_recovery(1).reason == ESCAPED
    assert len(Progress.begin("x" * 10**6, last_healthy=1.0, detected=2.0).to_recovery(1).reason) == REPORTED_MOST
    record = progress.model_copy(update={"reason": HOSTILE.replace("\ud800", "")}).record()
    assert Progress.of_record(record).reason == ESCAPED.removesuffix(r" \ud800"), "that of an older monitor"


def _models(model: type[BaseModel], seen: set[type[BaseModel]]) -> Iterator[type[BaseModel]]:
    if model in seen:
        return
    seen.add(model)
    yield model
    for field in model.model_fields.values():
        for inner in _inner(field.annotation):
            yield from _models(inner, seen)


def _inner(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _inner(argument)


_FIELDS = sorted(
    {
        (model.__name__, name): (model, name)
        for model in itertools.chain.from_iterable(_models(report, set()) for report in REPORTS)
        for name in model.model_fields
        if name in ("message", "reason") and model is not Condition
    }.items()
)


@pytest.mark.parametrize(("model", "field"), [found for _, found in _FIELDS], ids=["-".join(key) for key, _ in _FIELDS])
def test_every_message_and_reason_of_a_status_is_escaped_and_bounded(model: type[BaseModel], field: str) -> None:
    """A new field of that name cannot forget it."""
    info = model.model_fields[field]
    read = TypeAdapter(info.rebuild_annotation() if hasattr(info, "rebuild_annotation") else info.annotation)
    assert read.validate_python(HOSTILE) == ESCAPED
    assert len(read.validate_python("x" * 10**6)) == REPORTED_MOST

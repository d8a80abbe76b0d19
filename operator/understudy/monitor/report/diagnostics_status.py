"""Converts the workload's state to a status of ``/diagnostics`` (REP 107); pure.

Each workload has one status, with the leaves of its health tree as values: an alarm that counts statuses counts a failure once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from understudy.api.health_reasons import why
from understudy.monitor.notices import PublishedStatus
from understudy.ros.actions.diagnostics_topic import Status
from understudy.trees.core.snapshots import Snapshot
from understudy.trees.leaves.diagnostics import OWN

OK, WARN, ERROR, STALE = range(4)

LEVELS: Mapping[str, int] = {
    "Healthy": OK,
    "Starting": WARN,
    "Degraded": WARN,
    "Failed": ERROR,
    "Recovering": ERROR,
    "Unknown": STALE,
}

LONGEST = 400
"""Maximum length of a message or a value, in characters. The text about a failed recovery may be longer than a line of a table."""


class WorkloadState(NamedTuple):
    """The state of a workload at one moment. It is cheap to create, because it is created during a failover."""

    at: float
    """Unix seconds."""
    health: str
    message: str
    active: str
    epoch: int
    planned: bool
    """Whether a degraded instance is being handed over, without a failure."""

    @property
    def level(self) -> int:
        """The health as a level of diagnostic_msgs/msg/DiagnosticStatus."""
        return WARN if self.planned else LEVELS.get(self.health, STALE)


class Details(NamedTuple):
    """Further values of the diagnostics."""

    policy: str
    standby: str
    """The operator's text, such as ``Executing (1/1)``."""
    kept: Mapping[str, float]
    """By the name of each part of the kept state, when it was captured (Unix seconds)."""
    tree: Snapshot | None


def workload_state(published: PublishedStatus, at: float) -> WorkloadState:
    """Return the state in the published status."""
    planned = published.health == "Recovering" and published.reason("Recovering") == "Rescheduling"
    message = why(published.health, published.active, published.conditions)
    return WorkloadState(at, published.health, message, published.active, published.gate.epoch, planned)


def status(namespace: str, workload: str, now: WorkloadState, published: PublishedStatus, more: Details) -> Status:
    """Return the diagnostics of a workload at one moment."""
    values = _values(now, published, more)
    return Status(
        now.level,
        f"{OWN}{workload}",
        _short(now.message),
        f"{namespace}/{workload}",
        [(key, _short(value)) for key, value in values],
    )


def _values(now: WorkloadState, published: PublishedStatus, more: Details) -> Iterator[tuple[str, str]]:
    yield "health", now.health
    yield "in control", now.active
    yield "gate epoch", str(now.epoch)
    yield "policy", more.policy
    yield "if it failed now", published.strategy
    yield "standby", more.standby
    yield "recoveries", str(published.count)
    last = published.last
    if last is not None:
        yield "last recovery", f"{last.result}{f' by {last.strategy}' if last.strategy else ''}"
        yield "last recovery: reason", last.reason
        yield "last recovery: detected", last.moments.detected or ""
        if last.recovery_seconds is not None:
            yield "last recovery: took (s)", f"{last.recovery_seconds:.3f}"
        if last.parts is not None:
            for part, seconds in last.parts.model_dump().items():
                yield f"last recovery: {part} (s)", f"{seconds:.3f}"
    for name, taken in more.kept.items():
        yield f"kept {name}: age (s)", f"{max(0.0, now.at - taken):.1f}"
    if more.tree is not None:
        yield from _leaves(more.tree)


def _leaves(node: Snapshot) -> Iterator[tuple[str, str]]:
    if "children" not in node:
        yield f"leaf {node['name']}", f"{node['state']}{': ' if node['reason'] else ''}{node['reason']}"
    for child in node.get("children", ()):
        yield from _leaves(child)


def _short(text: str) -> str:
    """Return the text in one line, with at most LONGEST characters."""
    text = " ".join(text.split())
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."

"""Formats recoveries as text: all of them to one scale, and each with its parts, moments and attempts. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from understudy.api.kinds.robot_workload import Attempt, Recovery
from understudy.api.plain_text import plain
from understudy.cli.common.text.time_bars import LEGEND, MOMENTS, NAMES, bar, length, short, stacked
from understudy.cli.common.text.tree_text import coloured
from understudy.cli.common.text.wording import age, clock, counted, unix, wrapped

UNBOUNDED = 100
"""Width in characters if the output is not a terminal."""

_LABEL = 17
"""Width before a bar: indentation and label."""
_FIGURE = 9
_LEAST = 10


def lines(
    name: str, count: int, recoveries: Sequence[Recovery], *, last: int, now: float, columns: int | None, colours: bool
) -> Iterator[str]:
    """Format a comparison of all recorded recoveries, and the ``last`` ones in detail. They are newest first, as in the status."""
    if not recoveries:
        yield f"{plain(name)}: no recoveries yet"
        return
    width = columns or UNBOUNDED
    kept = f"; the last {len(recoveries)} are recorded" if count > len(recoveries) else ""
    yield f"{plain(name)}: {counted(count, 'recovery', 'recoveries')}{kept}"
    if len(recoveries) > 1:
        yield ""
        yield from compared(recoveries, now=now, columns=width, colours=colours)
    for recovery in recoveries[:last]:
        yield ""
        yield from detailed(recovery, now=now, columns=width, colours=colours)


def compared(recoveries: Sequence[Recovery], *, now: float, columns: int, colours: bool) -> Iterator[str]:
    """Format a line for each recovery, all to one scale."""
    heads = [_short_head(recovery, now) for recovery in recoveries]
    label = max(map(len, heads)) + 2
    room = max(_LEAST, columns - label - _FIGURE)
    longest = max(sum(parts_of(recovery).values()) for recovery in recoveries)
    for recovery, head in zip(recoveries, heads, strict=True):
        parts = parts_of(recovery)
        total = sum(parts.values())
        drawn = stacked(parts, longest / room) if longest > 0 else ""
        state = "" if recovery.result == "Recovered" else "Failed"
        yield f"{coloured(head.ljust(label), state, colours=colours and bool(state))}{drawn:{room}}{length(total):>{_FIGURE}}"
    yield from wrapped(LEGEND, columns, indent=label if label + len(LEGEND) <= columns else 2)


def detailed(recovery: Recovery, *, now: float, columns: int, colours: bool) -> Iterator[str]:
    """Format one recovery with everything that is recorded about it."""
    start = start_of(recovery)
    head, ended = f"#{recovery.number}", outcome(recovery)
    if start:
        head += f"  {clock(start)} ({age(start, now)} ago)"
    state = "Healthy" if recovery.result == "Recovered" else "Failed"
    between = "  " if len(head) + 2 + len(ended) <= columns else "\n    "
    yield from f"{head}{between}{coloured(plain(ended), state, colours=colours)}".split("\n")
    yield from wrapped(recovery.reason, columns, indent=4)
    yield from _bars(recovery, columns)
    for label, text in (
        ("control", _control(recovery)),
        ("moments", " · ".join(_moments(recovery, start))),
        ("state", " · ".join(_state(recovery))),
        *(("failed", tried(attempt)) for attempt in recovery.attempts if attempt.result != "Verified"),
        (
            "resumed",
            "the monitor restarted during the recovery and completed it" if recovery.resumed else "",
        ),
    ):
        if text:
            first, *others = wrapped(text, columns, indent=_LABEL)
            yield f"    {label:{_LABEL - 4}}{first.lstrip()}"
            yield from others


def _bars(recovery: Recovery, columns: int) -> Iterator[str]:
    parts = parts_of(recovery)
    total = sum(parts.values())
    room = max(_LEAST, columns - _LABEL - _FIGURE - 1)
    begin = 0.0
    for part, name in NAMES.items():
        seconds = parts.get(part, 0.0)
        drawn = bar(begin, seconds, total / room) if total > 0 else ""
        yield f"    {name:{_LABEL - 4}}{drawn:{room + 1}}{length(seconds):>{_FIGURE}}"
        begin += seconds


def parts_of(recovery: Recovery) -> dict[str, float]:
    """Return the parts of the recovery time in seconds, by name; empty if they were not recorded."""
    return recovery.parts.model_dump() if recovery.parts is not None else {}


def start_of(recovery: Recovery) -> str | None:
    """Return the time from which the recovery time counts."""
    return recovery.moments.last_healthy or recovery.moments.detected


def _short_head(recovery: Recovery, now: float) -> str:
    start = start_of(recovery)
    how = recovery.strategy if recovery.result == "Recovered" else recovery.result.upper()
    return f"#{recovery.number}  {f'{age(start, now)} ago' if start else '':10}  {how}"


def outcome(recovery: Recovery) -> str:
    """Describe the result in a few words."""
    if recovery.result == "Running":
        return "under way"
    if recovery.result == "Failed":
        return (
            "NOT switched: the former instance kept control"
            if recovery.switchover is not None
            else "FAILED: no strategy was verified"
        )
    what = "planned switchover" if recovery.planned else "recovered"
    took = f" in {length(recovery.recovery_seconds)}" if recovery.recovery_seconds is not None else ""
    return f"{what}{took} by {recovery.strategy}"


def _moments(recovery: Recovery, start: str | None) -> Iterator[str]:
    moments = recovery.moments.to_wire()
    for name, text in MOMENTS:
        if start and name in moments:
            after = unix(moments[name]) - unix(start)  # preparations of a switchover come before
            yield f"{text} {'+' if after >= 0 else '-'}{length(abs(after))}"


def _control(recovery: Recovery) -> str:
    """Describe the former and the new active instance, and when the monitor saw the first command."""
    if recovery.result != "Recovered":
        return ""
    pods, moments = short([recovery.from_pod, recovery.to_pod]), recovery.moments
    text = f"{pods[recovery.from_pod] or 'none'} → {pods[recovery.to_pod] or 'none'}, gate epoch {recovery.epoch}"
    if moments.first_output is None or moments.routed is None:
        return text
    after = unix(moments.first_output) - unix(moments.routed)
    return f"{text}, first command {length(abs(after))} {'after' if after >= 0 else 'before'} the switch was confirmed"


def _state(recovery: Recovery) -> Iterator[str]:
    for entry in recovery.state:
        if not entry.restored:
            yield f"{entry.name} NOT restored: {entry.message}"
            continue
        old = f" {length(entry.age_seconds)} old" if entry.age_seconds is not None else ""
        carried = f", propagated by {entry.carried_metres:.2f} m" if entry.carried_metres is not None else ""
        yield f"{entry.name}{old}{carried}{f' ({entry.message})' if entry.message else ''}"


def tried(attempt: Attempt) -> str:
    """Describe a failed attempt and its reason."""
    how = "not verified" if attempt.result == "NotVerified" else "not available"
    return f"{attempt.strategy}{f' with {attempt.pod}' if attempt.pod else ''}: {how}: {attempt.message}"

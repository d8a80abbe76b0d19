"""Recoveries as text: a bar to scale for each part, the moments, and what the robot saw."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from understudy.cli.common.text.time_bars import LEGEND, MOMENTS, NAMES, bar, length, short, stacked
from understudy_demo.recovery import PARTS, Recovered
from understudy_demo.robotview import Handover

_LABEL = 13


def render(recovered: Recovered, handover: Handover | None, *, width: int = 46) -> str:
    """One recovery as lines of text. ``width`` is that of its longest bar."""
    names = short([recovered.old, recovered.new])
    old, new = names[recovered.old] or "no pod", names[recovered.new] or "no pod"
    lines = [_heading(recovered)]
    total = sum(recovered.parts.values())
    notes = {"detection": recovered.reason, "cluster": f"gate epoch {recovered.epoch}: {old} → {new}"}
    begin = 0.0
    for part in PARTS:
        if part not in recovered.parts:
            continue
        seconds = recovered.parts[part]
        drawn = bar(begin, seconds, total / width) if total > 0 else ""
        lines.append(
            f"    {NAMES[part]:{_LABEL}}{drawn:{width + 1}} {length(seconds):>8}  {notes.get(part, '')}".rstrip()
        )
        begin += seconds
    if recovered.start is not None:
        at = [
            f"{text} +{length(recovered.moments[name] - recovered.start)}"
            for name, text in MOMENTS
            if name in recovered.moments
        ]
        lines.append(f"    {'moments':{_LABEL}}{' · '.join(at)}")
    if handover is not None:
        lines += [
            f"    {label:{_LABEL}}{text}"
            for label, text in zip(("robot", ""), _robot(recovered, handover, old, new), strict=False)
        ]
    return "\n".join(lines)


def _heading(recovered: Recovered) -> str:
    start = recovered.start
    clock = datetime.fromtimestamp(start).strftime("%H:%M:%S") if start is not None else "--:--:--"
    if recovered.result != "Recovered":
        return f"#{recovered.number}  {clock}  {recovered.result}: {recovered.reason}"
    seconds = sum(recovered.parts.values()) if recovered.seconds is None else recovered.seconds
    return f"#{recovered.number}  {clock}  recovered in {length(seconds)} by {recovered.strategy}"


def _robot(recovered: Recovered, handover: Handover, old: str, new: str) -> list[str]:
    start = recovered.start
    if start is None or handover.first_new is None:
        return [f"no command of {new} arrived"]
    routed = recovered.moments.get("routed")
    since = ""
    if routed is not None:
        after = handover.first_new - routed
        since = f", {length(abs(after))} {'after' if after >= 0 else 'before'} routed"
    at = f"at {_signed(handover.first_new - start)}{since}"
    first = (
        f"the first command of {new} arrived {at}"
        if handover.gap is None
        else f"no command for {length(handover.gap)} before the first one of {new} ({at})"
    )
    last = "" if handover.last_old is None else f" (the last at {_signed(handover.last_old - start)})"
    late = f"{_commands(len(handover.late))} of {old} arrived up to {length(handover.overlap)} later"
    overlap = late if handover.late else f"no command of {old} arrived later"
    early = _commands(len(handover.early)) if handover.early else "no command"
    return [first, f"overlap: {overlap}{last}; early: {early} of {new} before the switch"]


def _commands(number: int) -> str:
    return "1 command" if number == 1 else f"{number} commands"


def _signed(seconds: float) -> str:
    return f"+{length(seconds)}" if seconds >= 0 else f"-{length(-seconds)}"


def compare(recoveries: Sequence[Recovered], *, width: int = 60) -> str:
    """The recoveries under each other, all to one scale, each bar in its four parts."""
    longest = max((sum(r.parts.values()) for r in recoveries), default=0.0)
    if longest <= 0:
        return ""
    lines = []
    label = max(len(r.strategy) for r in recoveries) + 2
    for recovered in recoveries:
        drawn, total = stacked(recovered.parts, longest / width), sum(recovered.parts.values())
        lines.append(f"    {recovered.strategy:{label}}{drawn:{width}}  {length(total):>8}")
    return "\n".join([*lines, f"    {'':{label}}{LEGEND}"])

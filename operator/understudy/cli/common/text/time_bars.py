"""Durations as bars and as text. Uses the standard library only, because the demo imports it too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

NAMES = {"detection": "detection", "cluster": "cluster", "startup": "start-up", "reinitialization": "re-init"}
"""Labels of the four parts of a recovery time (equation 1 of the paper), in order."""

MOMENTS = (
    ("detected", "detected"),
    ("held", "deferred by the budget"),
    ("released", "released"),
    ("queued", "waits for a pod"),
    ("claimed", "claimed"),
    ("lastOutput", "last command of the former instance"),
    ("fenced", "fenced"),
    ("started", "started"),
    ("ready", "ready"),
    ("routed", "routed"),
    ("firstOutput", "first command seen"),
    ("verified", "recovered"),
)
"""Labels of the moments of a recovery, in order."""

_GLYPHS = {"detection": "░", "cluster": "█", "startup": "▓", "reinitialization": "▒"}
_EIGHTHS = " ▏▎▍▌▋▊▉"

LEGEND = "   ".join(f"{_GLYPHS[part]} {name}" for part, name in NAMES.items())


def length(seconds: float) -> str:
    """Format a duration in seconds with its significant digits: 0, 0.4 ms, 6 ms, 503 ms, 2.91 s."""
    milli = seconds * 1000
    if abs(milli) < 0.05:
        return "0"
    if abs(milli) < 9.95:
        return f"{milli:.1f} ms".replace(".0 ms", " ms")
    return f"{milli:.0f} ms" if abs(milli) < 999.5 else f"{seconds:.2f} s"


def bar(start: float, seconds: float, scale: float) -> str:
    """Draw a bar from ``start`` for ``seconds``, with ``scale`` seconds per character.

    Its length is exact to an eighth of a character, its start to half a character.
    """
    if seconds <= 0:
        return ""
    full, rest = divmod(max(1, round(seconds / scale * 8)), 8)
    return " " * round(start / scale) + "█" * full + (_EIGHTHS[rest] if rest else "")


def stacked(parts: Mapping[str, float], scale: float) -> str:
    """Draw one bar of all parts (in seconds), each with its own glyph (:data:`LEGEND`), with ``scale`` seconds per character."""
    drawn, end = "", 0.0
    for part in NAMES:
        end += parts.get(part, 0.0)
        drawn += _GLYPHS[part] * (round(end / scale) - len(drawn))
    return drawn


def short(pods: Sequence[str]) -> dict[str, str]:
    """Shorten pod names to their suffixes, such as ``…-7k2xq``; keep them whole if the suffixes are not distinct."""
    endings = {pod: pod.rpartition("-")[2] for pod in pods}
    distinct = len(set(endings.values())) == len(endings) and all(len(ending) >= 5 for ending in endings.values())
    return {pod: f"…-{ending}" if distinct and ending != pod else pod for pod, ending in endings.items()}

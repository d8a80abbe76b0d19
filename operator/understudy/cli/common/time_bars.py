"""Lengths of time as bars to scale and as figures. Needs nothing but the standard library: the demo draws with it too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

NAMES = {"detection": "detection", "cluster": "cluster", "startup": "start-up", "reinitialization": "re-init"}
"""The four parts of a recovery time (equation 1 of the paper), in their order, as they are called beside a bar."""

MOMENTS = (
    ("detected", "detected"),
    ("held", "held by the budget"),
    ("released", "released"),
    ("queued", "waits for a pod"),
    ("claimed", "claimed"),
    ("lastOutput", "last command of the former"),
    ("fenced", "fenced"),
    ("started", "started"),
    ("ready", "ready"),
    ("routed", "routed"),
    ("firstOutput", "first command seen"),
    ("verified", "recovered"),
)
"""What a recovery's moments are called, in their order."""

_GLYPHS = {"detection": "░", "cluster": "█", "startup": "▓", "reinitialization": "▒"}
_EIGHTHS = " ▏▎▍▌▋▊▉"

LEGEND = "   ".join(f"{_GLYPHS[part]} {name}" for part, name in NAMES.items())


def length(seconds: float) -> str:
    """A length of time with the digits that matter: 0, 0.4 ms, 6 ms, 503 ms, 2.91 s."""
    milli = seconds * 1000
    if abs(milli) < 0.05:
        return "0"
    if abs(milli) < 9.95:
        return f"{milli:.1f} ms".replace(".0 ms", " ms")
    return f"{milli:.0f} ms" if abs(milli) < 999.5 else f"{seconds:.2f} s"


def bar(start: float, seconds: float, scale: float) -> str:
    """A bar from ``start`` for ``seconds``, with ``scale`` seconds to a character.

    Its length is right to an eighth of a character, its beginning to half of one.
    """
    if seconds <= 0:
        return ""
    full, rest = divmod(max(1, round(seconds / scale * 8)), 8)
    return " " * round(start / scale) + "█" * full + (_EIGHTHS[rest] if rest else "")


def stacked(parts: Mapping[str, float], scale: float) -> str:
    """One bar of all parts (in seconds), each drawn in its own way (:data:`LEGEND`), with ``scale`` seconds to a character."""
    drawn, end = "", 0.0
    for part in NAMES:
        end += parts.get(part, 0.0)
        drawn += _GLYPHS[part] * (round(end / scale) - len(drawn))
    return drawn


def short(pods: Sequence[str]) -> dict[str, str]:
    """Pod names by their endings, such as ``…-7k2xq``; whole where those don't tell them apart."""
    endings = {pod: pod.rpartition("-")[2] for pod in pods}
    told = len(set(endings.values())) == len(endings) and all(len(ending) >= 5 for ending in endings.values())
    return {pod: f"…-{ending}" if told and ending != pod else pod for pod, ending in endings.items()}

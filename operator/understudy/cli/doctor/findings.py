"""The findings of ``understudy doctor``: a line for each check, with a remedy below it if something is wrong."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from understudy.api.plain_text import plain
from understudy.cli.common.text.tree_text import coloured
from understudy.cli.common.text.wording import counted, listed, wrapped

Level = Literal["OK", "WARN", "FAIL"]

_STATES: dict[Level, str] = {"OK": "Healthy", "WARN": "Degraded", "FAIL": "Failed"}
_LABEL = "cure: "


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    check: str
    level: Level
    found: str
    cure: str = ""
    """What to do about it; empty if all is well."""


def lines(findings: Sequence[Finding], *, columns: int | None, colours: bool) -> Iterator[str]:
    """Format the findings in the order in which they were made, and a summary."""
    width = max((len(plain(finding.check)) for finding in findings), default=0)
    hanging = width + len("FAIL") + 4
    for finding in findings:
        level = coloured(finding.level.ljust(len("FAIL")), _STATES[finding.level], colours=colours)
        first, *others = wrapped(finding.found, columns, indent=hanging)
        yield f"{level}  {plain(finding.check):{width}}  {first.lstrip()}"
        yield from others
        if finding.cure:
            yield from wrapped(f"{_LABEL}{finding.cure}", columns, indent=hanging, hanging=hanging + len(_LABEL))
    yield ""
    yield summary(findings)


def summary(findings: Sequence[Finding]) -> str:
    """Return how many findings there are of each state."""
    fail, warn = (sum(finding.level == level for finding in findings) for level in ("FAIL", "WARN"))
    problems = listed((f"{fail} failed" if fail else "", counted(warn, "warning") if warn else ""))
    return f"{counted(len(findings), 'check')}: {problems or 'no problem found'}"


def to_wire(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the findings for scripts."""
    return {"findings": [asdict(finding) for finding in findings]}


def is_well(findings: Sequence[Finding]) -> bool:
    """Return whether no check failed."""
    return all(finding.level != "FAIL" for finding in findings)

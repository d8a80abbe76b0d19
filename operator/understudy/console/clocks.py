"""How far clocks differ: those of the nodes on which the doctor's pods are, that of the API server, and this machine's."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from typing import Any

from understudy.console.drawing import rough
from understudy.console.findings import Finding
from understudy.console.proxying import Api
from understudy.console.sessions import Session

CHECK = "clocks"

NOTICED = 0.1
"""Seconds between two clocks from which on ages, `dependsOn` and transforms are told wrong (docs/dependencies.md, docs/trees.md)."""

WRONG = 5.0
"""Seconds from which on nothing that has a time in it is right."""

ASKED = 7
"""Times that a clock is asked; the quickest answer tells it best."""

_TICK_WITHIN = 2.5
_TICK_LOOK = 0.01


@dataclass(frozen=True)
class Clock:
    """By how much a clock is ahead of this machine's, in seconds, and how sure that is."""

    ahead: float
    give: float


def of_session(talk: Session) -> Clock:
    """The clock of a pod's node."""
    found = []
    for _ in range(ASKED):
        asked = time.time()
        told = talk.ask("clock")
        answered = time.time()
        found.append(Clock(told - (asked + answered) / 2, (answered - asked) / 2))
    return min(found, key=lambda clock: clock.give)


def of_api_server(api: Api) -> Clock | None:
    """The API server's clock, by the moment in which its second changes; None where it doesn't tell."""
    end, before = time.monotonic() + _TICK_WITHIN, None
    while time.monotonic() < end:
        answer = api.request("GET", "/version")
        if not answer.date:
            return None
        if before is not None and answer.date != before.date:
            # The second began after the answer before was on its way, and before this one was.
            early, late = before.asked, answer.answered
            second = parsedate_to_datetime(answer.date).timestamp()
            return Clock(second - (early + late) / 2, (late - early) / 2)
        before = answer
        time.sleep(_TICK_LOOK)
    return None


def judge(nodes: Mapping[str, Clock], api_server: Clock | None) -> Finding:
    """What the clocks of these nodes, and of the API server, come to. This machine's has only to do with what is shown on it."""
    known = {**nodes, **({"the API server": api_server} if api_server is not None else {})}
    if len(known) < 2:
        return Finding(
            CHECK, "WARN", "there is only one clock to look at", "run it where pods may be made on two nodes"
        )
    first, last = min(known, key=lambda n: known[n].ahead), max(known, key=lambda n: known[n].ahead)
    apart = known[last].ahead - known[first].ahead
    give = known[last].give + known[first].give
    among = f"{', '.join(known)}; this machine's is {_of_ours(known.values())}"
    if apart - give <= NOTICED:
        return Finding(CHECK, "OK", f"at most {rough(apart + give)} apart ({among})")
    return Finding(
        CHECK,
        "FAIL" if apart - give > WRONG else "WARN",
        f"that of {last} is {rough(apart)} ahead of that of {first}, give or take {rough(give)} ({among})",
        f"keep the clocks of all machines in step (chrony or another NTP client): what is more than {rough(NOTICED)} apart makes ages of "
        "messages and state wrong, and the order of failures of workloads that depend on each other",
    )


def _of_ours(clocks: Iterable[Clock]) -> str:
    ahead = [clock.ahead for clock in clocks]
    mean = sum(ahead) / len(ahead)
    return f"{rough(abs(mean))} {'behind' if mean > 0 else 'ahead'}"


def to_wire(nodes: Mapping[str, Clock]) -> dict[str, Any]:
    """For scripts: by how many seconds each is ahead of this machine's."""
    return {name: round(clock.ahead, 4) for name, clock in nodes.items()}

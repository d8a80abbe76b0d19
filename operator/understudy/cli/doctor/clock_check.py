"""How far clocks differ: those of the nodes, that of the API server, and this machine's.

The nodes of the doctor's pods are asked. Every other one writes its time into a Lease each ten seconds, which is seen when it comes.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from typing import Any

from understudy.cli.common.errors import CommandError
from understudy.cli.common.kubectl_proxy import Api
from understudy.cli.common.pod_session import Session
from understudy.cli.common.tree_text import rough
from understudy.cli.common.wording import unix
from understudy.cli.doctor.findings import Finding
from understudy.kube.client import LEASES

CHECK = "clocks"

NOTICED = 0.1
"""Seconds between two clocks from which on ages, `dependsOn` and transforms are told wrong (docs/dependencies.md, docs/trees.md)."""

WRONG = 5.0
"""Seconds from which on nothing that has a time in it is right."""

ASKED = 7
"""Times that a clock is asked; the quickest answer tells it best."""

LOOK = 0.5
"""Seconds between two looks at the Leases of the nodes, by half of which their clocks are told."""

MOST = 4
"""Clocks that are named, where there are many."""

_NODE_LEASES = LEASES.path("kube-node-lease")
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


class OfNodes:
    """Looks at the nodes' Leases while the context lasts."""

    def __init__(self, api: Api) -> None:
        self._api = api
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="clocks", daemon=True)
        self.clocks: dict[str, Clock] = {}
        """Those of the nodes that have written meanwhile; none where that may not be seen."""

    def __enter__(self) -> OfNodes:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        before: dict[str, float] = {}
        asked_before = 0.0
        while not self._ended.is_set():
            try:
                answer = self._api.request("GET", _NODE_LEASES)
            except CommandError:
                return
            written = {lease["metadata"]["name"]: lease["spec"].get("renewTime", "") for lease in answer.body["items"]}
            now = {name: unix(moment) for name, moment in written.items() if moment}
            for name in now.keys() & before.keys():
                if now[name] != before[name]:
                    # It was written after the look before had begun, and before this one had ended.
                    middle, give = (asked_before + answer.answered) / 2, (answer.answered - asked_before) / 2
                    self.clocks[name] = Clock(now[name] - middle, give)
            before, asked_before = now, answer.asked
            self._ended.wait(LOOK)


def judge(nodes: Mapping[str, Clock], api_server: Clock | None) -> Finding:
    """What the clocks of these nodes, and of the API server, come to. This machine's has only to do with what is shown on it."""
    known = {**nodes, **({"the API server": api_server} if api_server is not None else {})}
    if len(known) < 2:
        return Finding(
            CHECK, "WARN", "there is only one clock to look at", "run it where pods may be made on two nodes"
        )
    # What is surely apart counts: of two that were told vaguely, less than of two that were asked.
    first = min(known, key=lambda name: known[name].ahead + known[name].give)
    last = max(known, key=lambda name: known[name].ahead - known[name].give)
    apart = known[last].ahead - known[first].ahead
    give = known[last].give + known[first].give
    among = f"{_listed(known)}; this machine's is {_of_ours(known.values())}"
    if apart - give <= NOTICED:
        most = max(clock.ahead + clock.give for clock in known.values()) - min(
            clock.ahead - clock.give for clock in known.values()
        )
        return Finding(CHECK, "OK", f"at most {rough(most)} apart ({among})")
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


def _listed(known: Iterable[str]) -> str:
    named = list(known)
    more = f" and {len(named) - MOST} more" if len(named) > MOST else ""
    return f"{', '.join(named[:MOST])}{more}"


def to_wire(nodes: Mapping[str, Clock]) -> dict[str, Any]:
    """For scripts: by how many seconds each is ahead of this machine's."""
    return {name: round(clock.ahead, 4) for name, clock in nodes.items()}

"""Compares the clocks of the nodes, of the API server and of this machine.

The nodes with the doctor's pods are asked for their time. Every other node writes its time into its heartbeat object in
``kube-node-lease`` every ten seconds; this check notices when it is written.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from typing import Any

from understudy.cli.common.cluster_access.kubectl_proxy import Api
from understudy.cli.common.cluster_access.pod_session import Session
from understudy.cli.common.errors import CommandError
from understudy.cli.common.text.tree_text import rough
from understudy.cli.common.text.wording import unix
from understudy.cli.doctor.findings import Finding
from understudy.kube.client import LEASES

CHECK = "clocks"

NOTICED = 0.1
"""Difference between two clocks, in seconds, above which ages, `dependsOn` and transforms are evaluated wrongly
(docs/dependencies.md, docs/trees.md)."""

WRONG = 5.0
"""Difference in seconds above which everything that compares times is wrong."""

ASKED = 7
"""How often a clock is asked. The quickest answer is the most accurate."""

CHECK_PERIOD = 0.5
"""Seconds between two reads of the nodes' heartbeats. Their clocks are accurate to half of that."""

MOST = 4
"""Greatest number of clocks that are listed by name."""

_NODE_LEASES = LEASES.path("kube-node-lease")
_TICK_WITHIN = 2.5
_TICK_CHECK_PERIOD = 0.01


@dataclass(frozen=True)
class Clock:
    """How far a clock is ahead of this machine's, and the uncertainty, both in seconds."""

    ahead: float
    give: float


def of_session(talk: Session) -> Clock:
    """Return the clock of a pod's node."""
    found = []
    for _ in range(ASKED):
        asked = time.time()
        answer = talk.ask("clock")
        answered = time.time()
        found.append(Clock(answer - (asked + answered) / 2, (answered - asked) / 2))
    return min(found, key=lambda clock: clock.give)


def of_api_server(api: Api) -> Clock | None:
    """Return the API server's clock, from the moment at which its second changes; None if its answers have no date."""
    end, before = time.monotonic() + _TICK_WITHIN, None
    while time.monotonic() < end:
        answer = api.request("GET", "/version")
        if not answer.date:
            return None
        if before is not None and answer.date != before.date:
            # The second began after the previous request was sent and before this answer was received.
            early, late = before.asked, answer.answered
            second = parsedate_to_datetime(answer.date).timestamp()
            return Clock(second - (early + late) / 2, (late - early) / 2)
        before = answer
        time.sleep(_TICK_CHECK_PERIOD)
    return None


class NodeClocks:
    """Reads the nodes' heartbeats for the duration of the context."""

    def __init__(self, api: Api) -> None:
        self._api = api
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="clocks", daemon=True)
        self.clocks: dict[str, Clock] = {}
        """The clocks of the nodes that wrote meanwhile; empty if the user may not read them."""

    def __enter__(self) -> NodeClocks:
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
                    # It was written after the previous request was sent and before this answer was received.
                    middle, give = (asked_before + answer.answered) / 2, (answer.answered - asked_before) / 2
                    self.clocks[name] = Clock(now[name] - middle, give)
            before, asked_before = now, answer.asked
            self._ended.wait(CHECK_PERIOD)


def judge(nodes: Mapping[str, Clock], api_server: Clock | None) -> Finding:
    """Judge the clocks of the nodes and of the API server. This machine's clock affects only what is displayed on
    it."""
    known = {**nodes, **({"the API server": api_server} if api_server is not None else {})}
    if len(known) < 2:
        return Finding(
            CHECK, "WARN", "only one clock could be read", "run the check where pods can be created on two nodes"
        )
    # Compares the differences that are certain, so that two inaccurate clocks count less than two accurate ones.
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
        f"the clock of {last} is {rough(apart)} ahead of the clock of {first}, with an uncertainty of {rough(give)} ({among})",
        f"synchronize the clocks of all machines (chrony or another NTP client): if they differ by more than {rough(NOTICED)}, ages of "
        "messages and state are wrong, and so is the order of failures of workloads that depend on each other",
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
    """Return for each node by how many seconds its clock is ahead of this machine's, for scripts."""
    return {name: round(clock.ahead, 4) for name, clock in nodes.items()}
